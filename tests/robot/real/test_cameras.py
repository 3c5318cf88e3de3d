from __future__ import annotations

import ctypes
import json
import logging
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.stand_in.recording import Images, Lens, SoftwareCamera, record
from see2act.robot.real import librealsense
from see2act.robot.real import realsense as module
from see2act.robot.real.camera import CameraError, DepthCamera, Frame
from see2act.robot.real.image_folder import Description, ImageFolder, describe, write_pair
from see2act.robot.real.realsense import RealSense

W, H = 320, 240
SMALL = (96, 72, 69.0, 69.3, 48.5, 34.5)
COLOR, DEPTH = Lens(W, H, 230, 231, 161.5, 117), Lens(W, H, 225, 225, 158, 121)
BOX = np.array([[-0.13, -0.06], [0.04, 0.09]])
"""Corners (x, y) of the face of the box, 0.6 m in front of the colour camera; the floor is at about 0.8 m. Metres."""
BENDS = {
    "brown_conrady": (-0.15, 0.05, 0.004, -0.006, 0.02),
    "inverse_brown_conrady": (-0.15, 0.05, 0.004, -0.006, 0.02),
    "modified_brown_conrady": (-0.15, 0.05, 0.004, -0.006, 0.02),
    "kannala_brandt4": (-0.05, 0.02, 0.001, 0.002, 0.0),
}


def pixels(lens: Lens) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1)


def pinhole_rays(lens: Lens) -> np.ndarray:
    x, y = np.moveaxis(pixels(lens), -1, 0)
    return np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, np.ones(x.shape)], -1)


@cache
def rays(lens: Lens) -> np.ndarray:
    """Ray that librealsense projects to each pixel. Found by steps, so that no inverse of librealsense is trusted."""
    project, intrinsics = librealsense.library().rs2_project_point_to_pixel, lens.intrinsics()
    result, goal = pinhole_rays(lens).reshape(-1, 3), pixels(lens).reshape(-1, 2)
    for _ in range(20):
        missed = goal - [project(intrinsics, ray) for ray in result.tolist()]
        result[:, :2] += 0.9 * missed / [lens.fx, lens.fy]
    assert np.abs(missed).max() < 0.01
    return result.reshape(lens.height, lens.width, 3)


