"""Which runs may be averaged, and which averages may be compared.

A group is a set of runs that differ by seed alone: same choices, hash, versions and protocol. A comparison is a set of groups
of one primitive with the same protocol. Only groups of one comparison are compared with each other.
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
"""Keys that describe a comparison, besides those in which it differs from the others of its primitive."""
ENOUGH = 3
"""With fewer seeds the report draws no conclusion."""


@dataclass(frozen=True)
class Group:
    """Runs that differ by seed alone, ordered by seed."""

    runs: tuple[Run, ...]
    differs: str = ""
    """Keys in which it differs from other groups of the comparison: ``finetune.logit_scale=1.0``."""
    alone: bool = True
    """No other group of the comparison has its task and transfer."""

    @property
    def primitive(self) -> str:
        """``suction`` or ``grasp``."""
        return self.runs[0].choices["primitive"]

    @property
    def task(self) -> str:
        """The source task."""
        return self.runs[0].choices["task"]

    @property
    def transfer(self) -> str:
        """What was copied."""
        return self.runs[0].choices["transfer"]

    @property
    def hash(self) -> str:
        """Hash of the configuration."""
        return str(self.runs[0].result.config_hash)

    @property
    def seeds(self) -> list[int]:
        """Seeds of its runs."""
        return [run.seed for run in self.runs]

    @property
    def pretrain_seeds(self) -> set[str]:
        """Seeds of the vision models of its runs."""
        return {run.pretrain_seed for run in self.runs}

    @property
    def learned(self) -> bool:
        """Whether it was fine-tuned at all."""
        return not self.runs[0].result.eval.repeated

    @property
    def condition(self) -> str:
        """Source task and transfer."""
        return "none (random)" if self.task == "none" else f"{self.task}, {self.transfer}"

    @property
    def name(self) -> str:
        """The condition, with the hash if it is not unique; for figures and tables."""
        return self.condition if self.alone else f"{self.condition} [{self.hash[:6]}]"


@dataclass(frozen=True)
class Comparison:
    """Groups of one primitive, tested alike."""

    primitive: str
    number: int
    """Among the comparisons of its primitive, from 1; 0 if it is the only one."""
    protocol: dict[str, str]
    groups: tuple[Group, ...]
    peculiar: tuple[str, ...] = ()
    """Keys of the protocol in which the comparisons of this primitive differ."""

    @property
    def name(self) -> str:
        """``suction``, or ``suction, protocol 2``."""
        return f"{self.primitive}, protocol {self.number}" if self.number else self.primitive

    @property
    def slug(self) -> str:
        """The name, for files and links."""
        return f"{self.primitive}-{self.number}" if self.number else self.primitive

    def described(self) -> dict[str, str]:
        """The protocol, as far as a reader needs it."""
        return {key: self.protocol.get(key, UNKNOWN) for key in dict.fromkeys([*SHOWN, *self.peculiar])}


@dataclass(frozen=True)
class Found:
    """Everything in a folder of runs."""

    comparisons: list[Comparison]
    unfinished: list[Unfinished]
    broken: list[tuple[str, str]]
    notices: list[str]
    """What a reader must know before believing a number."""

    @property
    def runs(self) -> list[Run]:
        """All runs that count."""
        return [run for comparison in self.comparisons for group in comparison.groups for run in group.runs]


def find(folder: Path) -> Found:
    """All runs below ``folder``, grouped."""
    held = read(folder)
    notices = held.notices
    comparisons = _comparisons(_once_each(held.runs, notices), notices)
    if held.unfinished:
        notices.append(f"{_count(len(held.unfinished), 'run')} not finished and not counted: see the list below.")
    lines = [" ".join(notice.splitlines()) for notice in notices]  # whatever the files and folders have in them
    return Found(comparisons, held.unfinished, held.broken, lines)


def _once_each(runs: list[Run], notices: list[str]) -> list[list[Run]]:
    """Runs of each group by seed, each seed once."""
    groups: dict[Any, dict[int, list[Run]]] = {}
    for run in runs:
        key = (run.result.config_hash, *(tuple(sorted(part.items())) for part in (run.choices, run.protocol)))
        groups.setdefault(key, {}).setdefault(run.seed, []).append(run)
    kept = []
    for seeds in groups.values():
        for seed, same in seeds.items():
            same.sort(key=lambda run: (run.folder.name != f"seed{seed}", run.place))
            for other in same[1:]:
                equal = _numbers(other) == _numbers(same[0])
                notices.append(
                    f"The same run is there twice, with {'the same' if equal else 'OTHER'} numbers: "
                    f"{same[0].place} counts, {other.place} does not."
                )
        kept.append([seeds[seed][0] for seed in sorted(seeds)])
    return kept


def _numbers(run: Run) -> list[Any]:
    """Everything that was counted: whatever a table or figure of a run is made from."""
    return [*map(run.result.phase, PHASES), run.result.evals, run.result.curve]


def _comparisons(groups: list[list[Run]], notices: list[str]) -> list[Comparison]:
    by_primitive: dict[str, dict[Any, list[Group]]] = {}
    for runs in groups:
        protocol = tuple(sorted(runs[0].protocol.items()))
        by_primitive.setdefault(runs[0].choices["primitive"], {}).setdefault(protocol, []).append(Group(tuple(runs)))
    comparisons = []
    for primitive in sorted(by_primitive, key=lambda name: (name != "suction", name)):
        protocols = sorted(
            by_primitive[primitive].items(), key=lambda item: (-sum(len(group.runs) for group in item[1]), item[0])
        )
        known = [dict(protocol) for protocol, _ in protocols if dict(protocol)[CONFIGURATION] != UNKNOWN]
        peculiar = ((CONFIGURATION,) if len(known) < len(protocols) else ()) + _varying(known)
        mine = []
        for number, (protocol, members) in enumerate(protocols, 1):
            number = number if len(protocols) > 1 else 0
            mine.append(Comparison(primitive, number, dict(protocol), _labelled(members), peculiar))
        if len(mine) > 1:
            each = "; ".join(
                f"{b.number}: {_pairs(b.protocol, _described_by(b, peculiar))} ({_count(len(b.groups), 'group')})" for b in mine
            )
            notices.append(f"{primitive} was tested by {len(mine)} protocols, which are kept apart. {each}.")
        comparisons += mine
    notices += _notices(comparisons)
    return comparisons


def _labelled(groups: list[Group]) -> tuple[Group, ...]:
    """In the paper's order, with what tells each from the others beside its task and transfer."""
    members = Counter((group.task, group.transfer) for group in groups)
    chosen = {*_varying([_relevant(group, across=True) for group in groups])}
    labelled = []
    for group in groups:
        alike = [_relevant(other) for other in groups if (other.task, other.transfer) == (group.task, group.transfer)]
        keys = sorted(chosen | {*_varying(alike)})
        differs = _pairs(_relevant(group), keys)
        labelled.append(replace(group, differs=differs, alone=members[group.task, group.transfer] == 1))
    return tuple(sorted(labelled, key=lambda group: (*_rank(TASKS, group.task), *_rank(TRANSFERS, group.transfer), group.hash)))


