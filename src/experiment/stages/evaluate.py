"""Stage 5, and between the attempts of stage 4: success by the protocol, kept with what has been measured before."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from see2act.attempt import Attempt
from see2act.datamodules.records import testing
from see2act.experiment import attempts, build, figures
from see2act.experiment.attempts import AttemptRow, Phase, Place
from see2act.experiment.cache import once
from see2act.experiment.context import RunContext
from see2act.experiment.evaluation import EvaluationProtocol, EvaluationRun, Judged, evaluate
from see2act.experiment.identity import deciding_robot, hash_of, plain, versions
from see2act.experiment.results import SPLITS, Evaluation
from see2act.files import damaged, read_json, write_json
from see2act.modules.affordance import AffordanceModule
from see2act.policy import Policy
from see2act.robot.robot import Robot
from see2act.robot.types import Split

log = logging.getLogger("see2act")


def evaluate_at(context: RunContext, module: AffordanceModule, step: int) -> None:
    """Evaluate after ``step`` fine-tuning attempts, unless that is done already."""
    if step in context.progress.evaluations:
        return
    with context.progress.timed("evaluate"):
        evaluation = _Evaluation(context, module, build.policy(context.cfg), step)
        context.progress.evaluations[step] = evaluation.run()
        context.progress.save()


def evaluate_argmax(context: RunContext, module: AffordanceModule) -> None:
    """Evaluate the last model with the plain argmax policy if that is asked for, is not done, and is not the run's own."""
    progress, policy = context.progress, build.policy(context.cfg)
    if not policy.suppress:
        progress.argmax = progress.evaluations[context.attempts].model_copy(update={"repeated": True})
    elif context.cfg.evaluate.argmax and progress.argmax is None:
        progress.argmax = _Evaluation(context, module, policy.plain(), context.attempts).run()
    progress.save()


