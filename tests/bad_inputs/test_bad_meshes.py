"""Folders of meshes that no object can be made of: refused before the robot is built."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st

from see2act.errors import storage_errors
from see2act.experiment.preflight import check_command
from see2act.robot.meshes import folder as mesh_folder
from see2act.robot.meshes import mesh_shape
from tests.bad_inputs.refusals import damaged, examples, is_refused, is_refused_or_done, scratch

BOX = trimesh.creation.box((0.03, 0.04, 0.05))
VERTICES, FACES = np.asarray(BOX.vertices), np.asarray(BOX.faces)
ENDINGS = st.sampled_from([".obj", ".stl", ".OBJ"])


def _obj(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines).encode()


def _stl(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Binary, as most programs write it."""
    triangles = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    triangles["corners"] = vertices[faces] if len(vertices) else 0
    return b"\0" * 80 + struct.pack("<I", len(faces)) + triangles.tobytes()


WRITERS = {".obj": _obj, ".OBJ": _obj, ".stl": _stl}
GOOD = _obj(VERTICES, FACES)


def _read(file: Path) -> object:
    """What a run does with each file of a folder."""
    mesh_shape.cache_clear()
    return mesh_shape(file.stem, file, 1.0, None)


def _made(path: Path, kinds: int = 1) -> object:
    """A set of objects from a folder."""
    mesh_shape.cache_clear()
    return mesh_folder("mine", str(path), 1.0, 0.5, None, kinds, 1, (0.9, 1.1), 250.0, 0.08)


def _in_a_folder(content: bytes, ending: str) -> None:
    """Among good ones."""
    with scratch() as folder:
        for name in "abc":
            (folder / f"{name}.obj").write_bytes(GOOD)
        _made(folder)
        (folder / f"bad{ending}").write_bytes(content)
        is_refused(lambda: _made(folder), folder)


@given(content=st.binary(max_size=200), ending=ENDINGS)
@examples(15)
@example(content=b"", ending=".obj")
@example(content=b"", ending=".stl")
@example(content=b"solid nothing\nendsolid", ending=".stl")
@example(content=b"solid \xff\xfe", ending=".stl")
@example(content=b"\0" * 80 + b"\xff\xff\xff\xff", ending=".stl")
@example(content=b"\xff\xfev\0 \0", ending=".obj")
@example(content="v één twee drie\nf 1 2 3".encode("latin-1"), ending=".obj")
@example(content=b"mtllib ../../../etc/passwd\nusemtl x\nv 0 0 0\n", ending=".obj")
def test_whatever_bytes_are_no_mesh(content: bytes, ending: str) -> None:
    _in_a_folder(content, ending)


SHAPES: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "no faces": lambda v, f: (v, f[:0]),
    "no vertices": lambda v, f: (v[:0], f),
    "one face": lambda v, f: (v, f[:1]),
    "flat": lambda v, f: (v * [1, 1, 0], f),
    "a line": lambda v, f: (v * [1, 0, 0], f),
    "a point": lambda v, f: (v * 0, f),
    "not a number": lambda v, f: (v * np.nan, f),
    "a vertex that is no number": lambda v, f: (np.where(np.arange(len(v))[:, None] == 2, np.nan, v), f),
    "infinite": lambda v, f: (np.where(np.arange(len(v))[:, None] == 1, np.inf, v), f),
    "enormous": lambda v, f: (v * 1e30, f),
    "too large": lambda v, f: (v * 100, f),
    "tiny": lambda v, f: (v * 1e-4, f),
    "vanishing": lambda v, f: (v * 1e-30, f),
    "thin": lambda v, f: (v * [1, 1, 1e-4], f),
    "wide": lambda v, f: (v * [4, 2.5, 2.9], f),
    "of one corner": lambda v, f: (v, f * 0),
}


@pytest.mark.parametrize("shape", SHAPES)
@given(ending=ENDINGS, turn=st.permutations([0, 1, 2]))
@examples(1)
def test_shapes_that_cannot_be_picked_are_refused(shape: str, ending: str, turn: list[int]) -> None:
    vertices, faces = SHAPES[shape](VERTICES, FACES)
    _in_a_folder(WRITERS[ending](vertices[:, turn], faces), ending)