def _relevant(group: Group, across: bool = False) -> dict[str, str]:
    """What a group was configured to; ``across`` tasks and transfers, which set keys of their own."""
    skip = (*NO_MATTER, "task", "transfer") if across else NO_MATTER
    return {key: value for key, value in group.runs[0].config.items() if not begins(key, skip)}


def _varying(protocols: list[dict[str, str]]) -> tuple[str, ...]:
    keys = dict.fromkeys(key for protocol in protocols for key in protocol)
    return tuple(key for key in keys if len({protocol.get(key) for protocol in protocols}) > 1)


def _described_by(comparison: Comparison, keys: tuple[str, ...]) -> tuple[str, ...]:
    return (CONFIGURATION,) if comparison.protocol[CONFIGURATION] == UNKNOWN else keys


def _pairs(values: dict[str, str], keys: Iterable[str]) -> str:
    return ", ".join(f"{key}={values.get(key, 'absent')}" for key in keys)


def _rank(order: tuple[str, ...], name: str) -> tuple[int, str]:
    return (order.index(name) if name in order else len(order)), name


def _notices(comparisons: list[Comparison]) -> list[str]:
    """Notices about comparisons, each sentence once."""
    notices: dict[str, list[str]] = {}
    for comparison in comparisons:
        for sentence in _warnings(comparison):
            notices.setdefault(sentence, []).append(comparison.name)
    return [f"{'; '.join(names)}: {sentence}" for sentence, names in notices.items()]


def _warnings(comparison: Comparison) -> Iterator[str]:
    conditions: dict[str, list[Group]] = {}
    for group in comparison.groups:
        conditions.setdefault(group.condition, []).append(group)
    within: set[str] = set()
    for condition, groups in conditions.items():
        if len(groups) > 1:
            within |= {*_varying([_relevant(group) for group in groups])}
            each = "; ".join(f"{group.hash} ({group.differs or 'no difference in .hydra/config.yaml'})" for group in groups)
            yield f"{condition} was run with {len(groups)} configurations, a row each: {each}."
    across = [key for key in _varying([_relevant(group, across=True) for group in comparison.groups]) if key not in within]
    if across:
        yield f"groups differ in more than their source and transfer: {', '.join(across)}, as the table says under their names."
    if comparison.protocol.get("evaluate.scenes") == "develop":
        yield "evaluated on the scenes that settings are chosen by (evaluate.scenes=develop), so this is no result to report."
    configured = comparison.protocol[CONFIGURATION] != UNKNOWN
    most = tuple(comparison.protocol.get(f"evaluate.attempts.{split}", UNKNOWN) for split in SPLITS)
    if configured and most != ("25", "15"):
        yield f"test runs of at most {most[0]} attempts with seen and {most[1]} with unseen objects; the paper has 25 and 15."
    seeds = {tuple(group.seeds) for group in comparison.groups}
    if len(seeds) > 1:
        each = "; ".join(f"{group.name}: {' '.join(map(str, group.seeds))}" for group in comparison.groups)
        yield f"groups have different seeds, as in a sweep that is not finished ({each})."
    shared = [group.name for group in comparison.groups if group.task != "none" and len(group.pretrain_seeds) < len(group.runs)]
    if configured and shared:
        yield f"seeds share vision models, so intervals leave out how vision models differ: {'; '.join(shared)}."
    few = [group.name for group in comparison.groups if len(group.runs) < ENOUGH]
    if len(few) == len(comparison.groups):
        yield f"no group has {ENOUGH} seeds: too few to conclude from."
    elif few:
        yield f"fewer than {ENOUGH} seeds, too few to conclude from: {'; '.join(few)}."


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
