"""The best picks in an RGB-D image of your own, as picks.json and picks.png.

Colour is a PNG or JPEG; depth a 16-bit PNG or a NumPy file, 0 where there is no reading; both of one size. Matrices are text
files, a row a line: the intrinsics 3 x 3 in pixels, a pose 4 x 4, camera to world, z up from the floor.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from see2act.commands import user_errors_end_the_program
from see2act.errors import UserError
from see2act.files import replacing, writable, write_json

if TYPE_CHECKING:
    from see2act.prediction.predict import Prediction


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    args = _parser().parse_args(arguments)
    with user_errors_end_the_program():
        inputs = _read(args)
        # torch takes seconds to import, and a refusal should not.
        from see2act.experiment.model_file import load
        from see2act.prediction.picture import picture
        from see2act.prediction.predict import predict

        model = load(args.checkpoint, args.primitive)
        bounds = tuple(args.bounds) if args.bounds else None
        found = predict(**inputs, checkpoint=model, bounds=bounds, floor=args.floor, count=args.count, apart=args.apart)
    _write(args, found, picture(inputs["color"], found), model.config_hash)
    _tell(args, found)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--checkpoint", type=Path, required=True, metavar="F", help="models/*.safetensors, or model.safetensors of a run")
    add("--color", type=Path, required=True, metavar="F", help="8-bit image")
    add("--depth", type=Path, required=True, metavar="F", help="16-bit PNG or .npy")
    add("--depth-scale", type=float, required=True, metavar="N", help="units of the depth per metre: 1000 for millimetres")
    add("--intrinsics", type=Path, required=True, metavar="F", help="3 x 3, pixels")
    add("--background-depth", type=Path, metavar="F", help="the same view of the empty bin, in the same units")
    add("--pose", type=Path, metavar="F", help="4 x 4, camera to world; without it the dominant plane is the floor")
    words = "the inside of the bin, metres of the world (default: where floor is seen)"
    add("--bounds", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help=words)
    add("--floor", type=float, metavar="Z", help="metres of the world, of the bin's floor (default: 0 with a pose, else found)")
    add("--primitive", choices=("suction", "grasp"), help="refuse a checkpoint of the other one")
    add("--count", type=int, default=10, metavar="N", help="picks at most (default 10)")
    add("--apart", type=float, default=0.02, metavar="M", help="metres between any two (default 0.02)")
    add("--out", type=Path, required=True, metavar="DIR", help="where picks.json and picks.png go")
    return parser


def _write(args: argparse.Namespace, found: Prediction, image: np.ndarray, config_hash: str) -> None:
    coded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    with replacing(args.out / "picks.png") as partial:
        partial.write_bytes(coded.tobytes())
    write_json(
        args.out / "picks.json",
        {
            "primitive": found.primitive,
            "checkpoint": {"file": str(args.checkpoint), "config_hash": config_hash},
            "units": "metres, radians, pixels from 0; the image's column u and row v",
            "world": "the given pose's" if args.pose else "z up from the dominant plane, x to the image's right",
            "camera_to_world": found.pose.tolist(),
            "heightmap": _grid(found),
            "picks": [dataclasses.asdict(pick) for pick in found.picks],
        },
    )


def _tell(args: argparse.Namespace, found: Prediction) -> None:
    for number, pick in enumerate(found.picks, start=1):
        x, y, z = pick.position
        turn = "" if pick.angle is None else f", jaws along {np.degrees(pick.angle):.0f} degrees"
        print(f"{number:2}  score {pick.score:.2f}  image ({pick.u}, {pick.v})  x {x:.3f} y {y:.3f} z {z:.3f} m{turn}")
    if not args.pose:
        print("world: z up from the dominant plane, x to the image's right; --pose gives your robot's")
    if not args.bounds:
        print("without --bounds of the inside of the bin, what lies outside it may be picked")
    if not found.picks:
        print("no pick: nothing may be picked there; check bounds, pose and background")
    print(args.out / "picks.png")


def _grid(found: Prediction) -> dict[str, Any]:
    """Where the pixels of the heightmap are: row and column 0 at the largest y and the smallest x."""
    rows, cols = found.workspace.shape
    x, y = found.workspace.to_world(0, 0)
    first = [float(x + found.origin[0]), float(y + found.origin[1])]
    return {
        "rows": rows,
        "cols": cols,
        "pixel": found.workspace.pixel,
        "middle_of_first": first,
        "floor": float(found.origin[2]),
    }


def _read(args: argparse.Namespace) -> dict[str, Any]:
    """The files, checked for what they are by themselves."""
    for name in ("depth_scale", "apart", "count"):
        if not 0 < getattr(args, name) < math.inf:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name):g} must be a number above 0")
    if not writable(args.out):
        raise UserError(f"--out {args.out} cannot be written: give a folder that you may write to")
    # As the sensor has it, as depth is: a camera's note of how it was held turns the one and not the other.
    color = cv2.imread(str(_there(args.color, "--color")), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if color is None:
        raise UserError(f"{args.color} cannot be read as an image: give a PNG or JPEG")
    background = None
    if args.background_depth:
        background = _depth(_there(args.background_depth, "--background-depth")) / args.depth_scale
    return {
        "color": cv2.cvtColor(color, cv2.COLOR_BGR2RGB),
        "depth": _depth(_there(args.depth, "--depth")) / args.depth_scale,
        "intrinsics": _matrix(_there(args.intrinsics, "--intrinsics"), (3, 3)),
        "pose": _matrix(_there(args.pose, "--pose"), (4, 4)) if args.pose else None,
        "background_depth": background,
    }


def _there(path: Path, option: str) -> Path:
    if not path.is_file():
        raise UserError(f"{option} {path} is not there: give the path of a file")
    return path


def _depth(path: Path) -> np.ndarray:
    try:
        depth = np.load(path) if path.suffix == ".npy" else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except (OSError, EOFError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({error}): give what numpy.save wrote") from None
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "iuf" or depth.dtype == np.uint8:
        shape = f"{depth.dtype} of shape {depth.shape}" if isinstance(depth, np.ndarray) else "no image"
        raise UserError(f"{path} is {shape}: depth must be a 16-bit PNG of one channel, or a .npy of two dimensions")
    return np.asarray(depth, np.float32)


def _matrix(path: Path, shape: tuple[int, int]) -> np.ndarray:
    try:
        lines = [line for line in path.read_text().replace(",", " ").splitlines() if line.split("#")[0].strip()]
        matrix = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 0))
    except (ValueError, OSError) as error:
        raise UserError(f"{path} is no matrix ({' '.join(str(error).split())}): write a row a line") from None
    if matrix.shape != shape:
        sizes = " x ".join(map(str, matrix.shape)), " x ".join(map(str, shape))
        raise UserError(f"{path} is {sizes[0]}, not {sizes[1]}: write {shape[0]} lines of {shape[1]} numbers")
    return matrix
