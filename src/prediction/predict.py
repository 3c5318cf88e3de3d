"""The best picks in an RGB-D image of one's own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hydra.utils import instantiate
from jaxtyping import Bool, Float, Int, UInt8
from scipy.special import expit

from see2act.experiment.model_file import TrainedModel, load
from see2act.policy import room_between_walls
from see2act.prediction.errors import ImageError
from see2act.prediction.floor import Floor
from see2act.prediction.jaws import blocked
from see2act.prediction.objects import known, sealable, standing
from see2act.prediction.posed_image import PosedImage, look
from see2act.robot.end_effector import EndEffector
from see2act.robot.gripper import PAD_HALF_HEIGHT, Gripper
from see2act.robot.heightmap import fill_in, highest
from see2act.robot.types import Heightmap
from see2act.robot.workspace import Workspace


@dataclass(frozen=True)
class ScoredPick:
    """One proposed pick."""

    score: float
    """Predicted probability of success."""
    row: int
    col: int
    """Pixel of the heightmap."""
    u: int
    v: int
    """Column and row of the pixel in the image."""
    position: tuple[float, float, float]
    """Metres in the world: z up from the floor."""
    position_camera: tuple[float, float, float]
    """Metres in the camera's frame: x right, y down, z forward."""
    angle: float | None
    """Radians, counter-clockwise seen from above, from the world's x: along this the jaws close. None for suction."""
    blocked: bool = False
    """Whether a finger would come down on something, or outside the image, as the heightmap shows it. Such grasps come last."""
    object: int = 0
    """Number of the connected part above the floor on which the pick is, from 1. Objects that touch are one part."""


@dataclass(frozen=True)
class Prediction:
    """What a model makes of an image."""

    picks: tuple[ScoredPick, ...]
    """Best first."""
    heightmap: Heightmap
    scores: Float[np.ndarray, "H W"]
    """The best over all angles at each pixel of the heightmap; 0 where nothing may be picked."""
    source: Int[np.ndarray, "H W"]
    """Flat index of the image pixel that each pixel of the heightmap was seen in, -1 where there is none."""
    objects: Int[np.ndarray, "H W"]
    """Number of the connected part above the floor at each pixel of the heightmap, from 1; 0 for none."""
    pose: Float[np.ndarray, "4 4"]
    """Camera to world."""
    intrinsics: Float[np.ndarray, "3 3"]
    workspace: Workspace
    """The heightmap's grid."""
    middle: tuple[float, float]
    """The world's x and y of the grid's origin: the middle of the bounds."""
    floor: Floor
    """Of the world; the heightmap's heights are above it."""
    notes: tuple[str, ...]
    """What is to be said of the floor and the picks, a line each."""
    primitive: str
    footprint: tuple[float, float]
    """Metres from a pick to the outer ends of the open tool, along the pick's angle and across."""


def predict(
    color: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, "3 3"],
    checkpoint: str | Path | TrainedModel,
    *,
    pose: Float[np.ndarray, "4 4"] | None = None,
    background_depth: Float[np.ndarray, "h w"] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    floor: float | None = None,
    count: int = 10,
    apart: float = 0.02,
    per_object: int | None = None,
) -> Prediction:
    """The best picks in an RGB-D image.

    The image is projected to a heightmap, seen along gravity, at the resolution that the model learned from; the model
    scores every pixel of it, and of the best ones those are given that lie apart from each other.

    Args:
        color: RGB.
        depth: Metres along the optical axis; 0 or NaN where there is no reading.
        intrinsics: Pinhole matrix in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; a pixel's centre is at its index, as in
            OpenCV and RealSense.
        checkpoint: A run's ``checkpoints/model.safetensors``, one of ``models/``, or what
            :func:`see2act.experiment.model_file.load` gave.
        pose: Camera to world: x right, y down, z forward in the image; in the world z points up. Without one the dominant
            plane, of the background if there is one, is at z = 0; then the world's x is the image's to the right, and its
            origin lies where the optical axis meets that plane.
        background_depth: The same view of the empty bin, in metres. What is less than 5 mm above it is not picked. Without it,
            what is less than 5 mm above the floor is not.
        bounds: Smallest x, smallest y, largest x and largest y of the inside of the bin, in metres of the world: picks
            without room for the whole open tool between them are left out. Without bounds, wherever floor is seen.
        floor: The world's z of the bin's floor. Without it: 0 if there is a pose. The floor is then looked for within 6 cm of
            there, in the background if there is one, and heights are above the plane that is found; without a pose, anywhere.
        count: Picks at most.
        apart: Metres between any two of them.
        per_object: Picks on one object at most. An object is a connected part that stands above the floor or the background:
            objects that touch count as one.

    Returns:
        The picks, best first, and all that a picture of them needs. ``picks`` is empty where nothing may be picked.

    Raises:
        ImageError: Sizes differ, the depth is not in metres, a matrix is none, nothing is in view, or the floor is not where
            it is said to be.
        see2act.experiment.model_file.ModelFileError: The checkpoint is none.

    Example:
        >>> best = see2act.predict(color, depth, intrinsics, "models/suction.safetensors").picks[0]  # doctest: +SKIP
        >>> best.position_camera, best.score  # doctest: +SKIP
    """
    model = checkpoint if isinstance(checkpoint, TrainedModel) else load(Path(checkpoint))
    for name, value in (("count", count), ("apart", apart), ("per_object", 1 if per_object is None else per_object)):
        if not isinstance(value, int | float) or not 0 < value < 1e9:
            raise ImageError(f"{name} is {value}: give a number above 0 and below 1e9")
    view = look(color, depth, background_depth, intrinsics, pose, bounds, floor, model.pixel)
    cells = highest(view.points, view.depth > 0, view.workspace)
    if not len(cells[0]):
        raise ImageError("nothing of the image lies between the bounds: check depth-scale, bounds and pose")
    heightmap = fill_in(color, view.points, cells, view.workspace.shape)
    source = np.full(view.workspace.shape, -1)
    source[cells[0], cells[1]] = np.where(view.read.ravel()[cells[2]], cells[2], -1)
    there = known(source >= 0)
    objects = standing(heightmap.height, _under(view), there, model.pixel)
    logits = model.affordances(heightmap.color, heightmap.height)
    along, across = model.config.primitive.footprint
    tool: EndEffector = instantiate(model.config.primitive.end_effector)
    allowed = np.broadcast_to((source >= 0) & (objects > 0), logits.shape)
    if not isinstance(tool, Gripper):
        allowed = allowed & sealable(there, along, model.pixel)
    if bounds:
        allowed = allowed & room_between_walls(logits.shape, (along, across), model.pixel)
    logits = np.where(allowed, logits, -np.inf)
    hit = _blocked(model, tool, heightmap, view.in_view(heightmap.height))
    # What fingers cannot get around comes last.
    chosen = _best(logits, hit, objects, count, apart / model.pixel, per_object or count)
    picks = tuple(_pick(view, source, objects, logits, hit, at) for at in chosen)
    scores = expit(logits.max(axis=0))
    return Prediction(
        picks=picks,
        heightmap=heightmap,
        scores=scores,
        source=source,
        objects=objects,
        pose=view.pose,
        intrinsics=intrinsics,
        workspace=view.workspace,
        middle=view.middle,
        floor=view.floor,
        notes=(*view.notes, *_crowded(picks, objects, per_object)),
        primitive=model.primitive,
        footprint=(along, across),
    )


