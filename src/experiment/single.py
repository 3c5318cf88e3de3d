"""One run by itself or in a sweep: checked, skipped if it is finished, continued if it was interrupted."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf import DictConfig

from see2act.experiment.checks import check_run, validate
from see2act.experiment.folder import alone_in, claim, of_this_version, refuse_foreign, set_aside
from see2act.experiment.results import PHASES, SPLITS, RunResult, SplitCounts, read_result, wilson

log = logging.getLogger("see2act")
AGAIN = 0.01
"""Seconds after which an interrupt that was dropped is sent again."""


def run_checked(cfg: DictConfig, folder: Path) -> float:
    """One run in ``folder``; with ``force=true`` a finished one is moved aside first.

    Returns:
        The final success rate on unseen objects.

    Raises:
        UserError: The configuration cannot run, the folder holds another run, another process works in it, or given weights
            do not fit.
    """
    validate(cfg)
    refuse_foreign(folder, cfg)
    if cfg.force or not (folder / "result.json").exists():  # what is finished could run
        check_run(cfg)
    if cfg.force:
        with alone_in(folder):
            set_aside(folder)
    with alone_in(folder):  # a lock of the folder's own: one that was set aside has taken its lock along
        result = _finished(cfg, folder) or _run(cfg, folder)
    return result.eval.unseen.rate


def _finished(cfg: DictConfig, folder: Path) -> RunResult | None:
    path = folder / "result.json"
    if not path.exists():
        return None
    by = "" if of_this_version(path) else " by another version of the code"
    log.info("this run is finished already%s; force=true runs it again: %s", by, path)
    if cfg.robot.get("video") and not (folder / "video.mp4").exists():
        log.info("it was not filmed; force=true runs it again with a film")
    return read_result(path)


def _run(cfg: DictConfig, folder: Path) -> RunResult:
    # Imported late: torch and lightning take seconds, which --help should not.
    import torch

    from see2act.experiment.quiet import quiet
    from see2act.experiment.run import run
    from see2act.experiment.stages.transfer import check_weights

    quiet()
    torch.set_num_threads(cfg.threads)
    check_weights(cfg)
    claim(folder, cfg)  # only now: a refused run must not keep the folder to itself
    with _sigterm_interrupts():
        result = run(cfg, folder)
    _print(result, folder)
    return result


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """As Ctrl-C does. Lightning would wait for the next learning step, which an evaluation keeps waiting.

    Python drops an interrupt that arrives while it finalizes an object. Then it is sent again.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    told = sys.unraisablehook

    def again(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        else:
            told(dropped)

    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGTERM, signal.SIGALRM)}
    sys.unraisablehook = again
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = told
        for number, handler in before.items():
            signal.signal(number, handler)  # while Python ends, an interrupt would be a traceback


def _print(result: RunResult, folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    words = [str(result.choices[key]) for key in ("primitive", "task", "transfer")]
    table = Table(title=f"{' '.join(words)} seed {result.seed}")
    for column in ("success rate \\[95 %]", *(f"{split} objects" for split in SPLITS)):
        table.add_column(column, no_wrap=True)
    names = ("zero-shot", "after fine-tuning", "after, argmax")
    for name, phase in zip(names, PHASES, strict=True):
        evaluation = result.phase(phase)
        table.add_row(name, *(_cell(evaluation[split]) if evaluation else "-" for split in SPLITS))
    console = Console(width=80)
    console.print(table)
    console.print(f"minutes: {sum(result.seconds.values()) / 60:.1f}", highlight=False)
    for name in ("result.json", "attempts.csv", "transfer.json", "figures", "checkpoints"):
        console.print(f"  {folder / name}", highlight=False, soft_wrap=True)


def _cell(counts: SplitCounts) -> str:
    low, high = wilson(counts.successes, counts.attempts)
    return f"{counts.rate:.2f} \\[{low:.2f}, {high:.2f}] {counts.successes}/{counts.attempts}"
