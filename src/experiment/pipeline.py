"""One run, stage by stage: collect, pre-train, transfer, fine-tune, evaluate."""

from __future__ import annotations

import copy
import hashlib
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from see2act.attempt import Attempt
from see2act.datamodules.collect import Collection, collect
from see2act.datamodules.interactive import InteractiveDataModule, TrainingAttempt, TrialAndError
from see2act.datamodules.replay import Replay
from see2act.datamodules.vision import VisionDataModule, channel_statistics
from see2act.errors import ConfigError, TransferError
from see2act.experiment import attempts_csv, build, figures, trained
from see2act.experiment.attempts_csv import AttemptsCsv
from see2act.experiment.cache import code_hash, foreign_code, given_files, once
from see2act.experiment.config import CHOICES, config_hash, content_hash, relevant_robot, relevant_trainer
from see2act.experiment.dashboard import Dashboard
from see2act.experiment.evaluation import SPLITS, Counts, Protocol, TestRun, evaluate
from see2act.experiment.results import Progress, commit, curve, packages, versions
from see2act.files import read_json, replacing, write_json
from see2act.modules import weights
from see2act.modules.affordance import AffordanceModule
from see2act.modules.average_precision import average_precision
from see2act.modules.batchnorm import batchnorms, epsilons, estimate
from see2act.modules.network import PixelNetwork
from see2act.modules.transfer import TransferReport, copy_parts
from see2act.modules.vision import VisionModule
from see2act.policy import Policy
from see2act.robot.group import RobotGroup
from see2act.robot.robot import Robot
from see2act.seeding import generator, seed_for

log = logging.getLogger("see2act")
ESTIMATION_MAPS = 64
"""Unlabelled heightmaps from which BatchNorm statistics of uncopied layers are estimated."""


