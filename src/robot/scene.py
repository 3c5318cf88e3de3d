"""The table, the bin and the objects in it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from see2act.robot.floors import floor_picture
from see2act.robot.layouts import Layout, Placed, Refusal
from see2act.robot.objects import ObjectSet, random_color, random_rotation
from see2act.robot.simulation import Simulation, file_of
from see2act.robot.textures import TEXTURES
from see2act.robot.types import NotNegative, RobotError, Split

AT_REST, TURNING = 0.01, 0.5
"""m/s and rad/s. An object that moves and turns more slowly than this counts as still."""
STILL_CHECKS, STILL_CHECKS_AT_FIRST = 4, 24
"""Consecutive checks, ten timesteps apart, at which all objects must be still: after an attempt, and in a new scene. A single
check is not enough, because an object that tips over is also slow for a moment."""
TOUCHING = 0.001
"""Two objects nearer than this count as touching, metres."""
FLOORS = ("plain", "textured")
SHEET = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
f 1/1/1 2/2/1 3/3/1
f 1/1/1 3/3/1 4/4/1
"""
"""Wavefront OBJ text of a square that faces up. The lower left of its texture is at the smallest x and y."""
SHEET_ABOVE = 1e-4
"""Height of the floor's picture above the floor, metres. The picture has no collision shape."""


@dataclass(frozen=True)
class BinConfig:
    """The bin: an open box around the workspace. Its floor is at z = 0.

    Args:
        wall_height: Metres.
        wall_thickness: Metres.
        friction: Coulomb coefficient of the bin. Bullet multiplies it by that of an object, 0.6. The bin is of smooth plastic,
            so that objects leaning on a wall slide down.
        margin: Metres between the walls and the guides that keep falling objects together.
        drop_height: Metres above the floor from which objects fall.
        touching: Smallest share of a full bin's objects that must touch another one; otherwise the scene is not cluttered.
        settle_steps: Maximum number of timesteps to wait for rest after a reset.
        rest_steps: Maximum number of timesteps to wait for rest after an attempt.
        floor: ``plain`` (grey), or ``textured`` (another material in every scene).
        distractors: Number of pictures of seen objects printed on a textured floor.

    Raises:
        RobotError: ``floor`` is unknown, ``distractors`` is negative, or distractors are requested on a plain floor.
    """

    wall_height: NotNegative
    wall_thickness: NotNegative
    friction: NotNegative
    margin: NotNegative
    drop_height: NotNegative
    touching: NotNegative
    settle_steps: Annotated[int, Ge(1)]
    rest_steps: Annotated[int, Ge(1)]
    floor: str = "plain"
    distractors: int = 0

    def __post_init__(self) -> None:
        if self.floor not in FLOORS:
            raise RobotError(f"robot.bin.floor={self.floor} is unknown: choose one of {', '.join(FLOORS)}")
        if self.distractors < 0 or (self.distractors and self.floor == "plain"):
            raise RobotError(
                f"robot.bin.distractors={self.distractors} with robot.bin.floor={self.floor}: give 0, or a number above 0 "
                "and robot.bin.floor=textured, which they are printed on"
            )


@dataclass(frozen=True)
class Body:
    """An object in the simulation."""

    id: int
    name: str
    scale: float
    color: tuple[float, float, float]
    transparent: bool
    """Whether the depth sensor sees through it."""


