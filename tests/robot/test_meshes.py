"""Objects from mesh files."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig

from see2act.robot.meshes import LARGEST, MeshSet, mesh_shape
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.solids import box
from see2act.robot.types import RobotError


@pytest.fixture(scope="module")
def urdfs(config: Callable[..., DictConfig]) -> MeshSet:
    return instantiate(config("objects=random_urdfs").objects, _convert_="all")


def test_a_thousand_objects_split_by_name(urdfs: MeshSet) -> None:
    assert (len(urdfs.seen), len(urdfs.unseen)) == (899, 100)
    assert max(urdfs.seen) < min(urdfs.unseen)
    for name, file in urdfs.files.items():  # one of PyBullet's is made of vertices that are no numbers
        vertices = np.array([line.split()[1:4] for line in file.read_text().splitlines() if line.startswith("v ")], float)
        assert np.isfinite(vertices).all(), name
        assert np.linalg.matrix_rank(vertices - vertices.mean(axis=0), tol=1e-6) == 3, name


def test_their_shapes_fit_the_gripper_and_are_convex_parts(urdfs: MeshSet) -> None:
    assert "urdf178" in urdfs.seen  # 54 cm long if its middle side alone counted
    for name in (*urdfs.unseen[::9], "urdf178"):
        shape = urdfs.shape(name)
        points = np.concatenate([part.vertices for part in shape.parts])
        sides = np.sort(np.ptp(points, axis=0))
        assert sides[1] == pytest.approx(0.05) or sides[2] == pytest.approx(LARGEST)
        assert sides[1] < 0.0501
        assert sides[2] < LARGEST + 1e-4
        assert all(part.is_convex and part.is_volume for part in shape.parts)
        centre = sum(part.volume * part.center_mass for part in shape.parts) / shape.volume
        np.testing.assert_allclose(centre, 0, atol=1e-6)


def test_those_of_the_most_parts_are_shapes_too(urdfs: MeshSet) -> None:
    parts = {name: len(urdfs.shape(name).parts) for name in ("urdf360", "urdf503", "urdf777", "urdf782", "urdf858", "urdf123")}
    assert min(parts.values()) > 100
    assert max(parts.values()) == parts["urdf782"] == 127


def test_a_robot_picks_among_them(make_robot: Callable[..., SimulatedRobot]) -> None:
    robot = make_robot("objects=random_urdfs", "primitive=suction")
    robot.reset(5, "unseen")
    heightmap = robot.observe().heightmap
    assert 0.02 < heightmap.height.max() < 0.2
    row, col = np.unravel_index(heightmap.height.argmax(), heightmap.height.shape)
    assert robot.execute(robot.workspace.pick(heightmap, int(row), int(col), 0.0)).cause != "missed"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Twelve objects in millimetres, one of them an L, one in a folder of its own."""
    for i in range(10):
        box(30 + i, 40, 50).export(tmp_path / f"box{i}.stl")
    ell = trimesh.util.concatenate([box(60, 20, 20), box(20, 40, 20, (-20, 30, 0))])
    ell.export(tmp_path / "ell.obj")
    (tmp_path / "more").mkdir()
    trimesh.creation.cylinder(20, 50).export(tmp_path / "more" / "can.stl")
    return tmp_path


def _folder(config: Callable[..., DictConfig], path: Path, *overrides: str) -> MeshSet:
    cfg = config("objects=folder", f"objects.path={path}", "objects.kinds=3", *overrides)
    return instantiate(cfg.objects, _convert_="all")


def test_a_folder_of_one_s_own(config: Callable[..., DictConfig], files: Path, make_robot: Callable) -> None:
    objects = _folder(config, files, "objects.unit=0.001")
    assert objects.unseen == ("box9", "can", "ell")
    assert len(objects.seen) == 9
    np.testing.assert_allclose(np.sort(np.ptp(objects.shape("box2").parts[0].vertices, axis=0)), [0.032, 0.04, 0.05])
    assert objects.shape("box2").volume == pytest.approx(0.032 * 0.04 * 0.05)
    assert len(objects.shape("ell").parts) == 2
    robot = make_robot("objects=folder", f"objects.path={files}", "objects.kinds=3", "objects.unit=0.001")
    robot.reset(0, "unseen")
    assert robot.observe().heightmap.height.max() > 0.02


