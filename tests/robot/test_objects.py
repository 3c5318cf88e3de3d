from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hydra.utils import instantiate

from see2act.datamodules.labels import plane_fit
from see2act.experiment import identity
from see2act.robot import objects
from see2act.robot.household import HOUSEHOLD
from see2act.robot.objects import CATALOGUE, GRIPPER_OPENING, ObjectSet, shape
from see2act.robot.packages import package_file
from see2act.robot.solids import read_mesh
from see2act.robot.types import RobotError

DIVERSE = sorted(set(CATALOGUE) - set(HOUSEHOLD))
"""The set of the simulated benchmark, of which every object must be there for the picking; household objects need not be."""


@pytest.fixture(scope="module")
def diverse(config: Callable) -> ObjectSet:
    return instantiate(config().objects, _convert_="all")


def _is_box(name: str) -> bool:
    parts = shape(name).parts
    return len(parts) == 1 and np.isclose(parts[0].volume, parts[0].bounding_box_oriented.volume, rtol=0.01)


def test_the_paper_s_numbers_of_objects(diverse: ObjectSet) -> None:
    assert (len(diverse.seen), len(diverse.unseen), diverse.kinds, diverse.copies) == (15, 5, 5, 2)


def test_diversity(diverse: ObjectSet) -> None:
    names = (*diverse.seen, *diverse.unseen)
    packaged = {"hexagon", "leaning", "wedge", "taper", "ramp", "bar", "keel", "decagon", "slant"}
    assert sum(_is_box(name) for name in names) <= 4
    assert len(packaged & set(names)) >= 8
    assert sum(_concavity(name) > 0.05 for name in names) >= 5


def _concavity(name: str) -> float:
    """Share of the convex hull that the shape leaves empty."""
    points = np.concatenate([part.vertices for part in shape(name).parts])
    return 1 - shape(name).volume / trimesh.convex.convex_hull(points).volume


def test_no_unseen_object_is_a_rescaled_seen_one(diverse: ObjectSet) -> None:
    def form(name: str) -> np.ndarray:
        """Principal moments of inertia relative to the largest: the same for a shape at any scale and pose."""
        moments = np.sort(np.linalg.eigvalsh(trimesh.util.concatenate(shape(name).parts).moment_inertia))
        return np.append(moments[:2] / moments[2], _concavity(name))

    seen = {name: form(name) for name in diverse.seen}
    for name in diverse.unseen:
        for other, known in seen.items():
            assert np.abs(form(name) - known).max() > 0.05, f"{name} looks like {other}"


@pytest.mark.parametrize("name", DIVERSE)
def test_shape_is_centred_convex_parts_that_fit_the_gripper(name: str) -> None:
    parts = shape(name).parts
    centre = sum(p.volume * p.center_mass for p in parts) / shape(name).volume
    assert np.allclose(centre, 0, atol=1e-9)
    assert all(part.is_volume and part.is_convex for part in parts)
    assert shape(name).width * 1.2 <= GRIPPER_OPENING
    assert shape(name).obj().count("\no ") + 1 == len(parts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": (0.8, 3.0)}, "does not fit the gripper's 80 mm"),
        ({"scale": (0.8, 1.7), "seen": ("channel", "brick", "can", "ell", "tee")}, "'channel' at scale 1.7 is 85 mm across"),
        ({"scale": (1.2, 0.8)}, r"0 < low <= high, got \[1.2, 0.8\]"),
        ({"seen": ("cube", "teapot", "can", "ell", "tee")}, "no object is called 'teapot'"),
        ({"seen": ("cube",)}, "lists 1 objects, a scene needs 5"),
        ({"unseen": ("cube", "arch", "zed", "slant", "channel")}, r"share \['cube'\]"),
    ],
)
def test_bad_sets_are_refused(changes: dict, message: str) -> None:
    good = {"seen": ("cube", "brick", "can", "ell", "tee"), "unseen": ("arch", "zed", "slant", "channel", "decagon")}
    with pytest.raises(RobotError, match=message):
        ObjectSet("mine", **{**good, **changes})


def test_a_shape_without_volume_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    monkeypatch.setitem(objects.CATALOGUE, "sheet", lambda: [flat])
    with pytest.raises(RobotError, match="'sheet' has a part without volume"):
        shape("sheet")


def test_an_object_file_that_is_no_solid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"mug\.stl does not exist"):
        read_mesh(tmp_path / "mug.stl")
    (tmp_path / "text.obj").write_text("this is no mesh")
    with pytest.raises(RobotError, match=r"text\.obj (is no mesh|has no volume)"):
        read_mesh(tmp_path / "text.obj")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "sheet.stl")
    with pytest.raises(RobotError, match=r"sheet\.stl has no volume"):
        read_mesh(tmp_path / "sheet.stl")


def _height_from_above(name: str, pose: np.ndarray, pixel: float, half: int) -> np.ndarray:
    """Height of a posed shape on a square grid, metres; NaN beside it. Exact for convex parts."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1] * pixel
    best = np.full(x.shape, np.nan)
    for part in shape(name).parts:
        posed = part.copy().apply_transform(pose)
        top, bottom = np.full(x.shape, np.inf), np.full(x.shape, -np.inf)
        for n, point in zip(posed.face_normals, posed.triangles[:, 0], strict=True):
            distance = n @ point - n[0] * x - n[1] * y
            if n[2] > 1e-6:
                top = np.minimum(top, distance / n[2])
            elif n[2] < -1e-6:
                bottom = np.maximum(bottom, distance / n[2])
            else:
                top[distance < 0] = -np.inf
        best = np.fmax(best, np.where(top > bottom, top, np.nan))
    return best


@pytest.mark.parametrize("name", DIVERSE)
def test_however_it_lies_some_face_suits_the_cup(name: str) -> None:
    """In every pose it can come to rest in, at the smallest scale, the cup (18 mm, 30 degrees) finds a place."""
    points = np.concatenate([part.vertices for part in shape(name).parts])
    hull = trimesh.convex.convex_hull(points)
    poses, likely = trimesh.poses.compute_stable_poses(hull, center_mass=np.zeros(3), n_samples=1)
    pixel, rim = 0.001 / 0.8, 9  # millimetres at scale 0.8
    for pose, probability in zip(poses, likely, strict=True):
        if probability < 0.03:
            continue
        height = _height_from_above(name, pose, pixel, 60)
        tilt, rms = plane_fit(np.nan_to_num(height, nan=-1.0), pixel, rim)
        suits = (tilt < np.radians(27)) & (rms < 0.0012)
        assert (suits & np.isfinite(height)).any(), f"lying with probability {probability:.2f} it shows no face: {pose[:3, :3]}"


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for distribution in ("no-such-package", "numpy"):
        with pytest.raises(RobotError, match=f"not in an installed package {distribution}: run `make install`"):
            package_file(distribution, "*/ur5.urdf")
    monkeypatch.setattr(identity, "PACKAGES", ("numpy", "no-such-package"))
    assert identity.packages() == {"python": "3.11", "numpy": np.__version__, "no-such-package": "none"}