def scene(rays: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Depth of a tilted floor and a box. ``pose`` is that of the camera in the frame of the colour camera."""
    way, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    normal = np.array([0.1, -0.05, 1.0])
    floor = (0.8 - normal @ origin) / (way @ normal)
    face = (0.6 - origin[2]) / way[..., 2]
    x, y = (origin[:2] + way[..., :2] * face[..., None]).transpose(2, 0, 1)
    on_box = (x > BOX[0, 0]) & (x < BOX[1, 0]) & (y > BOX[0, 1]) & (y < BOX[1, 1])
    return np.where(on_box, face, floor)


def paint(rays: np.ndarray) -> np.ndarray:
    """A smooth pattern on what the colour camera sees."""
    x, y = rays[..., 0], rays[..., 1]
    waves = np.stack([np.sin(20 * x), np.cos(17 * y), np.sin(14 * (x + y))], -1)
    return (128 + 100 * waves).round().astype(np.uint8)


def counts(depth: np.ndarray, unit: float = 0.001) -> np.ndarray:
    return np.round(depth / unit).astype(np.uint16)


FLAT: Images = (np.full((H, W, 3), 90, np.uint8), np.full((H, W), 700, np.uint16))


def realsense(recording: Path | None = None, serial: str | int | None = None, frames: int = 3, **more: Any) -> RealSense:
    values: dict[str, Any] = {"name": "test", "width": W, "height": H, "fps": 30, "timeout": 1.0} | more
    return RealSense(serial=serial, frames=frames, recording=str(recording) if recording else None, **values)


@contextmanager
def opened(camera: DepthCamera) -> Iterator[DepthCamera]:
    camera.open()
    try:
        yield camera
    finally:
        camera.close()


class Feed:
    """Shows a software camera images, about 200 a second, until told to stop."""

    def __init__(self, camera: SoftwareCamera, images: Callable[[], Images]):
        self._camera, self._images, self._end = camera, images, Event()
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> Feed:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(0.005):
            self._camera.show(*self._images())


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes librealsense find software cameras in place of those at the computer."""
    return lambda *cameras: monkeypatch.setattr(librealsense, "connected", lambda _: [camera.device for camera in cameras])


@pytest.fixture(autouse=True)
def warm_up(monkeypatch: pytest.MonkeyPatch) -> int:
    """How many images a camera throws away at its start; in these tests fewer, as their exposure is right. And their recordings
    are short."""
    usual = module.WARM_UP
    monkeypatch.setattr(module, "WARM_UP", 3)
    monkeypatch.setattr(module, "END", 0.3)
    return usual


# RealSense


def test_a_recording_gives_back_colour_depth_intrinsics_and_serial(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    depth = rng.integers(800, 60000, (H, W)).astype(np.uint16)
    depth[::7] = 0
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR, serial="814412", unit=0.0001), [(color, depth)] * 10)
    with opened(realsense(tmp_path / "a.db3")) as camera:
        frame = camera.read()
        assert camera.serial == "814412"
        assert camera.intrinsics.tolist() == [[230, 0, 161.5], [0, 231, 117], [0, 0, 1]]
    assert (frame.color == color).all()
    assert frame.depth.dtype == np.float32
    assert np.abs(frame.depth - depth * 0.0001).max() < 1e-6
    assert (frame.depth[::7] == 0).all()


def test_a_recording_that_ends_is_played_again(tmp_path: Path) -> None:
    images = [(np.full_like(FLAT[0], 10 * i), FLAT[1] + np.uint16(i)) for i in range(1, 6)]
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR), images)
    with opened(realsense(tmp_path / "a.db3", frames=1)) as camera:
        for _ in range(3):
            frame = camera.read()
            assert frame.color[0, 0, 0] / 10 == pytest.approx(1000 * frame.depth[0, 0] - 700, abs=1e-3)  # of one moment


def test_depth_is_that_of_the_colour_cameras_pixels_along_its_axis(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.02, -0.03, 0.01]).as_matrix()
    pose[:3, 3] = [-0.03, 0.004, 0.025]
    raw = counts(scene(pinhole_rays(DEPTH), pose), 0.0001)
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, DEPTH, pose, unit=0.0001), [(FLAT[0], raw)] * 10)
    with opened(realsense(tmp_path / "a.db3")) as camera:
        depth = camera.read().depth[15:-15, 40:-40]
    expected = scene(pinhole_rays(COLOR), np.eye(4))[15:-15, 40:-40]
    near = expected < 0.62
    border = cv2.dilate(near.astype(np.uint8), np.ones((3, 3))) != cv2.erode(near.astype(np.uint8), np.ones((3, 3)))
    seen = depth > 0
    assert (near & seen).sum() > 3000
    assert np.abs(depth - expected)[seen & ~border].max() < 0.0006
    # What the box hides from the depth camera lies on its one side; everything else is seen.
    hidden = np.zeros_like(near)
    hidden[:, 12:] = near[:, :-12]
    assert seen[~hidden & ~border].all()
    assert 0.5 < (~seen & hidden & ~near).sum() / (230 * 0.03 * (1 / 0.6 - 1 / 0.79) * np.ptp(np.nonzero(near)[0])) < 1.5


