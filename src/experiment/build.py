"""From configuration to objects. Everything here is cheap to import; torch is not imported."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from see2act.datamodules.labels import Task
from see2act.errors import ConfigError
from see2act.experiment.cache import code_hash, foreign_code, given_files
from see2act.experiment.checks import check_arguments
from see2act.experiment.config import content_hash, one_line
from see2act.experiment.results import packages
from see2act.policy import Policy
from see2act.robot.robot import SimulatedRobot
from see2act.robot.types import RobotError

if TYPE_CHECKING:
    import torch  # takes seconds, which --help should not


def make_robot(robot: dict[str, Any], workspace: Any, camera: Any, objects: Any, end_effector: Any) -> SimulatedRobot:
    """A robot from plain configuration, so that worker processes can build their own."""
    # Partial, because Hydra would turn dataclass arguments back into plain configuration.
    built: SimulatedRobot = instantiate(robot, _partial_=True)(
        workspace=instantiate(workspace),
        camera=instantiate(camera, _convert_="all"),
        objects=instantiate(objects, _convert_="all"),
        end_effector=instantiate(end_effector),
    )
    return built


def robot_factory(cfg: DictConfig, primitive: DictConfig) -> partial[SimulatedRobot]:
    """Builds the robot of a run with a primitive's end effector; picklable."""
    robot = _plain(cfg.robot)
    if robot.get("layouts"):
        robot["layouts"] = str(Path(robot["layouts"]).absolute() / _layouts_key(cfg))
    return partial(
        make_robot,
        robot=robot,
        workspace=_plain(cfg.workspace),
        camera=_plain(cfg.camera),
        objects=_plain(cfg.objects),
        end_effector=_plain(primitive.end_effector),
    )


def _layouts_key(cfg: DictConfig) -> str:
    """Hash of all that decides how objects settle: the same for every tool and camera."""
    keys: dict[str, Any] = {
        "bin": _plain(cfg.robot.get("bin", {})),
        "workspace": _plain(cfg.workspace),
        "objects": _plain(cfg.objects),
    }
    keys |= {"code": _code_of_robots(), "versions": packages()}
    return content_hash(given_files(keys) | foreign_code(keys))


@cache  # robots are built often
def _code_of_robots() -> str:
    return code_hash("robot", "seeding.py")


def check_parts(cfg: DictConfig) -> None:
    """Build what is cheap to build, so that wrong parameters of objects, camera or workspace show now.

    Raises:
        ConfigError: With one line.
    """
    import torch  # takes seconds, which --help should not

    try:
        for group in ("policy", "model", "workspace", "camera", "objects", "robot", "task", "primitive"):
            check_arguments(cfg[group], group)
        robot_factory(cfg, cfg.primitive)().close()
        policy(cfg)
        with torch.device("meta"):  # parameters without values: nothing is drawn from anybody's generator
            instantiate(cfg.model.network)
    except (RobotError, HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error, HydraException) and error.__cause__ else error
        raise ConfigError(one_line(cause)) from None


def check_run(cfg: DictConfig) -> None:
    """The same, and what a run alone needs; apart, since Lightning takes seconds that a robot by itself need not wait for.

    Raises:
        ConfigError: With one line.
    """
    check_parts(cfg)
    for group in ("trainer", "logger", "collect.primitive"):
        check_arguments(OmegaConf.select(cfg, group), group)
    learns_to_see = cfg.task.label and not cfg.task.weights
    if learns_to_see:
        _check_shape(cfg)
    _check_trainer(cfg, {} if learns_to_see else one_device(cfg))


def _check_shape(cfg: DictConfig) -> None:
    """Run a heightmap through the network: a vision model learns from whole ones, of whatever size the workspace has."""
    import torch

    rows, cols = instantiate(cfg.workspace).shape
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        network = instantiate(cfg.model.network).eval()
        try:
            given = tuple(network(torch.zeros(1, 4, rows, cols)).shape)
        except (RuntimeError, ValueError, AssertionError) as error:
            raise ConfigError(
                f"model={cfg.model.name} takes no heightmap of {rows} x {cols} pixels: {one_line(error)}"
            ) from None
    if given != (1, 1, rows, cols):
        raise ConfigError(
            f"model={cfg.model.name} gives {given} for a heightmap of {rows} x {cols} pixels, not (1, 1, {rows}, {cols}): "
            f"its head must give a logit for every pixel of an input whose sides are multiples of its stride, {network.stride}"
        )


def one_device(cfg: DictConfig) -> dict[str, Any]:
    """What deciding and learning from the robot take of the trainer: one device, since each attempt waits for the one before.

    Only pre-training has use for more.
    """
    devices = cfg.trainer.get("devices", 1)
    alone = OmegaConf.to_container(devices) if OmegaConf.is_list(devices) and len(devices) == 1 else 1
    return {"devices": alone, "strategy": "auto"}


def device(cfg: DictConfig) -> torch.device:
    """Where networks decide and learn."""
    found: torch.device = instantiate(cfg.trainer)(**one_device(cfg)).strategy.root_device
    return found


def _check_trainer(cfg: DictConfig, here: dict[str, Any]) -> None:
    """Build one, since what it asks for need not be in this machine."""
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    from see2act.experiment.quiet import quiet

    quiet()
    try:
        instantiate(cfg.trainer)(**here)
    except (HydraException, MisconfigurationException, ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"this machine has no such trainer: {one_line(error)}") from None


def policy(cfg: DictConfig) -> Policy:
    """The rule that turns affordances into picks."""
    built: Policy = instantiate(cfg.policy, pixel=cfg.workspace.pixel, footprint=tuple(cfg.primitive.footprint))
    return built


def task(cfg: DictConfig) -> Task:
    """What the vision model learns."""
    built: Task = instantiate(cfg.task.label)
    return built


def _plain(node: Any) -> Any:
    if not OmegaConf.is_config(node):
        return node
    return OmegaConf.to_container(node, resolve=True)