class Run:
    """The stages of one run and what they share.

    Args:
        cfg: A validated configuration.
        folder: Where everything goes; an unfinished run of the same configuration in it is continued.
    """

    def __init__(self, cfg: DictConfig, folder: Path):
        self.cfg, self.folder = cfg, folder
        self.cache = Path(cfg.paths.cache).absolute()
        self.checkpoints = folder / "checkpoints"
        self.checkpoints.mkdir(parents=True, exist_ok=True)
        self.dashboard = Dashboard()
        self.progress = Progress(folder / "progress.json")
        self.protocol = Protocol(cfg.evaluate.runs, dict(cfg.evaluate.attempts), cfg.evaluate.scenes)
        self.attempts = cfg.finetune.attempts if cfg.transfer.finetune else 0
        self.device = build.device(cfg)
        self._within = 0.0
        """Seconds of stages within the present one, which are not its own."""

    def __call__(self) -> dict[str, Any]:
        """All stages in order; the contents of ``result.json``."""
        self.dashboard = Dashboard.of(self.cfg, self.folder, self._title())
        try:
            return self._stages()
        finally:
            self.dashboard.close()

    def _stages(self) -> dict[str, Any]:
        with self._timed("collect"):
            collection = self.collect()
        with self._timed("pretrain"):
            vision = self.pretrain(collection)
        with self._timed("figures"):
            self._figures_of_seeing(collection, vision)
        with self._timed("transfer"):
            module, report = self.transfer(collection, vision)
        log.info(report.summary())
        del collection  # it may be a gigabyte, and what follows takes long
        before = copy.deepcopy(module)
        with self._timed("finetune"):
            self.finetune(module)
        trained.save(self.checkpoints / trained.FILE, module.acting, self.cfg)
        self._evaluate_argmax(module)
        with self._timed("figures"):
            self.figures(vision, before, module)
        self.dashboard.show(self.folder)
        return self._finish()

    def check_weights(self) -> None:
        """Refuse a vision model that does not fit, before any work.

        Raises:
            TransferError: Keys or shapes differ.
        """
        if self.cfg.task.weights or self.cfg.task.off_the_shelf:
            network = self._network(0)
            self._copy(self._given(network.normalization.mean, network.normalization.std), network)
            if self.cfg.finetune.batchnorm == "batch" and any(float(e) == 0 for e in epsilons(network)):
                raise TransferError(
                    "the BatchNorm of these weights has an epsilon of 0, since their detector froze it or folded it into its "
                    "convolutions, and cannot use the statistics of batches: leave finetune.batchnorm=frozen"
                )

    def collect(self) -> Collection:
        """Observations of random interaction, from the cache or made now."""
        collect = self.cfg.collect
        return self._collection(collect.interactions, collect.per_scene, collect.seed)

    def held_out(self) -> Collection:
        """Observations of other scenes, one each, by which vision models are judged."""
        return self._collection(self.cfg.pretrain.test_scenes, 1, seed_for("held out", self.cfg.collect.seed))

    def pretrain(self, collection: Collection) -> dict[str, Any] | None:
        """The vision model's checkpoint: given, from the cache or trained now; None for ``task=none``."""
        cfg = self.cfg
        if cfg.task.weights or cfg.task.off_the_shelf:
            return self._keep_vision({"task": cfg.task.name, "network": self._given(*channel_statistics(collection))})
        if cfg.task.label is None:
            return None
        path = self.vision_path()
        made = once(path, lambda: self._train_vision(collection, path))
        log.info("pretrain: %s %s %s", cfg.task.name, "trained, kept at" if made else "from", path)
        checkpoint: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        quality = {key: checkpoint[key] for key in ("positive_share", "val_loss", "average_precision")}
        log.info("pretrain: average precision %.2f on held-out scenes", quality["average_precision"])
        self.progress.set("vision", quality)
        return self._keep_vision(checkpoint)

    def vision_path(self) -> Path:
        """Where the cache has the vision model: it depends on nothing that a primitive or fine-tuning decides."""
        cfg = self.cfg
        keys: dict[str, Any] = {
            "collection": self._collection_key(cfg.collect.interactions, cfg.collect.per_scene, cfg.collect.seed)
        }
        keys |= {**_plain(cfg, "task", "pretrain"), **_plain(cfg.model, "network"), "labels": cfg.labels}
        keys |= {"trainer": relevant_trainer(cfg), "precision": cfg.precision}
        keys["code"] = code_hash(
            "modules", "datamodules/labels.py", "datamodules/vision.py", "experiment/pipeline.py", "seeding.py"
        )
        keys |= foreign_code(keys)
        return self.cache / "vision" / f"{cfg.task.name}-{cfg.model.name}-{content_hash(keys)}.ckpt"

    def transfer(self, collection: Collection, vision: dict[str, Any] | None) -> tuple[AffordanceModule, TransferReport]:
        """The affordance model before its first attempt."""
        cfg = self.cfg
        network = self._network(seed_for("head", cfg.seed))
        network.normalization.set(*channel_statistics(collection))
        report = self._copy(vision["network"] if vision else {}, network)
        write_json(self.folder / "transfer.json", report.as_dict())
        if "head" in cfg.transfer.parts:
            network.scale_logits(cfg.finetune.logit_scale)
        shape = (collection.arrays["height"].shape[1], collection.arrays["height"].shape[2])
        module = AffordanceModule(
            network,
            shape=shape,
            angles=cfg.primitive.angles,
            backbone_lr=cfg.finetune.backbone_lr,
            head_lr=cfg.finetune.head_lr,
            weight_decay=cfg.finetune.weight_decay,
            batchnorm=cfg.finetune.batchnorm,
            averaging=cfg.finetune.averaging,
        )
        module.to(self.device)
        fresh = [name for name in batchnorms(network) if name.split(".")[0] not in cfg.transfer.parts]
        estimate(network, self._unlabelled(module, collection), fresh)
        return module.eval(), report

    def finetune(self, module: AffordanceModule) -> None:
        """Evaluate before, learn by trial and error, evaluate on the way and after."""
        cfg = self.cfg
        last = self.checkpoints / "last.ckpt"
        resumed = torch.load(last, map_location="cpu", weights_only=True) if last.exists() else None
        done = resumed["InteractiveDataModule"]["attempts"] if resumed else 0
        final = self.progress.get("finetuned")
        steps = sorted({0, self.attempts, *(step for step in cfg.evaluate.at if step <= self.attempts)})
        self.progress.drop([f"eval_{step}" for step in steps if step > done and not final])
        self._attempts = AttemptsCsv(self.folder / "attempts.csv", lambda row: self._keep(row, done))
        self._evaluate_at(module, 0)
        if not self.attempts:
            with replacing(self.checkpoints / "affordance.ckpt") as partial:
                torch.save({"state_dict": module.state_dict()}, partial)
        elif not final:
            self._fit(module, last if resumed else None, steps)
        else:
            kept = torch.load(self.checkpoints / "affordance.ckpt", map_location=self.device, weights_only=True)
            module.load_state_dict(kept["state_dict"])

    def figures(self, vision: dict[str, Any] | None, before: AffordanceModule, module: AffordanceModule) -> None:
        """Pictures of what was learned by trial and error, in ``figures/``."""
        cfg, out = self.cfg, self.folder / "figures"
        figures.learning_curve(self.folder / "attempts.csv", out / "learning_curve.png", self._title())
        figures.diagnosis(self.folder / "attempts.csv", out / "diagnosis.png", self._title())
        models = {"before fine-tuning": before, "after fine-tuning": module}
        if vision:
            seeing = copy.deepcopy(before)
            copy_parts(vision["network"], seeing.network, cfg.task.parts, cfg.task.optional, cfg.task.zero)
            models = {f"vision model: {cfg.task.name}": seeing, **models}
        robot = build.robot_factory(cfg, cfg.primitive)()
        try:
            figures.heatmaps(robot, models, build.policy(cfg), cfg.figures.scenes, self._title(), out, cfg.evaluate.scenes)
        finally:
            robot.close()

    def _figures_of_seeing(self, collection: Collection, vision: dict[str, Any] | None) -> None:
        """Labels, and what the vision model makes of other scenes: there to be looked at while the robot learns."""
        cfg, out = self.cfg, self.folder / "figures"
        if cfg.task.label is not None:
            figures.labels(collection, build.task(cfg), cfg.labels, cfg.task.name, cfg.figures.scenes, out / "labels.png")
        if quality := self.progress.get("vision"):
            assert vision is not None
            network = self._network(0)
            network.load_state_dict(vision["network"])
            title = f"{cfg.task.name}, average precision {quality['average_precision']:.2f} on held-out scenes"
            figures.vision(self.held_out(), build.task(cfg), cfg.labels, network, cfg.figures.scenes, title, out / "vision.png")

    def _keep_vision(self, checkpoint: dict[str, Any]) -> dict[str, Any]:
        with replacing(self.checkpoints / "vision.ckpt") as partial:
            torch.save(checkpoint, partial)
        return checkpoint

    def _given(self, mean: Tensor, std: Tensor) -> dict[str, Tensor]:
        """State of a vision model from elsewhere.

        What off-the-shelf weights lack, statistics of the height, is taken from ours (``mean``, ``std``: (4,)).

        Raises:
            TransferError: It cannot be read, is of another task, or is no vision model.
        """
        task = self.cfg.task
        if task.weights and trained.is_model(Path(task.weights)):
            raise TransferError(f"{task.weights} is a fine-tuned model: give the same run's checkpoints/vision.ckpt")
        if task.weights and (known := weights.task_of(Path(task.weights))) not in (None, task.name):
            raise TransferError(f"{task.weights} learned {known}, not {task.name}: type task={known}, or give another file")
        if not task.off_the_shelf:
            return weights.read(Path(task.weights))
        source: weights.OffTheShelf = instantiate(task.off_the_shelf[self.cfg.model.name])
        state = source.read(task.weights, self.cache)
        for name, ours in (("normalization.mean", mean), ("normalization.std", std)):
            state[name] = torch.cat([state[name][:3], state[name][3:] if len(state[name]) == 4 else ours[3:]])
        return state

    def _copy(self, source: dict[str, Tensor], network: PixelNetwork) -> TransferReport:
        return copy_parts(source, network, self.cfg.transfer.parts, self.cfg.task.optional, self.cfg.task.zero)

    def _train_vision(self, collection: Collection, path: Path) -> None:
        cfg, seed = self.cfg, self.cfg.pretrain.seed
        data = VisionDataModule(
            collection,
            build.task(cfg),
            cfg.labels,
            batch_size=cfg.pretrain.batch_size,
            validation=cfg.pretrain.validation,
            seed=seed_for("batches", seed),
        )
        log.info("pretrain: %s labels %.1f %% of the pixels as positive", cfg.task.name, 100 * data.positive_share)
        if not 0 < data.positive_share < 1:
            raise ConfigError(
                f"task={cfg.task.name} labels all pixels alike: check its parameters in conf/task/{cfg.task.name}.yaml"
            )
        held_out = self._held_out_labels()
        network = self._network(seed_for("vision", seed))
        network.normalization.set(*channel_statistics(collection))
        weight = (1 - data.positive_share) / data.positive_share if cfg.task.class_weight == "balanced" else 1.0
        module = VisionModule(
            network,
            lr=cfg.pretrain.lr,
            weight_decay=cfg.pretrain.weight_decay,
            pos_weight=weight,
            seed=seed_for("augment", seed),
        )
        trainer = self._trainer(max_epochs=cfg.pretrain.epochs)
        self._fit_to_the_end(trainer, module, data)
        val_loss = float(trainer.callback_metrics["vision/val_loss"])
        if not math.isfinite(val_loss):
            raise ConfigError(f"the vision model has diverged (loss {val_loss}): lower pretrain.lr={cfg.pretrain.lr}")
        checkpoint = {
            "task": cfg.task.name,
            "network": {name: value.cpu() for name, value in network.state_dict().items()},
            "positive_share": data.positive_share,
            "val_loss": val_loss,
            "average_precision": self._average_precision(module, held_out),
        }
        with replacing(path) as partial:
            torch.save(checkpoint, partial)

    def _held_out_labels(self) -> np.ndarray:
        """Of the scenes by which a vision model will be judged, (n, H, W); before it learns, since without any it cannot be.

        Raises:
            ConfigError: No pixel is labelled.
        """
        task, held_out = build.task(self.cfg), self.held_out()
        labels = np.stack([task.label(held_out.view(i), self.cfg.labels) for i in range(len(held_out))])
        if not labels.any():
            raise ConfigError(
                f"task={self.cfg.task.name} labels nothing in {len(held_out)} held-out scenes: raise pretrain.test_scenes, or "
                f"check its parameters in conf/task/{self.cfg.task.name}.yaml"
            )
        return labels

    def _average_precision(self, module: VisionModule, labels: np.ndarray) -> float:
        """Of the trained vision model on scenes it was not trained on."""
        held_out = self.held_out()
        module.to(self.device)
        scores = module.network.scores(held_out.arrays["color"], held_out.arrays["height"])
        return average_precision(scores, labels, build.task(self.cfg).tolerance)

    def _fit(self, module: AffordanceModule, resume: Path | None, steps: list[int]) -> None:
        cfg = self.cfg
        robots = RobotGroup(build.robot_factory(cfg, cfg.primitive), cfg.finetune.robots)
        try:
            replay = Replay(**cfg.finetune.replay, pixel=cfg.workspace.pixel, rng=generator("replay", cfg.seed))
            data = InteractiveDataModule(
                robots,
                instantiate(cfg.workspace),
                build.policy(cfg),
                replay,
                seed=cfg.seed,
                batch_size=cfg.finetune.batch_size,
                updates=cfg.finetune.updates,
                temperature=cfg.finetune.temperature,
                episode_attempts=cfg.finetune.episode_attempts,
                scenes=cfg.evaluate.scenes,
            )
            loop = TrialAndError(
                data,
                self.attempts,
                lambda made, seconds: self._record(made, seconds, data.policy.name),
                self.checkpoints / "last.ckpt",
                steps,
                lambda step: self._evaluate_at(module, step),
            )
            trainer = self._trainer(
                max_epochs=self.attempts // cfg.finetune.robots,
                callbacks=[loop],
                limit_val_batches=0,
                enable_progress_bar=False,
                **build.one_device(cfg),
            )
            module.train()  # Lightning keeps the mode it finds
            self._fit_to_the_end(trainer, module, data, ckpt_path=resume, weights_only=True)
            if data.attempts != self.attempts:
                raise ConfigError(
                    f"the trainer ended after {data.attempts} of {self.attempts} attempts: trainer= has a key that ends it"
                )
            for name, weights_only in (("affordance", True), ("last", False)):
                with replacing(self.checkpoints / f"{name}.ckpt") as partial:
                    trainer.save_checkpoint(partial, weights_only=weights_only)
        finally:
            robots.close()
        module.to(self.device)  # Lightning has brought it back to the processor
        self.progress.set("finetuned", True)

    def _record(self, made: TrainingAttempt, t_learn: float, policy: str) -> None:
        where = {"phase": "finetune", "split": "seen", "policy": policy, "run": 0, "primitive": self.cfg.primitive.name}
        where |= {"step": made.step, "episode": made.episode, "scene_seed": made.scene_seed}
        self._attempts.append(made.attempt, t_learn, **where)

    def _evaluate_at(self, module: AffordanceModule, step: int) -> None:
        policy = build.policy(self.cfg)
        phase = "zero_shot" if step == 0 else "eval"
        with self._timed("evaluate"):
            self._evaluation(f"eval_{step}", module, policy, phase, step)

    def _evaluate_argmax(self, module: AffordanceModule) -> None:
        policy = build.policy(self.cfg)
        if policy.suppress:
            with self._timed("evaluate"):
                self._evaluation("eval_argmax", module, policy.plain(), "eval", self.attempts)
        else:
            self.progress.set("eval_argmax", {**self.progress.get(f"eval_{self.attempts}"), "repeated": True})

    def _evaluation(self, name: str, module: AffordanceModule, policy: Policy, phase: str, step: int) -> None:
        """One evaluation by the protocol, unless it is done already; what needs no robot is taken from where it is known."""
        if self.progress.get(name):
            return
        where = {"phase": phase, "step": step, "primitive": self.cfg.primitive.name}
        robot = build.robot_factory(self.cfg, self.cfg.primitive)()
        try:
            if robot.repeatable and step == 0 and self.attempts:
                result = self._evaluated_once(robot, module, policy, where)
            elif robot.repeatable and name == "eval_argmax":
                result, _ = self._measured(robot, module, policy, where, self._without_failure(policy.name))
            elif name == f"eval_{self.attempts}":
                result = self._last_evaluation(robot, module, policy, where)
            else:
                result, _ = self._measured(robot, module, policy, where)
        finally:
            robot.close()
        rule = "" if policy.name == self.cfg.policy.name else f"_{policy.name}"
        self.dashboard.log({f"evaluate{rule}/{split}": result[split]["rate"] for split in SPLITS} | {"attempts": step})
        self.progress.set(name, result)

    def _measured(
        self,
        robot: Robot,
        module: AffordanceModule,
        policy: Policy,
        where: dict[str, Any],
        known: dict[TestRun, list[Counts]] | None = None,
        watch: Callable[[Attempt], None] = lambda attempt: None,
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """The protocol on the robot: the result, and the rows of its attempts, which are in the log by then."""
        rows: list[dict[str, Any]] = []

        def record(attempt: Attempt, **more: Any) -> None:
            rows.append(self._attempts.append(attempt, **where, **more))
            watch(attempt)

        title = f"evaluate at {where['step']} ({policy.name})"
        return evaluate(robot, module.affordances, policy, self.protocol, record, title, known), rows

    def _evaluated_once(self, robot: Robot, module: AffordanceModule, policy: Policy, where: dict[str, Any]) -> dict[str, Any]:
        """Of a network that other runs have too, as all seeds of a model that was copied whole: from the cache, or made now."""
        path = self.cache / "evaluations" / f"{self._evaluation_key(module, policy)}.json"

        def make() -> None:
            result, rows = self._measured(robot, module, policy, where)
            write_json(path, {"result": result, "rows": rows})

        made = once(path, make)
        log.info("evaluate: before any attempt, %s %s", "kept at" if made else "from", path)
        kept = read_json(path)
        if not made:
            self._attempts.extend(kept["rows"])
        result: dict[str, Any] = kept["result"]
        return result

    def _evaluation_key(self, module: AffordanceModule, policy: Policy) -> str:
        """Hash of everything that an evaluation depends on, the numbers of the network among it."""
        cfg, digest = self.cfg, hashlib.sha256()
        for name, value in sorted(module.acting.state_dict().items()):
            digest.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
        keys = _plain(cfg, "workspace", "camera", "objects", "primitive", "evaluate", "policy")
        keys["robot"] = relevant_robot(cfg)
        keys["evaluate"].pop("at")
        keys |= {"network": digest.hexdigest(), "model": _plain(cfg.model, "network"), "rule": policy.name}
        keys |= {"precision": cfg.precision, "threads": cfg.threads, "device": self.device.type, "versions": versions()}
        return content_hash(given_files(keys) | foreign_code(keys))

    def _without_failure(self, policy: str) -> dict[TestRun, list[Counts]]:
        """Test runs of the last evaluation in which every attempt succeeded: no rule would have picked anything else.

        Their rows are added to the log, under the name of the other rule.
        """
        runs: dict[TestRun, list[dict[str, Any]]] = {}
        for row in attempts_csv.read(self.folder / "attempts.csv"):
            if (row["phase"], row["policy"], row["step"]) == ("eval", self.cfg.policy.name, str(self.attempts)):
                split: Any = row["split"]
                runs.setdefault((split, int(row["run"])), []).append({**row, "policy": policy})
        clean = {key: rows for key, rows in runs.items() if all(row["success"] == "1" for row in rows)}
        self._attempts.extend([row for rows in clean.values() for row in rows])
        return {key: [Counts(True, row["truth"] == "1", int(row["lost"])) for row in rows] for key, rows in clean.items()}

    def _last_evaluation(self, robot: Robot, module: AffordanceModule, policy: Policy, where: dict[str, Any]) -> dict[str, Any]:
        """The same with a film, where the robot makes one, and a figure of what failed."""
        failed = figures.Failures()

        def watch(attempt: Attempt) -> None:
            if not attempt.outcome.success:
                failed.add(attempt)

        with robot.film(self.folder / "video.mp4"):
            result, _ = self._measured(robot, module, policy, where, watch=watch)
        if failed.counts:
            title = f"{self._title()}: failed attempts of the last evaluation"
            figures.failures(failed, module.affordances, robot, title, self.folder / "figures" / "failures.png")
        return result

    def _keep(self, row: dict[str, str], done: int) -> bool:
        """Whether a row of an interrupted run's log belongs to work that is not going to be repeated."""
        if row["phase"] == "finetune":
            return bool(self.progress.get("finetuned")) or int(row["step"]) <= done
        name = f"eval_{row['step']}"
        if row["policy"] == "argmax" and build.policy(self.cfg).suppress:
            name = "eval_argmax"
        return bool(self.progress.get(name))

    def _network(self, seed: int) -> PixelNetwork:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network: PixelNetwork = instantiate(self.cfg.model.network)
        network.set_precision(self.cfg.precision)
        return network

    def _unlabelled(self, module: AffordanceModule, collection: Collection) -> Iterator[Tensor]:
        """The same heightmaps for every arm, turned as the primitive will see them."""
        chosen = generator("unlabelled", self.cfg.collect.seed)
        count = min(ESTIMATION_MAPS, len(collection))
        for start in range(0, count, 8):
            index = slice(start, min(start + 8, count))
            color = torch.from_numpy(collection.arrays["color"][index])
            height = torch.from_numpy(collection.arrays["height"][index])
            angle = torch.from_numpy(chosen.integers(module.rotations.count, size=len(color)))
            x = module.network.prepare(color.to(self.device), height.to(self.device))
            yield module.rotations.turned(x, angle.to(self.device))

    def _trainer(self, **more: Any) -> L.Trainer:
        logger = self.dashboard.logger or False
        trainer: L.Trainer = instantiate(self.cfg.trainer)(default_root_dir=str(self.folder), logger=logger, **more)
        return trainer

    def _fit_to_the_end(self, trainer: L.Trainer, module: L.LightningModule, data: L.LightningDataModule, **more: Any) -> None:
        trainer.fit(module, datamodule=data, **more)
        if trainer.interrupted:
            # Lightning ends a fit quietly on SIGTERM; what follows must not take it for finished.
            raise KeyboardInterrupt

    def _collection(self, interactions: int, per_scene: int, seed: int) -> Collection:
        cfg = self.cfg
        path = self.cache / "collections" / f"{self._collection_key(interactions, per_scene, seed)}.npz"

        def make() -> None:
            factory = build.robot_factory(cfg, cfg.collect.primitive)
            most = cfg.objects.kinds * cfg.objects.copies
            collect(factory, interactions, per_scene, most, seed, cfg.collect.workers).save(path)

        made = once(path, make)
        log.info("collect: %d observations %s %s", interactions, "written to" if made else "from", path)
        return Collection.load(path)

    def _collection_key(self, interactions: int, per_scene: int, seed: int) -> str:
        keys = {**_plain(self.cfg, "workspace", "camera", "objects"), "robot": relevant_robot(self.cfg)}
        keys["collect"] = {"interactions": interactions, "per_scene": per_scene, "seed": seed}
        keys["collect"]["primitive"] = _plain(self.cfg.collect.primitive, "end_effector")
        keys["code"] = code_hash("robot", "datamodules/collect.py", "seeding.py", "experiment/build.py")
        keys["versions"] = packages()
        return content_hash(given_files(keys) | foreign_code(keys))

    def _title(self) -> str:
        cfg = self.cfg
        return f"{cfg.primitive.name} {cfg.task.name} {cfg.transfer.name} seed {cfg.seed}"

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Count the seconds of the block as those of a stage, but for those of stages within it."""
        start, outer = time.perf_counter(), self._within
        self._within = 0.0
        try:
            yield
        finally:  # Ctrl-C too: what a run took before it was cut counts
            took = time.perf_counter() - start
            seconds = self.progress.get("seconds") or {}
            seconds[stage] = round(seconds.get(stage, 0.0) + took - self._within, 1)
            self.progress.set("seconds", seconds)
            self._within = outer + took

    def _finish(self) -> dict[str, Any]:
        cfg, done = self.cfg, self.progress.done
        steps = sorted(int(name.removeprefix("eval_")) for name in done if name.startswith("eval_") and name != "eval_argmax")
        final = done[f"eval_{self.attempts}"]
        result = {
            "choices": {key: cfg[key].name for key in CHOICES}
            | {"labels": cfg.labels, "seed": cfg.seed, "precision": cfg.precision, "motion": cfg.robot.get("motion")},
            "config_hash": config_hash(cfg),
            "versions": versions(),
            "commit": commit(),
            "seconds": done["seconds"],
            "evaluation_share": round(done["seconds"].get("evaluate", 0.0) / max(sum(done["seconds"].values()), 0.1), 3),
            "vision": done.get("vision"),
            "zero_shot": done["eval_0"],
            "eval": final if self.attempts else {**final, "repeated": True},
            "eval_argmax": done["eval_argmax"],
            "evals": [{"step": step, **done[f"eval_{step}"]} for step in steps],
            "curve": curve(self.folder / "attempts.csv"),
        }
        write_json(self.folder / "result.json", result)
        (self.folder / "progress.json").unlink()
        return result


def _plain(cfg: DictConfig, *keys: str) -> dict[str, Any]:
    return {key: OmegaConf.to_container(cfg[key], resolve=True) for key in keys}
