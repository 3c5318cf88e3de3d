"""Which runs may be averaged, and which averages compared.

An arm is what differs by seed alone: same choices, same hash, same versions, same protocol. Arms of one primitive that were
tested alike form a bench, and only arms of the same bench are compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from see2act.analysis.paper import TASKS, TRANSFERS
from see2act.analysis.runs import CONFIGURATION, NO_MATTER, UNKNOWN, Run, Unfinished, begins, read
from see2act.experiment.results import PHASES, SPLITS

SHOWN = (
    *("model", "objects", "workspace", "workspace.pixel", "camera", "policy", "precision", "robot.motion"),
    *("evaluate.runs", "evaluate.attempts.seen", "evaluate.attempts.unseen", "evaluate.scenes", "finetune.attempts"),
)
"""What a bench is described by, beside whatever else tells it from the others of its primitive."""
ENOUGH = 3
"""Seeds below which nothing is concluded."""


@dataclass(frozen=True)
class Arm:
    """Runs that differ by seed alone, by seed."""

    runs: tuple[Run, ...]
    differs: str = ""
    """Where other arms of the bench have other values: ``finetune.logit_scale=1.0``."""
    alone: bool = True
    """No other arm of the bench has its task and transfer."""

    @property
    def primitive(self) -> str:
        """Of all its runs, like everything that was chosen."""
        return self.runs[0].choices["primitive"]

    @property
    def task(self) -> str:
        """The source."""
        return self.runs[0].choices["task"]

    @property
    def transfer(self) -> str:
        """What was copied."""
        return self.runs[0].choices["transfer"]

    @property
    def hash(self) -> str:
        """Of the configuration."""
        return str(self.runs[0].result.config_hash)

    @property
    def seeds(self) -> list[int]:
        """Of its runs."""
        return [run.seed for run in self.runs]

    @property
    def learned(self) -> bool:
        """Whether it was fine-tuned at all."""
        return not self.runs[0].result.eval.repeated

    @property
    def cell(self) -> str:
        """Source and transfer."""
        return "none (random)" if self.task == "none" else f"{self.task}, {self.transfer}"

    @property
    def name(self) -> str:
        """As figures and tables have it."""
        return self.cell if self.alone else f"{self.cell} [{self.hash[:6]}]"


@dataclass(frozen=True)
class Bench:
    """Arms of one primitive, tested alike."""

    primitive: str
    number: int
    """Among the benches of its primitive, from 1; 0 if it is the only one."""
    setting: dict[str, str]
    arms: tuple[Arm, ...]
    peculiar: tuple[str, ...] = ()
    """Keys of the setting in which the benches of this primitive differ."""

    @property
    def name(self) -> str:
        """``suction``, or ``suction, setting 2``."""
        return f"{self.primitive}, setting {self.number}" if self.number else self.primitive

    @property
    def slug(self) -> str:
        """The name, for files and links."""
        return f"{self.primitive}-{self.number}" if self.number else self.primitive

    def described(self) -> dict[str, str]:
        """The setting, as far as a reader needs it."""
        return {key: self.setting.get(key, UNKNOWN) for key in dict.fromkeys([*SHOWN, *self.peculiar])}


@dataclass(frozen=True)
class Found:
    """Everything in a folder of runs."""

    benches: list[Bench]
    unfinished: list[Unfinished]
    broken: list[tuple[str, str]]
    notices: list[str]
    """What a reader must know before believing a number."""

    @property
    def runs(self) -> list[Run]:
        """All that count."""
        return [run for bench in self.benches for arm in bench.arms for run in arm.runs]


def find(folder: Path) -> Found:
    """All runs below ``folder``, grouped."""
    held = read(folder)
    notices = held.notices
    benches = _benches(_once_each(held.runs, notices), notices)
    if held.unfinished:
        notices.append(f"{_count(len(held.unfinished), 'run')} not finished and not counted: see the list below.")
    return Found(benches, held.unfinished, held.broken, notices)


def _once_each(runs: list[Run], notices: list[str]) -> list[list[Run]]:
    """Runs of each arm by seed, each seed once."""
    arms: dict[Any, dict[int, list[Run]]] = {}
    for run in runs:
        key = (run.result.config_hash, *(tuple(sorted(part.items())) for part in (run.choices, run.setting)))
        arms.setdefault(key, {}).setdefault(run.seed, []).append(run)
    kept = []
    for seeds in arms.values():
        for seed, same in seeds.items():
            same.sort(key=lambda run: (run.folder.name != f"seed{seed}", run.place))
            for other in same[1:]:
                equal = all(other.result.phase(phase) == same[0].result.phase(phase) for phase in PHASES)
                notices.append(
                    f"The same run is there twice, with {'the same' if equal else 'OTHER'} numbers: "
                    f"{same[0].place} counts, {other.place} does not."
                )
        kept.append([seeds[seed][0] for seed in sorted(seeds)])
    return kept


def _benches(arms: list[list[Run]], notices: list[str]) -> list[Bench]:
    groups: dict[str, dict[Any, list[Arm]]] = {}
    for runs in arms:
        setting = tuple(sorted(runs[0].setting.items()))
        groups.setdefault(runs[0].choices["primitive"], {}).setdefault(setting, []).append(Arm(tuple(runs)))
    benches = []
    for primitive in sorted(groups, key=lambda name: (name != "suction", name)):
        settings = sorted(groups[primitive].items(), key=lambda item: (-sum(len(arm.runs) for arm in item[1]), item[0]))
        known = [dict(setting) for setting, _ in settings if dict(setting)[CONFIGURATION] != UNKNOWN]
        peculiar = ((CONFIGURATION,) if len(known) < len(settings) else ()) + _varying(known)
        mine = []
        for number, (setting, members) in enumerate(settings, 1):
            number = number if len(settings) > 1 else 0
            mine.append(Bench(primitive, number, dict(setting), _labelled(members), peculiar))
        if len(mine) > 1:
            told = "; ".join(
                f"{b.number}: {_pairs(b.setting, _told(b, peculiar))} ({_count(len(b.arms), 'arm')})" for b in mine
            )
            notices.append(f"{primitive} was tested in {len(mine)} settings, which are kept apart. {told}.")
        benches += mine
    notices += _tell(benches)
    return benches


def _labelled(arms: list[Arm]) -> tuple[Arm, ...]:
    """In the paper's order, with what tells each from the others beside its task and transfer."""
    cells = Counter((arm.task, arm.transfer) for arm in arms)
    chosen = {*_varying([_relevant(arm, across=True) for arm in arms])}
    labelled = []
    for arm in arms:
        cell = [_relevant(other) for other in arms if (other.task, other.transfer) == (arm.task, arm.transfer)]
        keys = sorted(chosen | {*_varying(cell)})
        differs = _pairs(_relevant(arm), keys)
        labelled.append(replace(arm, differs=differs, alone=cells[arm.task, arm.transfer] == 1))
    return tuple(sorted(labelled, key=lambda arm: (*_rank(TASKS, arm.task), *_rank(TRANSFERS, arm.transfer), arm.hash)))