@pytest.mark.parametrize("model", BENDS)
def test_a_lens_is_taken_out_of_colour_and_depth(tmp_path: Path, model: str) -> None:
    lens, straight = Lens(*SMALL, model, BENDS[model]), Lens(*SMALL)
    bent = rays(lens)
    assert np.abs(bent - pinhole_rays(lens)).max() * lens.fx > 2  # pixels
    depth = counts(scene(pinhole_rays(DEPTH), np.eye(4)), 0.0001)
    record(tmp_path / "a.db3", SoftwareCamera(lens, DEPTH, unit=0.0001), [(paint(bent), depth)] * 10)
    with opened(realsense(tmp_path / "a.db3")) as camera:
        assert_straight(camera.read(), straight)


def test_a_lens_of_the_depth_camera_is_taken_out(tmp_path: Path) -> None:
    lens, straight = Lens(*SMALL, "inverse_brown_conrady", BENDS["inverse_brown_conrady"]), Lens(*SMALL)
    depth = counts(scene(rays(lens), np.eye(4)), 0.0001)
    record(tmp_path / "a.db3", SoftwareCamera(straight, lens, unit=0.0001), [(paint(pinhole_rays(straight)), depth)] * 10)
    with opened(realsense(tmp_path / "a.db3")) as camera:
        assert_straight(camera.read(), straight)


def assert_straight(frame: Frame, lens: Lens) -> None:
    """The frame shows the scene as a pinhole camera would."""
    shown = (frame.color > 0).all(-1)  # and not from outside the image
    assert shown.mean() > 0.85
    inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3)), borderValue=0) > 0
    assert np.abs(frame.color - paint(pinhole_rays(lens)).astype(float))[inner].max() < 5
    expected = scene(pinhole_rays(lens), np.eye(4))
    assert (frame.depth > 0).mean() > 0.85
    assert (np.abs(frame.depth - expected)[frame.depth > 0] > 0.002).mean() < 0.01  # only at the border of the box


def test_a_lens_of_the_depth_camera_without_an_inverse_is_refused(tmp_path: Path) -> None:
    lens = Lens(*SMALL, "modified_brown_conrady", BENDS["modified_brown_conrady"])
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, lens), [FLAT] * 10)
    with pytest.raises(CameraError, match="modified_brown_conrady"):
        realsense(tmp_path / "a.db3").open()


def test_the_median_of_several_images_has_less_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = [
        (rng.normal(120, 9, (H, W, 3)).astype(np.uint8), rng.normal(7000, 50, (H, W)).astype(np.uint16)) for _ in range(40)
    ]
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR, unit=0.0001), images)
    with opened(realsense(tmp_path / "a.db3", frames=15)) as camera:
        frame = camera.read()
    assert frame.depth.std() < 0.005 / 2.5
    assert frame.depth.mean() == pytest.approx(0.7, abs=1e-4)
    assert frame.color.std() < 9 / 2.5


def test_a_pixel_is_read_if_half_of_the_images_have_it_and_never_between_two_surfaces(tmp_path: Path) -> None:
    even, odd = FLAT[1].copy(), FLAT[1].copy()
    even[0], odd[1, :], even[1, :] = 0, 0, 0
    even[2], odd[2] = 600, 800
    images = [(FLAT[0], depth) for depth in (even, odd)]
    third = FLAT[1].copy()
    third[0] = 0
    with_third = [(FLAT[0], depth) for depth in (even, third, odd)]
    record(tmp_path / "two.db3", SoftwareCamera(COLOR, COLOR), images * 4)
    record(tmp_path / "three.db3", SoftwareCamera(COLOR, COLOR), with_third * 4)
    with opened(realsense(tmp_path / "two.db3", frames=4)) as camera:
        depth = camera.read().depth
    assert np.allclose(depth[0], 0.7)  # in two of four
    assert (depth[1] == 0).all()
    assert np.isin(np.round(1000 * depth[2]), (600, 800)).all()
    with opened(realsense(tmp_path / "three.db3", frames=3)) as camera:
        assert (camera.read().depth[0] == 0).all()  # in one of three