def test_a_concave_body_is_cut_into_convex_parts(config: Callable[..., DictConfig], files: Path) -> None:
    corners = [(0, 0), (60, 0), (60, 20), (20, 20), (20, 60), (0, 60)]
    outline = np.array(corners, float)
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    low, high = np.column_stack([outline, np.zeros(6)]), np.column_stack([outline, np.full(6, 20.0)])
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6) for i in range(6)] + [(i, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    caps = [(c, b, a) for a, b, c in faces] + [(a + 6, b + 6, c + 6) for a, b, c in faces]
    angle = trimesh.Trimesh(np.concatenate([low, high]), caps + sides)
    assert angle.is_volume
    angle.export(files / "angle.stl")
    shape = _folder(config, files, "objects.unit=0.001").shape("angle")
    assert len(shape.parts) > 1
    assert shape.volume == pytest.approx(angle.volume * 1e-9, rel=0.1)


CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 -1\nvn 0 0 1\nvn 0 -1 0\nvn 1 0 0\nvn 0 1 0\nvn -1 0 0
f 1/1/1 4/2/1 3/3/1 2/4/1\nf 5/1/2 6/2/2 7/3/2 8/4/2\nf 1/1/3 2/2/3 6/3/3 5/4/3
f 2/1/4 3/2/4 7/3/4 6/4/4\nf 3/1/5 4/2/5 8/3/5 7/4/5\nf 4/1/6 1/2/6 5/3/6 8/4/6
"""


def test_a_file_with_normals_and_texture_coordinates_is_one_body(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    shape = mesh_shape("cube", tmp_path / "cube.obj", 0.04, None)
    assert len(shape.parts) == 1
    assert shape.volume == pytest.approx(0.04**3)


def test_a_label_on_a_box_is_no_body(tmp_path: Path) -> None:
    label = trimesh.creation.box((20, 20, 1e-6), trimesh.transformations.translation_matrix((0, 0, 30)))
    trimesh.util.concatenate([box(40, 40, 50), label]).export(tmp_path / "box.stl")
    shape = mesh_shape("box", tmp_path / "box.stl", 0.001, None)
    assert shape.volume == pytest.approx(0.04 * 0.04 * 0.05)


def test_a_body_that_is_inside_out_is_cut_too(tmp_path: Path) -> None:
    ring = trimesh.creation.annulus(20, 30, 30)
    ring.invert()
    ring.export(tmp_path / "ring.stl")
    shape = mesh_shape("ring", tmp_path / "ring.stl", 0.001, None)
    assert shape.volume == pytest.approx(-ring.volume * 1e-9, rel=0.1)


def test_sizes_can_be_made_alike(config: Callable[..., DictConfig], files: Path) -> None:
    objects = _folder(config, files, "objects.width=0.04")
    for name in (*objects.seen, *objects.unseen):
        points = np.concatenate([part.vertices for part in objects.shape(name).parts])
        assert np.sort(np.ptp(points, axis=0))[1] == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), "objects.unit"),
        (("objects.unit=0.001", "objects.kinds=6"), "lower objects.kinds"),
        (("objects.unit=0.001", "objects.scale=[1.0,3.0]"), "does not fit the gripper"),
        (("objects.path=nowhere",), "objects.path=nowhere is no folder"),
        (("objects.width=0.11",), "does not fit the gripper"),
        (("objects.width=0.05", "objects.scale=[0.9,2.5]"), "does not fit the gripper"),
        (("objects.width=-0.05",), "objects.width=-0.05 must be above 0"),
        (("objects.unit=-0.001",), "objects.unit=-0.001 must be above 0"),
    ],
)
def test_what_cannot_be_used_is_refused(
    config: Callable[..., DictConfig], files: Path, overrides: tuple[str, ...], words: str
) -> None:
    with pytest.raises(InstantiationException) as told:
        _folder(config, files, *overrides)
    assert isinstance(told.value.__cause__, RobotError)
    assert words in str(told.value.__cause__)


def test_what_fits_another_tool_is_told(config: Callable[..., DictConfig], files: Path) -> None:
    trimesh.creation.annulus(45, 60, 30).export(files / "ring.stl")
    with pytest.raises(InstantiationException, match=r"objects\.opening"):
        _folder(config, files, "objects.unit=0.001")
    assert "ring" in _folder(config, files, "objects.unit=0.001", "objects.opening=0.15").files


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("flat.stl", lambda path: trimesh.Trimesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]]).export(path), "no volume"),
        ("text.obj", lambda path: path.write_text("hello"), "text.obj"),
        ("more/box1.stl", lambda path: box(30, 40, 50).export(path), "would be one object"),
        (
            "ring.stl",
            lambda path: trimesh.creation.annulus(45, 60, 30).export(path),
            "mm across and does not fit the gripper's 80 mm",
        ),
    ],
)
def test_bad_files_are_named(
    config: Callable[..., DictConfig], files: Path, name: str, write: Callable[[Path], object], words: str
) -> None:
    write(files / name)
    with pytest.raises(InstantiationException) as told:
        _folder(config, files, "objects.unit=0.001")
    assert isinstance(told.value.__cause__, RobotError)
    assert words in str(told.value.__cause__)


def test_a_run_refuses_them_before_work_starts(tmp_path: Path) -> None:
    command = ["train.py", "objects=folder", f"objects.path={tmp_path}", f"hydra.run.dir={tmp_path}/run", "logger=none"]
    done = subprocess.run(
        [sys.executable, *command], cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert done.stderr.strip().count("\n") == 0
    assert "holds 0 objects" in done.stderr
