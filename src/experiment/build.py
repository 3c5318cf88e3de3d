"""From configuration to objects. Everything here is cheap to import; torch is not imported."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from see2act.datamodules.labels import Task
from see2act.datamodules.observations import Observations
from see2act.experiment.identity import code_hash, hash_of, packages, plain
from see2act.policy import Policy
from see2act.robot.simulated import SimulatedRobot

if TYPE_CHECKING:
    import lightning as L
    import torch  # takes seconds, which --help should not
    from lightning.pytorch.loggers import Logger

    from see2act.modules.network import PixelNetwork


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
    parts = plain(cfg, "robot", "workspace", "camera", "objects")
    if parts["robot"].get("layouts"):
        parts["robot"]["layouts"] = str(Path(parts["robot"]["layouts"]).absolute() / _layouts_key(cfg))
    return partial(make_robot, **parts, **plain(primitive, "end_effector"))


def needs_observations(cfg: DictConfig) -> bool:
    """Whether a run collects: a whole affordance model brings the statistics that are measured on observations otherwise."""
    return not (cfg.task.affordance and "head" in cfg.transfer.parts)


def observations(cfg: DictConfig) -> Observations:
    """The folder that keeps what an attended robot has observed between random picks.

    Raises:
        ConfigError: What is in it has another grid than the configured workspace.
    """
    built = Observations(Path(cfg.collect.folder).expanduser())
    built.check(instantiate(cfg.workspace))
    return built


def _layouts_key(cfg: DictConfig) -> str:
    """Hash of all that decides how objects settle: the same for every tool and camera."""
    keys = plain(cfg, "workspace", "objects")
    keys["bin"] = OmegaConf.to_container(cfg.robot.get("bin") or OmegaConf.create(), resolve=True)
    return hash_of(keys | {"code": code_hash("robot", "seeding.py"), "versions": packages()})


def policy(cfg: DictConfig) -> Policy:
    """The rule that turns affordances into picks."""
    built: Policy = instantiate(cfg.policy, pixel=cfg.workspace.pixel, footprint=tuple(cfg.primitive.footprint))
    return built


def task(cfg: DictConfig) -> Task:
    """What the vision model learns."""
    built: Task = instantiate(cfg.task.label)
    return built


def network(cfg: DictConfig, seed: int) -> PixelNetwork:
    """The network, initialised from a seed, in the configured precision."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        built: PixelNetwork = instantiate(cfg.model.network)
    built.set_precision(cfg.precision)
    return built


def trainer(cfg: DictConfig, folder: Path, logger: Logger | None, **more: Any) -> L.Trainer:
    """A trainer as configured, with what a stage adds."""
    built: L.Trainer = instantiate(cfg.trainer)(default_root_dir=str(folder), logger=logger or False, **more)
    return built


def fit(trainer: L.Trainer, module: L.LightningModule, data: L.LightningDataModule, **more: Any) -> None:
    """Train to the end.

    Raises:
        KeyboardInterrupt: A signal ended it; what follows must not take it for finished.
    """
    try:
        trainer.fit(module, datamodule=data, **more)
    except SystemExit:  # so Lightning ends the program on Ctrl-C, without a word
        raise KeyboardInterrupt from None
    if (
        trainer.interrupted or trainer.received_sigterm
    ):  # Lightning says nothing else of a SIGTERM, or of one after the last step
        raise KeyboardInterrupt


def one_device(cfg: DictConfig) -> dict[str, Any]:
    """The trainer's keys for learning from the robot: one device, since each attempt waits for the one before.

    Only pre-training has use for more.
    """
    devices = cfg.trainer.get("devices", 1)
    alone = OmegaConf.to_container(devices) if OmegaConf.is_list(devices) and len(devices) == 1 else 1
    return {"devices": alone, "strategy": "auto"}


def device(cfg: DictConfig) -> torch.device:
    """Where networks decide and learn."""
    found: torch.device = instantiate(cfg.trainer)(**one_device(cfg)).strategy.root_device
    return found
