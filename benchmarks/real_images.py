"""How many of the best picks lie on objects, in real RGB-D images whose objects were outlined by hand.

Fourteen scenes of three public repositories are known: real_images.json names repositories, commits and files, and has the
outlines. Clone the repositories, and tell where they are:

    python -m benchmarks.real_images scenes --out picks --clone 6dof-graspnet=DIR arc-robot-vision=DIR graspnet-baseline=DIR

A scene is a folder below `scenes`, so you can add your own: color.png, depth.png (16 bit), intrinsics.txt (3 x 3), objects.png
(8 bit, 0 for no object and k for object k) and scene.json (`depth_scale` in units per metre, `source`, `half`), and where there
are such, pose.txt (4 x 4), background-depth.png, and `bounds` and `floor` in scene.json. predict.py writes its picks into
picks/SCENE/PRIMITIVE. Settings may be chosen on the scenes whose half is `develop`, and not on the `reported` ones.
"""

from __future__ import annotations

import argparse
import json
import pickle
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.io import loadmat
from tqdm import tqdm

from benchmarks.common import PRIMITIVES, finish
from see2act.errors import UserError
from see2act.experiment.results import wilson
from see2act.files import write_json

ROOT = Path(__file__).resolve().parents[1]
KNOWN = ROOT / "benchmarks" / "real_images.json"
TOLERANCE = 3
"""Pixels outside an outline that still count: outlines, and the registration of depth to colour, are no better."""
SCALE = 10_000
"""Units per metre of depth that was not stored as whole numbers."""
GIVEN = {"pose.txt": "--pose", "background-depth.png": "--background-depth"}
"""Files that a scene may have, and the options of predict.py for them."""


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scenes", type=Path, help="folder with a folder for each scene")
    add("--out", type=Path, required=True, metavar="DIR", help="where the picks go, or are with --score")
    add("--clone", nargs="+", default=[], metavar="NAME=DIR", help="first make the known scenes from these clones")
    add("--predict", type=Path, default=ROOT / "predict.py", metavar="F", help="predict.py of another version of the code")
    add("--score", action="store_true", help="predict nothing: count the picks that are in --out")
    add("--json", type=Path, metavar="FILE", help="also write the rows here")
    args = parser.parse_args()
    try:
        prepare(args.scenes, {name: Path(folder) for name, _, folder in (str(clone).partition("=") for clone in args.clone)})
        folders = sorted(path.parent for path in args.scenes.glob("*/scene.json"))
        if not folders:
            raise UserError(f"{args.scenes} has no scene: give --clone, or make folders as --help says")
        jobs = [(folder, primitive) for folder in folders for primitive in PRIMITIVES]
        for folder, primitive in () if args.score else tqdm(jobs):
            predict(folder, primitive, args.predict, args.out / folder.name / primitive)
        rows = [score(folder, args.out / folder.name / primitive, primitive) for folder, primitive in jobs]
    except (UserError, ValueError, OSError) as error:
        parser.error(str(error))
    finish(f"Picks on objects (within {TOLERANCE} pixels)", [*rows, *totals(rows)], args.json)


# Scenes


def prepare(scenes: Path, clones: dict[str, Path]) -> None:
    """Write the known scenes of these repositories, each into a folder of its name."""
    known = json.loads(KNOWN.read_text())
    if unknown := clones.keys() - known["sources"]:
        raise UserError(f"--clone {', '.join(sorted(unknown))} is not known: {', '.join(known['sources'])} are")
    for name, scene in known["scenes"].items():
        if scene["source"] in clones:
            _prepare(scenes / name, scene, clones[scene["source"]])