class Scene:
    """Builds the bin, drops objects into it and keeps track of them.

    Args:
        simulation: The world to build the scene in.
        config: Bin and waiting times.
        width: Inner extent of the bin along x, metres.
        length: Inner extent of the bin along y, metres.
        objects: The objects that may be dropped.
        table: Whether the table around the bin is visible. Its collision shape is always present.
    """

    def __init__(
        self, simulation: Simulation, config: BinConfig, width: float, length: float, objects: ObjectSet, table: bool = True
    ):
        self._simulation = simulation
        self._config = config
        self._size = np.array([width, length])
        self._objects = objects
        self._show_table = table
        self._meshes: dict[str, str] = {}
        """Paths by the name of the object."""
        self.bodies: list[Body] = []
        self.wall_height = config.wall_height

    def build(self) -> None:
        """Build the table and the empty bin in an empty simulation."""
        thickness, height = self._config.wall_thickness, self._config.wall_height
        x, y = self._size / 2
        self.bodies = []
        wood = (0.72, 0.65, 0.55) if self._show_table else None
        self.table = self._block((1.0, 0.8, 0.02), (-0.1, 0, -0.03), wood)
        self.floor = self._block((x + thickness, y + thickness, 0.005), (0, 0, -0.005), (0.32, 0.33, 0.35))
        self.walls = self._ring(x, y, thickness / 2, height, (0.25, 0.42, 0.6))

    def paint_floor(self, rng: np.random.Generator) -> None:
        """Draw a new picture for a textured floor and lay it over the floor. Does nothing for a plain floor."""
        if self._config.floor == "plain":
            return
        client, half = self._simulation.client, self._size / 2
        printed = [self._objects.shape(str(name)) for name in rng.choice(self._objects.seen, self._config.distractors)]
        width, length = self._size
        picture = floor_picture(rng, width, length, printed)
        with tempfile.TemporaryDirectory() as folder:  # a new path each time, since Bullet caches textures by path
            image, sheet = Path(folder) / "floor.png", file_of(SHEET.encode(), ".obj")
            cv2.imwrite(str(image), picture[..., ::-1])
            visual = client.createVisualShape(client.GEOM_MESH, fileName=str(sheet), meshScale=[*half, 1])
            body = client.createMultiBody(0, -1, visual, (0, 0, SHEET_ABOVE))
            client.changeVisualShape(body, -1, textureUniqueId=client.loadTexture(str(image)), rgbaColor=(1, 1, 1, 1))

    def drop(self, rng: np.random.Generator, split: Split, count: int | None = None) -> Refusal | None:
        """Drop objects one after the other, all of them or only ``count``, and wait until they are at rest.

        Returns:
            Why the scene is not valid, or None if it is. If it is not valid, start again with another generator.
        """
        client = self._simulation.client
        area = self._size / 2 - self._config.margin
        # Tall guides keep bouncing objects over the bin. They are removed before anything is seen or picked.
        guides = self._ring(area[0], area[1], 0.02, 0.5, None)
        names = rng.choice(self._objects.names(split), self._objects.kinds, replace=False)
        order = rng.permutation(np.repeat(names, self._objects.copies))
        for name in order[:count]:
            position = (*rng.uniform(-area / 2, area / 2), self._config.drop_height)
            self._add(str(name), float(rng.uniform(*self._objects.scale)), position, random_rotation(rng), random_color(rng))
            for _ in range(50):
                self._simulation.step()
        self.settle(self._config.settle_steps)
        for guide in guides:
            client.removeBody(guide)
        return self._come_to_rest(count)

    def _come_to_rest(self, count: int | None) -> Refusal | None:
        if not self.settle(self._config.settle_steps, STILL_CHECKS_AT_FIRST):
            return "restless"
        if not all(self._inside(body) for body in self.bodies):
            return "spilled"
        scattered = count is None and len(self.bodies) > 1 and self.touching() < self._config.touching
        return "scattered" if scattered else None

    def layout(self, refused: tuple[Refusal, ...] = ()) -> Layout:
        """The present positions of all objects."""
        at = self._simulation.client.getBasePositionAndOrientation
        return Layout(tuple(Placed(body.name, body.scale, body.color, *at(body.id)) for body in self.bodies), refused)

    def place(self, layout: Layout, count: int | None = None) -> Refusal | None:
        """Put the objects of a layout, all of them or only ``count``, into the empty bin and wait until they are at rest.

        The objects of a layout were at rest, but Bullet has lost the contact forces between them. If they were put to sleep
        immediately, they would move by half a millimetre when touched, and sometimes topple.

        Returns:
            Why the scene is not valid, or None, as for :meth:`drop`.
        """
        for placed in layout.objects:
            self._add(placed.name, placed.scale, placed.position, np.array(placed.rotation), placed.color)
        return self._come_to_rest(count)

    def settle(self, steps: int | None = None, checks: int = STILL_CHECKS) -> bool:
        """Step until every object is at rest, at most ``steps`` times. Returns whether all of them are.

        Objects at rest are put to sleep. A sleeping object takes no computation until something touches it.
        """
        self.wake()
        still = 0
        for i in range(self._config.rest_steps if steps is None else steps):
            self._simulation.step()
            if i % 10 == 9:
                still = still + 1 if self.at_rest() else 0
                if still == checks:
                    self._sleep()
                    return True
        return False

    def at_rest(self) -> bool:
        """Whether every object moves slower than 1 cm/s and turns slower than 0.5 rad/s."""
        velocities = [self._simulation.client.getBaseVelocity(body.id) for body in self.bodies]
        return all(np.linalg.norm(v) < AT_REST and np.linalg.norm(w) < TURNING for v, w in velocities)

    def touching(self) -> float:
        """Share of the objects that touch another one."""
        near, ids = self._simulation.client.getClosestPoints, [body.id for body in self.bodies]
        return sum(any(near(a, b, TOUCHING) for b in ids if b != a) for a in ids) / max(len(ids), 1)

    def positions(self) -> dict[int, np.ndarray]:
        """World position in metres of each object's centre, by body id."""
        client = self._simulation.client
        return {body.id: np.array(client.getBasePositionAndOrientation(body.id)[0]) for body in self.bodies}

    def remove(self, ids: set[int]) -> None:
        """Remove objects from the world. Objects that lay on them stay asleep until the next :meth:`settle`."""
        for i in ids:
            self._simulation.client.removeBody(i)
        self.bodies = [body for body in self.bodies if body.id not in ids]

    def wake(self) -> None:
        """Wake every object, as if something had touched it."""
        client = self._simulation.client
        # By default Bullet puts an object to sleep once it has been slow for two seconds, even in the middle of tipping over.
        # Disabling this keeps objects awake while they settle. During an attempt it can still happen to objects that the
        # attempt has woken; the settling after the attempt wakes them again.
        self._activate(client.ACTIVATION_STATE_DISABLE_SLEEPING)
        self._activate(client.ACTIVATION_STATE_WAKE_UP)

    def _sleep(self) -> None:
        client = self._simulation.client
        self._activate(client.ACTIVATION_STATE_ENABLE_SLEEPING)
        self._activate(client.ACTIVATION_STATE_SLEEP)

    def clear_lost(self) -> int:
        """Remove the objects that have left the bin, and return how many there were."""
        out = {body.id for body in self.bodies if not self._inside(body)}
        self.remove(out)
        return len(out)

    def _activate(self, state: int) -> None:
        for body in self.bodies:
            self._simulation.client.changeDynamics(body.id, -1, activationState=state)

    def _inside(self, body: Body) -> bool:
        position = np.array(self._simulation.client.getBasePositionAndOrientation(body.id)[0])
        return bool((np.abs(position[:2]) < self._size / 2).all() and -0.005 < position[2] < 0.3)

    def _add(
        self,
        name: str,
        scale: float,
        position: tuple[float, ...],
        rotation: np.ndarray,
        color: tuple[float, float, float],
    ) -> None:
        client = self._simulation.client
        if name not in self._meshes:
            self._meshes[name] = str(file_of(self._objects.shape(name).obj().encode(), ".obj"))
        mesh = {"fileName": self._meshes[name], "meshScale": [scale] * 3}
        collision = client.createCollisionShape(client.GEOM_MESH, **mesh)
        visual = client.createVisualShape(client.GEOM_MESH, **mesh, rgbaColor=(*color, 1))
        mass = self._objects.shape(name).volume * scale**3 * self._objects.density
        body = client.createMultiBody(mass, collision, visual, position, rotation)
        client.changeDynamics(
            body,
            -1,
            lateralFriction=0.6,
            spinningFriction=0.002,
            rollingFriction=0.0005,
            restitution=0.0,
            linearDamping=0.1,
            angularDamping=0.2,
        )
        if texture := self._objects.textures.get(name):
            client.changeVisualShape(body, -1, textureUniqueId=client.loadTexture(str(_texture(texture))))
        self.bodies.append(Body(body, name, scale, color, name in self._objects.transparent))

    def _ring(self, x: float, y: float, half: float, height: float, color: tuple[float, float, float] | None) -> list[int]:
        """Four walls with their inner faces at +-x and +-y."""
        blocks = []
        for sign in (-1, 1):
            blocks.append(self._block((half, y + 2 * half, height / 2), (sign * (x + half), 0, height / 2), color))
            blocks.append(self._block((x, half, height / 2), (0, sign * (y + half), height / 2), color))
        return blocks

    def _block(
        self, half: tuple[float, float, float], at: tuple[float, float, float], color: tuple[float, float, float] | None
    ) -> int:
        client = self._simulation.client
        collision = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        visual = -1 if color is None else client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=(*color, 1))
        block = int(client.createMultiBody(0, collision, visual, at))
        client.changeDynamics(block, -1, lateralFriction=self._config.friction)
        return block


@cache
def _texture(name: str) -> Path:
    return file_of(cv2.imencode(".png", TEXTURES[name]())[1].tobytes(), ".png")