def _relevant(arm: Arm, across: bool = False) -> dict[str, str]:
    """What an arm was configured to; ``across`` tasks and transfers, which set keys of their own."""
    skip = (*NO_MATTER, "task", "transfer") if across else NO_MATTER
    return {key: value for key, value in arm.runs[0].config.items() if not begins(key, skip)}


def _varying(settings: list[dict[str, str]]) -> tuple[str, ...]:
    keys = dict.fromkeys(key for setting in settings for key in setting)
    return tuple(key for key in keys if len({setting.get(key) for setting in settings}) > 1)


def _told(bench: Bench, keys: tuple[str, ...]) -> tuple[str, ...]:
    return (CONFIGURATION,) if bench.setting[CONFIGURATION] == UNKNOWN else keys


def _pairs(values: dict[str, str], keys: Iterable[str]) -> str:
    return ", ".join(f"{key}={values.get(key, 'absent')}" for key in keys)


def _rank(order: tuple[str, ...], name: str) -> tuple[int, str]:
    return (order.index(name) if name in order else len(order)), name


def _tell(benches: list[Bench]) -> list[str]:
    """What a reader must know of benches, each thing once."""
    told: dict[str, list[str]] = {}
    for bench in benches:
        for sentence in _warnings(bench):
            told.setdefault(sentence, []).append(bench.name)
    return [f"{'; '.join(names)}: {sentence}" for sentence, names in told.items()]


def _warnings(bench: Bench) -> Iterator[str]:
    cells: dict[str, list[Arm]] = {}
    for arm in bench.arms:
        cells.setdefault(arm.cell, []).append(arm)
    within: set[str] = set()
    for cell, arms in cells.items():
        if len(arms) > 1:
            within |= {*_varying([_relevant(arm) for arm in arms])}
            each = "; ".join(f"{arm.hash} ({arm.differs or 'no difference in .hydra/config.yaml'})" for arm in arms)
            yield f"{cell} was run with {len(arms)} configurations, a row each: {each}."
    across = [key for key in _varying([_relevant(arm, across=True) for arm in bench.arms]) if key not in within]
    if across:
        yield f"arms differ in more than their source and transfer: {', '.join(across)}, as said beneath their names."
    if bench.setting.get("evaluate.scenes") == "develop":
        yield "evaluated on the scenes to choose settings by (evaluate.scenes=develop), so this is no result to report."
    most = tuple(bench.setting.get(f"evaluate.attempts.{split}", UNKNOWN) for split in SPLITS)
    if most != ("25", "15"):
        yield f"test runs of at most {most[0]} attempts with seen and {most[1]} with unseen objects; the paper has 25 and 15."
    seeds = {tuple(arm.seeds) for arm in bench.arms}
    if len(seeds) > 1:
        each = "; ".join(f"{arm.name}: {' '.join(map(str, arm.seeds))}" for arm in bench.arms)
        yield f"arms have different seeds, as in a sweep that is not finished ({each})."
    few = [arm.name for arm in bench.arms if len(arm.runs) < ENOUGH]
    if len(few) == len(bench.arms):
        yield f"no arm has {ENOUGH} seeds: too few to conclude from."
    elif few:
        yield f"fewer than {ENOUGH} seeds, too few to conclude from: {'; '.join(few)}."


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