@given(numbers=st.lists(st.integers(-20, 20), min_size=3, max_size=3), count=st.integers(1, 12))
@examples(10)
@example(numbers=[10**9, 2, 3], count=12)
@example(numbers=[-(10**9), 2, 3], count=1)
@example(numbers=[0, 0, 0], count=12)
def test_faces_of_vertices_that_are_not_there_are_refused_or_left_out(numbers: list[int], count: int) -> None:
    content = _obj(VERTICES, FACES[count:]) + f"\nf {numbers[0]} {numbers[1]} {numbers[2]}".encode() * count
    with scratch() as folder:
        (folder / "bad.obj").write_bytes(content)
        is_refused_or_done(lambda: _read(folder / "bad.obj"), folder)


@given(content=st.sampled_from([GOOD, _stl(VERTICES, FACES), BOX.export(file_type="stl_ascii").encode()]), data=st.data())
@examples(20)
def test_damage_is_refused_or_does_no_harm(content: bytes, data: st.DataObject) -> None:
    with scratch() as folder:
        file = folder / ("bad.obj" if content == GOOD else "bad.stl")
        file.write_bytes(data.draw(damaged(content)))
        is_refused_or_done(lambda: _read(file), folder)


@given(content=st.sampled_from([GOOD, _stl(VERTICES, FACES)]), share=st.floats(0, 0.4))
@examples(8)
def test_a_file_that_was_cut_short_is_refused(content: bytes, share: float) -> None:
    _in_a_folder(content[: int(share * len(content))], ".obj" if content == GOOD else ".stl")


# Folders


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"notes.txt": GOOD},
        {"a.ply": GOOD, "b.glb": GOOD, "c.obj.zip": GOOD},
        {"a.obj": GOOD},
        {"a.obj": GOOD, "b.obj": GOOD, "deep/a.stl": _stl(VERTICES, FACES)},
        {"a.obj": GOOD, "a.OBJ": GOOD, "b.obj": GOOD},
    ],
    ids=str,
)
def test_a_folder_without_enough_meshes_is_refused(files: dict[str, bytes]) -> None:
    with scratch() as folder:
        for name, content in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        is_refused(lambda: _made(folder, kinds=2), folder)


@pytest.mark.parametrize("name", ["nothing", "a file", "a loop", "a\nb", "é😀", "x" * 300])
def test_a_path_that_is_no_folder_is_refused(name: str) -> None:
    with scratch() as folder:
        (folder / "a file").touch()
        (folder / "a loop").symlink_to("a loop")
        places = [f"paths.cache={folder}/cache", f"hydra.run.dir={folder}/run", "precision=fp32"]

        def check() -> None:
            with storage_errors():  # as in every command
                check_command([*places, "objects=folder", f'objects.path="{folder / name}"'])

        is_refused(check, folder)


def test_a_folder_for_a_mesh_and_a_loop_are_refused() -> None:
    with scratch() as folder:
        for name in "abc":
            (folder / f"{name}.obj").write_bytes(GOOD)
        (folder / "d.obj").mkdir()
        is_refused(lambda: _made(folder), folder)
        (folder / "d.obj").rmdir()
        (folder / "d.stl").symlink_to("d.stl")
        is_refused(lambda: _made(folder), folder)
        (folder / "d.stl").unlink()
        (folder / "d.stl").symlink_to("nowhere")
        is_refused(lambda: _made(folder), folder)


NUMBERS = st.sampled_from([float("nan"), float("inf"), -1.0, 0.0, 1e30])


@given(key=st.sampled_from(["unit", "held_out", "width", "density", "opening", "scale", "kinds", "copies"]), value=NUMBERS)
@examples(6)
@example(key="held_out", value=float("nan"))
@example(key="held_out", value=-1.0)
@example(key="held_out", value=2.0)
@example(key="width", value=1e-300)
def test_numbers_of_a_folder_out_of_range_are_refused(key: str, value: float) -> None:
    typed = f"[{value},{value}]" if key == "scale" else str(value)
    wrong = value != 1e30 or key not in ("opening", "density")
    with scratch() as folder:
        for name in "abcd":
            (folder / f"{name}.obj").write_bytes(GOOD)
        cfg = ["objects=folder", f"objects.path={folder}", "objects.kinds=1", "objects.held_out=0.5", "precision=fp32"]
        places = [f"paths.cache={folder}/cache", f"hydra.run.dir={folder}/run"]
        check = is_refused if wrong else is_refused_or_done
        check(lambda: check_command([*cfg, *places, f"objects.{key}={typed}"]), folder)
