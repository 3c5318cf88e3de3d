"""How often a person has to fill the bin: said before anything moves."""

from __future__ import annotations

import math

from see2act.experiment import attempts, build
from see2act.experiment.context import RunContext
from see2act.experiment.results import SPLITS


def refills(context: RunContext, collecting: int) -> str:
    """One line on what is left of a run of an attended robot.

    Args:
        context: Of the run.
        collecting: Scenes that are still to be collected.
    """
    learning, testing = _learning(context), _evaluations(context) * context.cfg.evaluate.runs * len(SPLITS)
    times = {"to collect observations": collecting, "to learn": learning, "to evaluate": testing}
    counts = [f"{'at least ' * (what == 'to learn')}{count} {what}" for what, count in times.items() if count]
    return f"fillings of the bin by hand: {', '.join(counts) or 'none'}"


def _evaluations(context: RunContext) -> int:
    """Evaluations that are not finished."""
    progress, cfg = context.progress, context.cfg
    plain = cfg.evaluate.argmax and build.policy(cfg).suppress and progress.argmax is None
    return len(set(context.evaluated_at) - progress.evaluations.keys()) + int(plain)


def _learning(context: RunContext) -> int:
    """Training scenes that are needed if no bin is empty before its attempts are spent."""
    most, log = context.cfg.finetune.episode_attempts, context.log.path
    made = [row for row in attempts.read(log) if row.phase == "finetune"] if log.exists() else []
    under_way = sum(row.episode == made[-1].episode for row in made) if made else most
    return math.ceil(max(0, context.attempts - len(made) - (most - under_way)) / most)
