"""Makes the pictures of robot.md and the diagram of architecture.md: `python docs/pictures.py`."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from omegaconf import DictConfig

from see2act.experiment import build
from see2act.experiment.config import composed
from see2act.robot.oracle import oracle
from see2act.robot.simulated import SimulatedRobot
from see2act.robot.video import BYSTANDER

DOCS = Path(__file__).parent
SCENE = 4


def make(*overrides: str) -> tuple[SimulatedRobot, DictConfig]:
    """The default robot, and its configuration."""
    cfg = composed(overrides)
    return build.robot_factory(cfg, cfg.primitive)(), cfg


def objects() -> np.ndarray:
    """All objects, each alone in the bin and seen from the same place."""
    robot, cfg = make()
    view = replace(BYSTANDER, position=(0.15, -0.22, 0.2), target=(0, 0, 0.015), width=320, height=240, focal=430.0)
    tiles = []
    for split in ("seen", "unseen"):
        for i, name in enumerate(cfg.objects[split]):
            robot._build()
            color = np.array(colormaps["rainbow"](i / 14)[:3]) if split == "seen" else np.array([0.9, 0.75, 0.2])
            robot.scene._add(name, 1.0, (0.0, 0.0, 0.05), np.array([0.0, 0.0, 0.26, 0.97]), tuple(color))
            robot.scene.settle(480)
            tile = view.render(robot.simulation)[0].copy()
            tiles.append(label(tile, name if split == "seen" else f"{name} (unseen)"))
    robot.close()
    return np.vstack([np.hstack(tiles[i : i + 5]) for i in range(0, 20, 5)])


def scene() -> np.ndarray:
    """A full bin: as a bystander sees it, as the camera does, and the heightmap."""
    robot, _ = make()
    robot.reset(SCENE, "seen")
    observation = robot.observe()
    heightmap = observation.heightmap
    height = (colormaps["viridis"]((heightmap.height / 0.1).clip(0, 1))[..., :3] * 255).astype(np.uint8)
    tiles = {
        "a bystander": BYSTANDER.render(robot.simulation)[0][:, 80:560],
        "camera=side": observation.color[:, 80:560],
        "heightmap: color": heightmap.color,
        "heightmap: height, 0 to 10 cm": height,
    }
    robot.close()
    return np.hstack([label(fit(tile, 360), name) for name, tile in tiles.items()])


def tools() -> np.ndarray:
    """The two end effectors, near."""
    tiles = []
    for primitive in ("suction", "grasp"):
        robot, _ = make(f"primitive={primitive}")
        robot._build()
        robot.arm.teleport(robot.arm.solve(np.array([0.0, 0.0, 0.3]), np.pi / 4))
        view = replace(BYSTANDER, position=(0.35, -0.35, 0.35), target=(0, 0, 0.2), width=480, height=480, focal=560.0)
        tiles.append(label(view.render(robot.simulation)[0], primitive))
        robot.close()
    return np.hstack(tiles)


def pick(primitive: str) -> np.ndarray:
    """A pick by the oracle, in four pictures."""
    robot, cfg = make(f"primitive={primitive}")
    robot.reset(SCENE, "seen")
    heightmap = robot.observe().heightmap
    logits = oracle(robot, cfg.primitive.angles)(heightmap.color, heightmap.height)
    angle, row, col = (int(i) for i in np.unravel_index(logits.argmax(), logits.shape))
    chosen = robot.workspace.pick(heightmap, row, col, angle * np.pi / cfg.primitive.angles)
    view = replace(BYSTANDER, target=(chosen.x, chosen.y, 0.1), width=360, height=400, focal=750.0)
    frames: list[np.ndarray] = []
    lowest = float(robot.tool.depth_at(np.array(chosen.z)))

    def watch() -> None:
        tip = robot.arm.tool_position()[2] - robot.tool.length()
        moments = (tip < lowest + 0.06, tip < lowest + 0.002, tip > lowest + 0.03, tip > lowest + 0.095)
        if len(frames) < 4 and moments[len(frames)]:
            frames.append(view.render(robot.simulation)[0])

    robot.simulation.after_step = watch
    outcome = robot.execute(chosen)
    robot.close()
    assert outcome.truth, "the picture should show a pick that succeeds"
    words = ("descend", "seal" if primitive == "suction" else "close", "lift", "sense")
    return np.hstack([label(frame, f"{primitive}: {word}") for frame, word in zip(frames, words, strict=True)])


def fit(picture: np.ndarray, side: int) -> np.ndarray:
    """A picture as a square of ``side`` pixels."""
    short = min(picture.shape[:2])
    top, left = ((length - short) // 2 for length in picture.shape[:2])
    square = picture[top : top + short, left : left + short]
    return cv2.resize(square, (side, side), interpolation=cv2.INTER_NEAREST if short < side else cv2.INTER_AREA)


def label(picture: np.ndarray, text: str) -> np.ndarray:
    """With ``text`` in its upper left corner."""
    picture = np.ascontiguousarray(picture)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    cv2.rectangle(picture, (0, 0), (width + 16, height + 14), (40, 40, 40), -1)
    cv2.putText(picture, text, (8, height + 7), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


ATTEMPT = {
    "observe": (("camera image", "robot/camera.py"), ("heightmap", "robot/heightmap.py")),
    "decide": (
        ("rotated heightmaps", "modules/rotation.py"),
        ("logits of success", "modules/network.py"),
        ("affordances", "modules/affordance.py"),
        ("one pixel, one angle", "policy.py"),
        ("pick", "robot/workspace.py"),
    ),
    "act": (("motion of the arm", "robot/simulated.py"), ("sensed outcome", "robot/types.py")),
    "remember": (("replay", "datamodules/replay.py"),),
    "learn": (("learning step", "modules/affordance.py"),),
}
"""What an attempt makes in each step of the loop, and the file in `src/` that makes it."""
WIDE, HIGH = 0.84, 0.34
"""Half of a box."""


def attempt(path: Path) -> None:
    """The data flow of an attempt: columns are the steps of the loop, boxes what they make, with the file that makes it."""
    figure = Figure(figsize=(11, 5.4))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-0.1, 10.9), ylim=(-5.2, 1.1))
    axes.axis("off")
    at: dict[tuple[str, int], tuple[float, float]] = {}
    for column, (step, boxes) in enumerate(ATTEMPT.items()):
        x = 2.2 * column + 0.85
        axes.text(x, 0.75, f"{column + 1}. {step}", ha="center", fontsize=12, weight="bold")
        for i, (name, file) in enumerate(boxes):
            at[step, i] = x, -1.05 * i
            axes.add_patch(FancyBboxPatch((x - 0.8, -1.05 * i - 0.3), 1.6, 0.6, "round,pad=0.04", fc="#e8eef7", ec="#4a6fa5"))
            axes.text(x, -1.05 * i + 0.1, name, ha="center", va="center", fontsize=9)
            axes.text(x, -1.05 * i - 0.15, file, ha="center", va="center", fontsize=7.5, family="monospace", color="#444444")

    def arrow(*points: tuple[float, float], words: str = "") -> None:
        """Through the points; dashed and with words if it is not of the way from image to learning step."""
        style = "--" if words else "-"
        axes.plot(
            *np.array(points[:-1] if len(points) > 2 else points[:1]).T, style, color="black", lw=1, solid_capstyle="butt"
        )
        arrowprops = {"arrowstyle": "-|>", "color": "black", "lw": 1, "ls": style, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", points[-1], points[-2], arrowprops=arrowprops)
        if words:
            (x, y), (u, v) = points[1:3]
            axes.text(
                0.6 * x + 0.4 * u,
                0.6 * y + 0.4 * v,
                words,
                fontsize=9,
                style="italic",
                ha="center",
                va="center",
                bbox={"fc": "white", "ec": "none"},
            )

    places = list(at)
    for here, there in itertools.pairwise(places):
        (x, y), (u, v) = at[here], at[there]
        if here[0] == there[0]:
            arrow((x, y - HIGH), (u, v + HIGH))
        else:
            gutter = (x + u) / 2
            arrow((x + WIDE, y), (gutter, y), (gutter, v), (u - WIDE, v))
    (x, y), (u, v) = at["learn", 0], at["decide", 1]
    arrow((x, y - HIGH), (x, -4.9), (u - WIDE - 0.2, -4.9), (u - WIDE - 0.2, v), (u - WIDE, v), words="new weights")
    (x, y), (u, v) = at["learn", 0], at["remember", 0]
    arrow((x - 0.4, y - HIGH), (x - 0.4, -1.05), (u, -1.05), (u, v - HIGH), words="TD errors")
    (x, y), (u, v) = at["act", 1], at["decide", 3]
    arrow((x, y - HIGH), (x, v), (u + WIDE, v), words="failed picks")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    attempt(DOCS / "attempt.png")
    pictures = {"objects": objects(), "scene": scene(), "tools": tools(), "picks": np.vstack([pick("suction"), pick("grasp")])}
    for name, picture in pictures.items():
        cv2.imwrite(str(DOCS / f"{name}.png"), picture[..., ::-1])