def test_a_reading_holds_nothing_from_before_it_was_asked_for(connect: Callable[..., None]) -> None:
    camera = SoftwareCamera(COLOR, COLOR)
    connect(camera)
    level, late = [10], [10]

    def images() -> Images:  # an image arrives when the next one is exposed
        late.append(level[0])
        return np.full_like(FLAT[0], late.pop(0)), FLAT[1]

    with Feed(camera, images), opened(realsense(frames=1)) as station:
        for value in (60, 120, 180):
            Event().wait(0.05)
            level[0] = value
            assert (station.read().color == value).all()


def test_the_images_in_which_exposure_settles_are_thrown_away(
    connect: Callable[..., None], monkeypatch: pytest.MonkeyPatch, warm_up: int
) -> None:
    monkeypatch.setattr(module, "WARM_UP", warm_up)
    camera = SoftwareCamera(COLOR, COLOR)
    connect(camera)
    dark = [(FLAT[0] // 2, FLAT[1])] * 30
    with Feed(camera, lambda: dark.pop() if dark else FLAT), opened(realsense()) as station:
        assert (station.read().color == FLAT[0]).all()


def test_a_lost_camera_is_said_in_time_and_can_be_closed(connect: Callable[..., None]) -> None:
    camera = SoftwareCamera(COLOR, COLOR, serial="42")
    connect(camera)
    station = realsense(timeout=0.3)
    with Feed(camera, lambda: FLAT) as feed:
        station.open()
        station.read()
        feed.stop()
        start = monotonic()
        for _ in range(2):
            with pytest.raises(CameraError, match=r"42 gives no images .*plug it out and in again"):
                station.read()
        station.close()
        assert monotonic() - start < 2
    with pytest.raises(CameraError, match="not open"):
        station.read()


def test_colour_that_stands_still_is_not_taken_for_new(connect: Callable[..., None]) -> None:
    camera = SoftwareCamera(COLOR, COLOR)
    connect(camera)
    with Feed(camera, lambda: FLAT), opened(realsense(timeout=0.5)) as station:
        station.read()
        show, camera._color = camera._color.on_video_frame, type("Dead", (), {"on_video_frame": lambda *_: None})()
        with pytest.raises(CameraError, match="gives no images"):
            station.read()
        assert show


def test_one_camera_is_found_and_several_must_be_chosen_from(connect: Callable[..., None]) -> None:
    first, second = SoftwareCamera(COLOR, COLOR, serial="111"), SoftwareCamera(COLOR, COLOR, serial="222")
    connect(first)
    with Feed(first, lambda: FLAT), opened(realsense()) as station:
        assert station.serial == "111"
    connect(first, second)
    with pytest.raises(CameraError, match=r"several.*111 .*222 .*camera\.serial"):
        realsense().open()
    with Feed(second, lambda: FLAT), opened(realsense(serial=222)) as station:
        assert station.serial == "222"
    with pytest.raises(CameraError, match=r"333 is not connected.*111 .*222"):
        realsense(serial="333").open()
    connect()
    with pytest.raises(CameraError, match="no RealSense camera is connected"):
        realsense().open()


def test_without_a_camera_at_the_computer_one_line_says_so() -> None:
    if librealsense.connected(librealsense.library().context()):
        pytest.skip("there is one")
    with pytest.raises(CameraError, match="no RealSense camera is connected"):
        realsense().open()


def test_a_slow_link_is_warned_of(connect: Callable[..., None], caplog: pytest.LogCaptureFixture) -> None:
    for usb, warns in (("3.2", False), ("2.1", True)):
        camera = SoftwareCamera(COLOR, COLOR, usb=usb)
        connect(camera)
        with caplog.at_level(logging.WARNING), Feed(camera, lambda: FLAT), opened(realsense()):
            assert ("USB 2" in caplog.text) == warns


def test_a_size_that_the_camera_lacks_is_answered_with_those_it_has(connect: Callable[..., None]) -> None:
    connect(SoftwareCamera(COLOR, COLOR, serial="42"))
    with pytest.raises(CameraError, match=r"42 does not give .* 640 x 480 pixels at 30 .*320 x 240 at 30"):
        realsense(width=640, height=480).open()


def test_a_recording_that_is_missing_or_damaged_or_of_another_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"no recording .*none\.db3"):
        realsense(tmp_path / "none.db3").open()
    (tmp_path / "junk.db3").write_bytes(b"junk" * 1000)
    with pytest.raises(CameraError, match=r"junk\.db3 is no recording"):
        realsense(tmp_path / "junk.db3").open()
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR, serial="111"), [FLAT] * 10)
    with pytest.raises(CameraError, match="of camera 111"):
        realsense(tmp_path / "a.db3", serial="222").open()
    with opened(realsense(tmp_path / "a.db3", serial="111")) as camera:
        camera.read()


