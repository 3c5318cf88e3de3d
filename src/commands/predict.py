"""The best picks in an RGB-D image of your own, as picks.json and picks.png.

Colour is a PNG or JPEG; depth a 16-bit PNG, or a .npy, TIFF or EXR, 0 where there is no reading; both of one size.
Intrinsics and pose are text, .npy, JSON or YAML, as calibration tools write them: docs/guides/images.md lists what is read.
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
from see2act.prediction.files import read_color, read_depth, read_lens, read_pose

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
        undistorted = inputs.pop("undistorted")
        found = predict(
            **inputs,
            checkpoint=model,
            bounds=bounds,
            floor=args.floor,
            count=args.count,
            apart=args.apart,
            per_object=args.per_object,
        )
        _write(args, found, picture(inputs["color"], found), model.config_hash)
        _tell(args, found, undistorted)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--checkpoint", type=Path, required=True, metavar="F", help="models/*.safetensors, or model.safetensors of a run")
    add("--color", type=Path, required=True, metavar="F", help="8-bit image")
    add("--depth", type=Path, required=True, metavar="F", help="16-bit PNG, .npy, TIFF or EXR")
    words = "units of the depth per metre: 1000 for millimetres (default: 1 for a file of decimal numbers)"
    add("--depth-scale", type=float, metavar="N", help=words)
    add("--intrinsics", required=True, metavar="F", help="a file, or fx,fy,cx,cy in pixels")
    add("--background-depth", type=Path, metavar="F", help="the same view of the empty bin, in the same units")
    add("--pose", type=Path, metavar="F", help="camera to world; without it the dominant plane is the floor")
    words = "the inside of the bin, metres of the world (default: where floor is seen)"
    add("--bounds", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help=words)
    add("--floor", type=float, metavar="Z", help="of the bin's floor, to 6 cm (default: 0 with a pose, else found)")
    add("--primitive", choices=("suction", "grasp"), help="refuse a checkpoint of the other one")
    add("--count", type=int, default=10, metavar="N", help="picks at most (default 10)")
    add("--apart", type=float, default=0.02, metavar="M", help="metres between any two (default 0.02)")
    add("--per-object", type=int, metavar="N", help="picks on one object at most; objects that touch count as one")
    add("--out", type=Path, required=True, metavar="DIR", help="where picks.json and picks.png go")
    return parser


def _write(args: argparse.Namespace, found: Prediction, image: np.ndarray, config_hash: str) -> None:
    coded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    with replacing(args.out / "picks.png") as partial:
        partial.write_bytes(coded.tobytes())
    write_json(
        args.out / "picks.json",
        {
            "notes": list(found.notes),
            "primitive": found.primitive,
            "checkpoint": {"file": str(args.checkpoint), "config_hash": config_hash},
            "units": "metres, radians, pixels from 0; the image's column u and row v",
            "world": "the given pose's" if args.pose else "z up from the dominant plane, x to the image's right",
            "camera_to_world": found.pose.tolist(),
            "heightmap": _grid(found),
            "picks": [dataclasses.asdict(pick) for pick in found.picks],
        },
    )


def _tell(args: argparse.Namespace, found: Prediction, undistorted: bool) -> None:
    for note in found.notes:
        print(note)
    if undistorted:
        print("the images were undistorted; image pixels and picks.png are of the undistorted ones")
    for number, pick in enumerate(found.picks, start=1):
        x, y, z = pick.position
        turn = "" if pick.angle is None else f", jaws along {np.degrees(pick.angle):.0f} degrees"
        hit = ", and a finger would land on something" if pick.blocked else ""
        print(f"{number:2}  score {pick.score:.2f}  image ({pick.u}, {pick.v})  x {x:.3f} y {y:.3f} z {z:.3f} m{turn}{hit}")
    if not args.pose:
        print("world: z up from the dominant plane, x to the image's right; --pose gives your robot's")
    if not args.bounds:
        print("without --bounds of the inside of the bin, what lies outside it may be picked")
    if not found.picks:
        print("no pick: nothing is 5 mm above the floor or the background; check bounds, pose, floor and background")
    print(args.out / "picks.png")


def _grid(found: Prediction) -> dict[str, Any]:
    """Where the pixels of the heightmap are: row and column 0 at the largest y and the smallest x."""
    rows, cols = found.workspace.shape
    x, y = found.workspace.to_world(0, 0)
    first = [float(x + found.middle[0]), float(y + found.middle[1])]
    return {
        "rows": rows,
        "cols": cols,
        "pixel": found.workspace.pixel,
        "middle_of_first": first,
        "floor": float(found.floor.at(*found.middle)),
        "floor_slope": list(found.floor.slope),
    }


def _read(args: argparse.Namespace) -> dict[str, Any]:
    """The files, checked for what they are by themselves."""
    for name in ("depth_scale", "apart", "count", "per_object"):
        if getattr(args, name) is not None and not 0 < getattr(args, name) < math.inf:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name):g} must be a number above 0")
    if not writable(args.out):
        raise UserError(f"--out {args.out} cannot be written: give a folder that you may write to")
    lens = read_lens(args.intrinsics)
    color = read_color(args.color)
    if lens.size and lens.size != color.shape[1::-1]:
        wrong, right = (" x ".join(map(str, size)) for size in (lens.size, color.shape[1::-1]))
        raise UserError(
            f"{args.intrinsics} is for images of {wrong}, and {args.color} has {right}: give the intrinsics of {right}"
        )
    depth = read_depth(args.depth, args.depth_scale, "--depth")
    background = read_depth(args.background_depth, args.depth_scale, "--background-depth") if args.background_depth else None
    return {
        "color": lens.undistorted(color, cv2.INTER_LINEAR),
        "depth": lens.undistorted(depth, cv2.INTER_NEAREST),
        "intrinsics": lens.matrix,
        "pose": read_pose(args.pose) if args.pose else None,
        "background_depth": None if background is None else lens.undistorted(background, cv2.INTER_NEAREST),
        "undistorted": bool(lens.distortion),
    }