def _prepare(folder: Path, scene: dict[str, Any], clone: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if "data" in scene:
        data = _pickled(clone / scene["data"])
        color, intrinsics, scale = data["image"][..., ::-1], data["intrinsics_matrix"], SCALE
        depth = np.rint(np.nan_to_num(data["depth"]) * SCALE).astype(np.uint16)
    else:
        color, depth = (cv2.imread(str(clone / scene[name]), cv2.IMREAD_UNCHANGED) for name in ("color", "depth"))
        intrinsics, scale = _intrinsics(clone / scene["intrinsics"]), scene["depth_scale"]
    _write(folder / "color.png", color)
    _write(folder / "depth.png", depth)
    _write(folder / "objects.png", outlined(scene["objects"].values(), depth.shape))
    np.savetxt(folder / "intrinsics.txt", intrinsics)
    if "pose" in scene:
        np.savetxt(folder / "pose.txt", np.loadtxt(clone / scene["pose"]))
    if "background_depth" in scene:
        _write(folder / "background-depth.png", cv2.imread(str(clone / scene["background_depth"]), cv2.IMREAD_UNCHANGED))
    kept = {name: scene[name] for name in ("source", "half", "bounds", "floor") if name in scene}
    write_json(folder / "scene.json", {"depth_scale": scale} | kept)


def outlined(objects: Iterable[list[list[list[int]]]], shape: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """The mask: k inside the polygons of object k; a polygon inside another cuts a hole, and later objects lie above."""
    mask = np.zeros(shape, np.uint8)
    for number, polygons in enumerate(objects, start=1):
        cv2.fillPoly(mask, [np.array(polygon, np.int32) for polygon in polygons], number)
    return mask


def _intrinsics(path: Path) -> Float[np.ndarray, "3 3"]:
    return np.asarray(loadmat(path)["intrinsic_matrix"] if path.suffix == ".mat" else np.loadtxt(path))


def _write(path: Path, image: np.ndarray | None) -> None:
    if image is None:
        raise UserError(f"{path.name} of {path.parent.name} is not in its repository: clone the commit of {KNOWN.name}")
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def _pickled(path: Path) -> dict[str, Any]:
    """A dictionary of arrays in a `.npy` file."""
    with path.open("rb") as file:
        np.lib.format.read_magic(file)
        np.lib.format.read_array_header_1_0(file)
        return _Arrays(file, encoding="latin1").load().item()


class _Arrays(pickle.Unpickler):
    """A pickle can call anything; this calls what makes arrays."""

    def find_class(self, module: str, name: str) -> Any:
        """What may be called."""
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        if module.startswith(("numpy.core.", "numpy._core.")) and name == "_reconstruct":
            return np._core.multiarray._reconstruct  # type: ignore[attr-defined]
        raise UserError(f"the file calls {module}.{name}, and should hold arrays alone")


# Picks


def predict(scene: Path, primitive: str, script: Path, out: Path) -> None:
    """Have picks.json and picks.png written; a refusal leaves none, and is printed."""
    told = json.loads((scene / "scene.json").read_text())
    options = [f"--checkpoint={script.parent / 'models' / primitive}.safetensors", f"--depth-scale={told['depth_scale']}"]
    options += [f"--color={scene / 'color.png'}", f"--depth={scene / 'depth.png'}", f"--intrinsics={scene / 'intrinsics.txt'}"]
    options += [f"{option}={scene / name}" for name, option in GIVEN.items() if (scene / name).exists()]
    options += [f"--floor={told['floor']}"] if "floor" in told else []
    options += ["--bounds", *map(str, told["bounds"])] if "bounds" in told else []
    (out / "picks.json").unlink(missing_ok=True)
    done = subprocess.run([sys.executable, script, *options, f"--out={out}"], capture_output=True, text=True, check=False)
    if done.returncode:
        tqdm.write(f"{scene.name}, {primitive}: {done.stderr.strip()}")


def score(scene: Path, picks: Path, primitive: str) -> dict[str, Any]:
    """A row: how many picks there are, how many lie on objects, and on how many."""
    told = json.loads((scene / "scene.json").read_text())
    mask = np.asarray(cv2.imread(str(scene / "objects.png"), cv2.IMREAD_UNCHANGED))
    path = picks / "picks.json"
    found = json.loads(path.read_text())["picks"] if path.exists() else []
    hits = hit([(pick["u"], pick["v"]) for pick in found], mask)
    return {
        "scene": scene.name,
        "source": told["source"],
        "half": told["half"],
        "primitive": primitive,
        "picks": len(found),
        "on_objects": int(np.count_nonzero(hits)),
        "first_on_object": bool(len(hits) and hits[0]),
        "objects_picked": len(np.unique(hits[hits > 0])),
        "objects": len(np.unique(mask[mask > 0])),
    }


def hit(pixels: list[tuple[int, int]], mask: UInt8[np.ndarray, "h w"]) -> Int[np.ndarray, " n"]:
    """The object at or next to each pixel (u, v); 0 for none."""
    near = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * TOLERANCE + 1,) * 2))
    return np.array([int(mask[v, u] or near[v, u]) for u, v in pixels], int)


def totals(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sums over the scenes of a source, of a half and of all, for each primitive, with Wilson intervals of the shares."""
    groups = [(key, value) for key in ("source", "half") for value in sorted({row[key] for row in rows})]
    table = []
    for primitive in PRIMITIVES:
        for key, value in [*groups, ("", "all")]:
            part = [row for row in rows if row["primitive"] == primitive and (not key or row[key] == value)]
            on, count = sum(row["on_objects"] for row in part), sum(row["picks"] for row in part)
            low, high = wilson(on, count)
            total = dict.fromkeys(rows[0], "") | {"scene": f"{len(part)} scenes", "primitive": primitive}
            total |= {name: sum(row[name] for row in part) for name in list(rows[0])[4:]}
            share = f"{on / count:.2f} [{low:.2f}, {high:.2f}]" if count else "no picks"
            table.append(total | ({key: value} if key else {"source": "all"}) | {"share": share})
    for row in rows:
        row["share"] = f"{row['on_objects'] / row['picks']:.2f}" if row["picks"] else "no picks"
    return table


if __name__ == "__main__":
    main()
