"""From a vision model to an affordance model: copy parameters by key, and report what was done with each key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from see2act.errors import TransferError
from see2act.modules.network import PixelNetwork

PARTS = ("backbone", "head")
ALWAYS = "normalization"
"""The statistics of the source's training data are copied with any part."""
AVERAGE = "normalization.average"
"""A statistic of heightmaps. Weights that others trained do not have it; then the network keeps the value measured here."""
SHOWN = 5
"""Problems that an error message lists."""


@dataclass
class TransferReport:
    """What a transfer did with every key. Values are shapes."""

    parts: list[str]
    copied: dict[str, list[int]] = field(default_factory=dict)
    left_at_initialisation: dict[str, list[int]] = field(default_factory=dict)
    set_to_zero: dict[str, list[int]] = field(default_factory=dict)
    unused: dict[str, list[int]] = field(default_factory=dict)

    def summary(self) -> str:
        """One line for the log."""
        return (
            f"transfer of {' and '.join(self.parts) or 'nothing'}: {len(self.copied)} keys copied, "
            f"{len(self.left_at_initialisation)} left at initialisation, {len(self.set_to_zero)} set to zero, "
            f"{len(self.unused)} in the source but unused"
        )

    def as_dict(self) -> dict[str, object]:
        """The content of ``transfer.json``."""
        return asdict(self)


def copy_parts(
    source: Mapping[str, Tensor],
    network: PixelNetwork,
    parts: Sequence[str],
    optional: Sequence[str] = (),
    zero: Sequence[str] = (),
) -> TransferReport:
    """Copy ``parts`` of a network's state dict into ``network``.

    Args:
        source: State dict of a :class:`PixelNetwork`; may be empty if there are no ``parts``.
        network: Changed in place, after all checks have passed.
        parts: Any of ``backbone`` and ``head``.
        optional: Prefixes of keys that may be missing from the source. The network keeps its values, as for ``AVERAGE``.
        zero: Like ``optional``, but these are set to zero, so they contribute nothing until they are trained.

    Raises:
        TransferError: A part is missing from the source, its keys, shapes or types do not fit, it has values that are not
            finite, or none of its keys would be copied.
    """
    target = network.state_dict()
    report = TransferReport(parts=list(parts))
    if not parts:
        report.left_at_initialisation = {key: list(value.shape) for key, value in target.items()}
        return report
    wanted = {key for key in target if key.split(".")[0] in (*parts, ALWAYS)}
    for part in parts:
        _check(source, target, part, (*optional, *zero, AVERAGE))
    for key, value in target.items():
        if key in wanted and key in source:
            value.copy_(source[key])
            report.copied[key] = list(value.shape)
        elif key in wanted and key.startswith(tuple(zero)):
            value.zero_()
            report.set_to_zero[key] = list(value.shape)
        else:
            report.left_at_initialisation[key] = list(value.shape)
    report.unused = {key: list(value.shape) for key, value in source.items() if key not in wanted}
    return report


def _flaw(theirs: Tensor, ours: Tensor) -> str | None:
    """What makes values useless, whatever their shape."""
    if theirs.is_floating_point() != ours.is_floating_point():
        return f"is of {theirs.dtype} there and of {ours.dtype} here".replace("torch.", "")
    return None if bool(torch.isfinite(theirs.to(ours.dtype)).all()) else "has values that are no finite numbers"


def _check(source: Mapping[str, Tensor], target: Mapping[str, Tensor], part: str, optional: tuple[str, ...]) -> None:
    theirs = {key: list(value.shape) for key, value in source.items() if key.split(".")[0] in (part, ALWAYS)}
    ours = {key: list(value.shape) for key, value in target.items() if key.split(".")[0] in (part, ALWAYS)}
    problems = [f"{key} is missing" for key in ours if key not in theirs and not key.startswith(optional)]
    if not any(key.startswith(part) for key in ours.keys() & theirs.keys()):
        problems.insert(0, f"nothing of it is called {part}")
    problems += [f"{key} is not in this network" for key in theirs if key not in ours]
    problems += [
        f"{key} is {theirs[key]} there and {ours[key]} here" for key in ours if key in theirs and ours[key] != theirs[key]
    ]
    if problems:
        more = f" and {len(problems) - SHOWN} more" if len(problems) > SHOWN else ""
        raise TransferError(
            f"the source's {part} does not fit this network: {'; '.join(problems[:SHOWN])}{more}: "
            "use the model (and model.width) that the source was trained with"
        )
    if flaws := [f"{key} {flaw}" for key in ours if key in theirs and (flaw := _flaw(source[key], target[key]))]:
        raise TransferError(f"the source's {part} is of no use: {'; '.join(flaws[:SHOWN])}: bring weights that can be used")