def test_a_camera_that_is_not_open_says_so(tmp_path: Path) -> None:
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR), [FLAT] * 10)
    describe(tmp_path, DESCRIPTION)
    for camera in (realsense(tmp_path / "a.db3"), ImageFolder("test", str(tmp_path), 1, 1.0)):
        camera.close()
        for _ in range(2):
            for use in (lambda c: c.serial, lambda c: c.intrinsics, lambda c: c.read()):
                with pytest.raises(CameraError, match="test is not open"):
                    use(camera)
            camera.open()  # and it may be opened again
            assert camera.serial
            camera.close()
            camera.close()


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(CameraError, match=r"needs the package pyrealsense2 .*pip install 'see2act\[real\]'"):
        realsense().open()

    def missing(*_: object, **__: object) -> None:
        raise OSError("cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", missing)
    for package in (sys.modules.get("libusb_package"), None):
        monkeypatch.setitem(sys.modules, "libusb_package", package)
        with pytest.raises(CameraError, match=r"libusb: pip install 'see2act\[real\]' or apt install libusb-1\.0-0"):
            realsense().open()


def test_building_touches_nothing_and_a_camera_left_open_does_not_hold_up_the_end(tmp_path: Path) -> None:
    record(tmp_path / "a.db3", SoftwareCamera(COLOR, COLOR), [FLAT] * 40)
    code = f"""
import sys
from see2act.robot.real.realsense import RealSense
camera = RealSense("test", None, 320, 240, 30, 3, {str(tmp_path / "a.db3")!r}, 2.0)
assert not {{"pyrealsense2", "libusb_package"}} & set(sys.modules)
camera.open()
print(camera.read().depth.mean())
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr) == (0, "")
    assert float(result.stdout) == pytest.approx(0.7)


# ImageFolder

DESCRIPTION = Description(serial="zed", width=W, height=H, fx=230, fy=231, cx=161.5, cy=117, depth_scale=0.0001)


class Program:
    """The program of another camera: a new shot every few milliseconds, and the last few are kept."""

    def __init__(self, folder: Path, shot: Callable[[int], tuple[np.ndarray, np.ndarray]], scale: float | None, keep: int = 4):
        self._folder, self._shot, self._scale, self._keep = folder, shot, scale, keep
        self.count, self._end = 0, Event()
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> Program:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(0.01):
            color, depth = self._shot(self.count + 1)
            write_pair(self._folder, str(self.count + 1), color, depth, self._scale)
            self.count += 1
            for old in self._folder.glob(f"{self.count - self._keep}.*"):
                old.unlink()


def folder_camera(folder: Path, frames: int = 1, timeout: float = 1.0) -> ImageFolder:
    return ImageFolder("test", str(folder), frames, timeout)


def read(folder: Path, frames: int = 1, timeout: float = 1.0) -> Frame:
    with opened(folder_camera(folder, frames, timeout)) as camera:
        return camera.read()


@pytest.mark.parametrize("scale", [0.0001, None])
def test_a_folder_gives_back_what_was_written_to_it(tmp_path: Path, scale: float | None) -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    depth = rng.uniform(0.4, 1.2, (H, W)).astype(np.float32)
    depth[::5] = 0
    describe(tmp_path, DESCRIPTION)
    with Program(tmp_path, lambda _: (color, depth), scale), opened(folder_camera(tmp_path)) as camera:
        frame = camera.read()
        assert camera.serial == "zed"
        assert camera.intrinsics.tolist() == [[230, 0, 161.5], [0, 231, 117], [0, 0, 1]]
    assert (frame.color == color).all()
    assert frame.depth.dtype == np.float32
    assert np.abs(frame.depth - depth).max() < 0.51e-4
    assert (frame.depth[::5] == 0).all()


def test_a_shot_from_a_folder_is_newer_than_the_call(tmp_path: Path) -> None:
    describe(tmp_path, DESCRIPTION)

    def shot(number: int) -> tuple[np.ndarray, np.ndarray]:
        return np.full((H, W, 3), number % 256, np.uint8), np.full((H, W), 0.7)

    with Program(tmp_path, shot, 0.0001) as program, opened(folder_camera(tmp_path)) as camera:
        for _ in range(4):
            before = program.count
            assert int(camera.read().color[0, 0, 0]) >= before + 2  # the next one may have been taken before the call


def test_the_median_of_several_shots_has_less_noise_and_skips_what_is_no_reading(tmp_path: Path) -> None:
    describe(tmp_path, DESCRIPTION)
    rng = np.random.default_rng(0)

    def shot(number: int) -> tuple[np.ndarray, np.ndarray]:
        depth = rng.normal(0.7, 0.005, (H, W))
        depth[0, : W // 2], depth[0, W // 2 :], depth[1] = np.nan, -np.inf, (0.5, 0)[number % 3 == 0]
        return rng.normal(120, 9, (H, W, 3)).astype(np.uint8), depth

    with Program(tmp_path, shot, None):
        frame = read(tmp_path, frames=9)
    assert frame.depth[2:].std() < 0.005 / 2
    assert frame.color.std() < 9 / 2
    assert (frame.depth[0] == 0).all()
    assert np.allclose(frame.depth[1], 0.5)


def test_distortion_is_taken_out_of_a_folders_images(tmp_path: Path) -> None:
    lens = Lens(*SMALL, "brown_conrady", BENDS["brown_conrady"])
    bent = rays(lens)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(lens, name) for name in names} | {"distortion": tuple(lens.coefficients)}
    describe(tmp_path, DESCRIPTION.model_copy(update=values))
    with Program(tmp_path, lambda _: (paint(bent), scene(bent, np.eye(4))), 0.0001):
        assert_straight(read(tmp_path), Lens(*SMALL))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": None}, "fx"),
        ({"fx": -1}, "fx"),
        ({"depth_scale": "1 mm"}, "depth_scale"),
        ({"distorsion": [0, 0, 0, 0, 0]}, "distorsion"),
        ({"distortion": [0, 0]}, "distortion"),
    ],
)
def test_a_bad_description_is_refused_by_the_name_of_its_key(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    values = DESCRIPTION.model_dump(mode="json") | change
    (tmp_path / "camera.json").write_text(json.dumps({key: value for key, value in values.items() if value is not None}))
    with pytest.raises(CameraError, match=rf"camera\.json: {says}"):
        folder_camera(tmp_path).open()


def test_a_missing_folder_or_description_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"no folder .*nowhere"):
        folder_camera(tmp_path / "nowhere").open()
    with pytest.raises(CameraError, match=r"no .*camera\.json.*depth_scale"):
        folder_camera(tmp_path).open()
    (tmp_path / "camera.json").write_text("{")
    with pytest.raises(CameraError, match=r"camera\.json: .*JSON"):
        folder_camera(tmp_path).open()


def test_without_a_new_shot_the_age_of_the_last_one_is_said(tmp_path: Path) -> None:
    describe(tmp_path, DESCRIPTION)
    with pytest.raises(CameraError, match="no old one"):
        read(tmp_path, timeout=0.1)
    write_pair(tmp_path, "shot7", FLAT[0], FLAT[1] / 1000, 0.0001)
    with pytest.raises(CameraError, match=r"no new image for 0\.1 s .*shot7, is \d\.\d s old"):
        read(tmp_path, timeout=0.1)


@pytest.mark.parametrize(
    ("color", "depth", "says"),
    [
        ((H, W, 3), (H, W - 1), "320 x 240 pixels of colour and 319 x 240 of depth"),
        ((H - 1, W, 3), (H - 1, W), r"camera\.json says 320 x 240"),
    ],
)
def test_images_of_other_sizes_are_refused(tmp_path: Path, color: tuple[int, ...], depth: tuple[int, ...], says: str) -> None:
    describe(tmp_path, DESCRIPTION)
    shot = np.zeros(color, np.uint8), np.ones(depth)
    with Program(tmp_path, lambda _: shot, None), pytest.raises(CameraError, match=says):
        read(tmp_path)


@pytest.mark.parametrize("ending", ["color.png", "depth.png", "depth.npy"])
def test_a_file_is_waited_for_until_it_is_whole_or_named_when_it_never_is(tmp_path: Path, ending: str) -> None:
    describe(tmp_path, DESCRIPTION)
    folder, whole = tmp_path / "slow", tmp_path / "whole"
    folder.mkdir()
    describe(folder, DESCRIPTION)
    write_pair(whole, "shot", FLAT[0], FLAT[1] / 1000, None if ending.endswith("npy") else 0.0001)
    data = (whole / f"shot.{ending}").read_bytes()

    def write(name: str, to: int) -> None:
        for file in whole.iterdir():
            target = folder / file.name.replace("shot", name)
            target.write_bytes(data[:to] if file.name == f"shot.{ending}" else file.read_bytes())

    def program(to: int) -> None:
        for number in range(6):
            Event().wait(0.04)
            write(str(number), len(data) // 2)
            Event().wait(0.04)
            write(str(number), to)

    for to in (len(data), len(data) * 3 // 4):
        thread = Thread(target=program, args=(to,))
        thread.start()
        if to == len(data):
            assert np.allclose(read(folder, timeout=2.0).depth, 0.7)
        else:
            with pytest.raises(CameraError, match=rf"{ending} is cut short.*rename"):
                read(folder, timeout=0.3)
        thread.join()
        for file in folder.glob("*.*.*"):
            file.unlink()


def test_depth_of_the_wrong_kind_is_refused(tmp_path: Path) -> None:
    describe(tmp_path, DESCRIPTION)

    def program(ending: str, data: bytes) -> None:
        color = cv2.imencode(".png", FLAT[0])[1].tobytes()
        for number in range(6):
            Event().wait(0.04)
            (tmp_path / f"{ending}{number}.depth.{ending}").write_bytes(data)
            (tmp_path / f"{ending}{number}.color.png").write_bytes(color)

    np.save(tmp_path / "counts.npy", FLAT[1])
    eight = cv2.imencode(".png", FLAT[0][..., 0])[1].tobytes()
    for ending, data, says in (
        ("png", eight, "one channel of 16 bits"),
        ("npy", (tmp_path / "counts.npy").read_bytes(), "floats"),
    ):
        thread = Thread(target=program, args=(ending, data))
        thread.start()
        with pytest.raises(CameraError, match=says):
            read(tmp_path)
        thread.join()


def test_shots_may_be_deleted_at_any_time(tmp_path: Path) -> None:
    describe(tmp_path, DESCRIPTION)
    with Program(tmp_path, lambda _: (FLAT[0], FLAT[1] / 1000), 0.0001, keep=1), opened(folder_camera(tmp_path, 5)) as camera:
        for _ in range(5):
            assert np.allclose(camera.read().depth, 0.7)