def _blocked(
    model: TrainedModel, tool: EndEffector, heightmap: Heightmap, in_view: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "A H W"]:
    """Where a finger would come down on something, or where the camera does not look; nowhere for a cup."""
    primitive = model.config.primitive
    if not isinstance(tool, Gripper):
        return np.zeros((int(primitive.angles), *heightmap.height.shape), bool)
    fingertip = tool.depth_at(heightmap.height) - PAD_HALF_HEIGHT * tool.size
    along, across = primitive.footprint
    height = np.where(in_view, heightmap.height, np.inf)
    return blocked(height, fingertip, int(primitive.angles), tool.half_opening, (along, across), model.pixel)


def _under(view: PosedImage) -> Float[np.ndarray, "H W"]:
    """Heights of the empty bin; its floor's, 0, without an image of it."""
    if view.background is None:
        return np.zeros(view.workspace.shape, np.float32)
    cells = highest(view.background_points, view.background > 0, view.workspace)
    if not len(cells[0]):
        raise ImageError("the background depth has no reading between the bounds: is it of the same view?")
    return fill_in(view.color, view.background_points, cells, view.workspace.shape).height


def _pick(
    view: PosedImage, source: np.ndarray, objects: np.ndarray, logits: np.ndarray, hit: np.ndarray, at: tuple[int, int, int]
) -> ScoredPick:
    angle, row, col = at
    seen = int(source[row, col])
    v, u = divmod(seen, view.depth.shape[1])
    position = view.world(view.points.reshape(-1, 3)[seen])
    from_camera = np.linalg.inv(view.pose) @ [*position, 1]
    radians = angle * math.pi / len(logits) if len(logits) > 1 else None
    score = float(expit(logits[angle, row, col]))
    places = _triple(position), _triple(from_camera)
    return ScoredPick(score, row, col, u, v, *places, radians, bool(hit[at]), int(objects[row, col]))


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _best(
    logits: Float[np.ndarray, "A H W"],
    last: Bool[np.ndarray, "A H W"],
    objects: Int[np.ndarray, "H W"],
    count: int,
    apart: float,
    per_object: int,
) -> list[tuple[int, int, int]]:
    """Angle, row and column of the highest logits, and after them of the highest of those that come ``last``.

    None is within ``apart`` pixels of a better one, or on an object that has ``per_object`` of them already.
    """
    v, u = np.ogrid[: objects.shape[0], : objects.shape[1]]
    free = np.ones(objects.shape, bool)
    chosen: list[tuple[int, int, int]] = []
    for part in (np.where(last, -np.inf, logits), np.where(last, logits, -np.inf)):
        best = np.where(free, part.max(axis=0), -np.inf)
        while len(chosen) < count and np.isfinite(best.max()):
            row, col = (int(i) for i in np.unravel_index(best.argmax(), best.shape))
            chosen.append((int(part[:, row, col].argmax()), row, col))
            free &= (v - row) ** 2 + (u - col) ** 2 >= apart**2
            number = objects[row, col]
            if sum(objects[at[1:]] == number for at in chosen) >= per_object:
                free &= objects != number
            best[~free] = -np.inf
    return chosen


def _crowded(picks: Sequence[ScoredPick], objects: np.ndarray, per_object: int | None) -> list[str]:
    """A note where most picks are on one object of several."""
    on_one = max(Counter(pick.object for pick in picks).values(), default=0)
    if per_object or on_one < 3 or 2 * on_one <= len(picks) or objects.max() < 2:
        return []
    return [f"{on_one} of the {len(picks)} picks are on one object or on objects that touch: per-object 2 gives two on each"]