class _Evaluation:
    """One evaluation of a run, by whatever way is the shortest."""

    def __init__(self, context: RunContext, module: AffordanceModule, policy: Policy, step: int):
        self._context, self._module, self._policy, self._step = context, module, policy, step
        cfg = context.cfg
        self._protocol = EvaluationProtocol(cfg.evaluate.runs, dict(cfg.evaluate.attempts), cfg.evaluate.scenes)
        self._own_policy = policy.name == cfg.policy.name
        self._rows: list[AttemptRow] = []

    def run(self) -> Evaluation:
        cfg, last = self._context.cfg, self._context.attempts
        robot = build.robot_factory(cfg, cfg.primitive)()
        try:
            if robot.repeatable and self._step == 0 and last:
                result = self._from_cache(robot)
            elif robot.repeatable and not self._own_policy:
                result = self._measure(robot, known=self._without_failure())
            elif self._step == last and self._own_policy:
                result = self._last(robot)
            else:
                result = self._measure(robot)
        finally:
            robot.close()
        suffix = "" if self._own_policy else f"_{self._policy.name}"
        rates = {f"evaluate{suffix}/{split}": result[split].rate for split in SPLITS}
        self._context.dashboard.log(rates | {"attempts": self._step})
        return result

    def _measure(
        self,
        robot: Robot,
        known: Mapping[tuple[Split, int], Sequence[Judged]] | None = None,
        watch: Callable[[Attempt], None] = lambda attempt: None,
    ) -> Evaluation:
        """The protocol on the robot. Its attempts are in the log by then."""

        def record(attempt: Attempt, test: EvaluationRun) -> None:
            place = Place(
                self._phase,
                split=test.split,
                policy=self._policy.name,
                run=test.run,
                step=self._step,
                episode=test.run,
                scene_seed=test.scene_seed,
                primitive=self._context.cfg.primitive.name,
            )
            if robot.attended:
                self._context.records.save(self._name(len(self._rows) + 1), attempt)
            self._rows.append(AttemptRow.of(attempt, place))
            self._context.log.append(self._rows[-1])
            watch(attempt)

        going_on = None
        if robot.attended:
            known = self._interrupted()
            going_on = self._remembering(known)
        title = f"evaluate at {self._step} ({self._policy.name})"
        return evaluate(robot, self._module.affordances, self._policy, self._protocol, record, title, known, going_on)

    def _interrupted(self) -> dict[tuple[Split, int], list[AttemptRow]]:
        """Attempts of this evaluation that were made before the run was interrupted."""
        runs: dict[tuple[Split, int], list[AttemptRow]] = {}
        for row in attempts.read(self._context.log.path):
            if (row.phase, row.policy, row.step) == (self._phase, self._policy.name, self._step):
                runs.setdefault((row.split, row.run), []).append(row)
        self._rows = [row for rows in runs.values() for row in rows]
        return runs

    def _remembering(self, runs: Mapping[tuple[Split, int], Sequence[AttemptRow]]) -> Policy:
        """The policy as it was in the last test run, from the records of its attempts."""
        policy, made = self._policy.fresh(), len(self._rows)
        last = len([*runs.values()][-1]) if runs else 0
        for number in range(made - last + 1, made + 1):
            attempt = self._context.records.read(self._name(number))
            policy.remember(attempt.choice, attempt.heightmap, attempt.outcome.success)
        return policy

    @property
    def _phase(self) -> Phase:
        return "eval" if self._step else "zero_shot"

    def _name(self, number: int) -> str:
        """Of the record of an attempt, numbered from 1."""
        return testing(self._phase, self._step, self._policy.name, number)

    def _from_cache(self, robot: Robot) -> Evaluation:
        """Of a network that other runs have too, as all seeds of a model that was copied whole."""
        path = Path(self._context.cfg.paths.cache).absolute() / "evaluations" / f"{self._key()}.json"

        def make() -> None:
            result = self._measure(robot)
            write_json(path, {"result": result.model_dump(mode="json"), "rows": [row.texts() for row in self._rows]})

        (result, rows), made = once(path, make, _kept_evaluation)
        log.info("evaluate: before any attempt, %s %s", "kept at" if made else "from", path)
        if not made:
            self._context.log.append(*rows)
        return result

    def _key(self) -> str:
        """Hash of everything that an evaluation depends on, the network's parameters among it."""
        cfg, digest = self._context.cfg, hashlib.sha256()
        for name, value in sorted(self._module.acting.state_dict().items()):
            digest.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
        keys: dict[str, Any] = plain(cfg, "workspace", "camera", "objects", "primitive", "evaluate", "policy")
        keys["robot"] = deciding_robot(cfg)
        keys["evaluate"].pop("at")
        keys |= {"network": digest.hexdigest(), "model": plain(cfg.model, "network"), "rule": self._policy.name}
        device = self._module.network.device.type
        keys |= {"precision": cfg.precision, "threads": cfg.threads, "device": device, "versions": versions()}
        return hash_of(keys)

    def _without_failure(self) -> dict[tuple[Split, int], list[AttemptRow]]:
        """Test runs of the last evaluation in which every attempt succeeded: argmax would have picked the same.

        Their rows are added to the log, under the name of argmax.
        """
        runs: dict[tuple[Split, int], list[AttemptRow]] = {}
        for row in attempts.read(self._context.log.path):
            if (row.phase, row.policy, row.step) == ("eval", self._context.cfg.policy.name, self._step):
                runs.setdefault((row.split, row.run), []).append(replace(row, policy=self._policy.name))
        clean = {key: rows for key, rows in runs.items() if all(row.success for row in rows)}
        self._context.log.append(*(row for rows in clean.values() for row in rows))
        return clean

    def _last(self, robot: Robot) -> Evaluation:
        """The last evaluation, with a film if the robot makes one, and a figure of what failed."""
        context, failed = self._context, figures.Failures()

        def watch(attempt: Attempt) -> None:
            if not attempt.outcome.success:
                failed.add(attempt)

        with robot.film(context.folder / "video.mp4"):
            result = self._measure(robot, watch=watch)
        if failed.counts:
            title = f"{context.title}: failed attempts of the last evaluation"
            figures.failures(failed, self._module.affordances, robot, title, context.figures / "failures.png")
        return result


def _kept_evaluation(path: Path) -> tuple[Evaluation, list[AttemptRow]]:
    kept = read_json(path)
    try:
        return Evaluation.model_validate(kept["result"]), [AttemptRow.parse(texts) for texts in kept["rows"]]
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, error) from None
