"""Wrong values for the keys of a configuration, from the annotations that the schema and the classes have."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from inspect import signature
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from pydantic import AfterValidator
from pydantic.fields import FieldInfo

from see2act.experiment.annotations import annotation_of
from see2act.experiment.config import Config

WORDS = st.text("abcdefghij", min_size=3, max_size=8).filter(lambda word: word not in ("inf", "nan"))
"""That are no numbers, no booleans, and no names of anything."""
LISTS = st.lists(st.integers(-3, 3), max_size=3)
MAPPINGS = st.dictionaries(WORDS, st.integers(-3, 3), min_size=1, max_size=2)
NOT_FINITE = st.sampled_from([math.nan, math.inf, -math.inf])


@dataclass(frozen=True)
class Kind:
    """What a key may hold, as far as its annotation says."""

    base: Any
    """``int``, ``float``, ``bool`` or ``str``."""
    optional: bool = False
    low: float = -math.inf
    high: float = math.inf
    infinite: bool = False
    """Whether infinity is allowed."""
    closed: bool = False
    """Whether only some words are allowed, none of which has a space in it."""

    def wrong(self) -> st.SearchStrategy[Any]:
        """Values that it may not hold."""
        kinds: list[st.SearchStrategy[Any]] = [LISTS, MAPPINGS]
        if self.base in (int, float):
            kinds += [WORDS, st.just(math.nan)]
            kinds += [st.just(-math.inf if self.infinite else math.inf)]
            if self.low > -math.inf:
                kinds += [st.floats(-1e6, self.low - 0.01), st.integers(-(10**12), math.ceil(self.low) - 1)]
            if self.high < math.inf:
                kinds += [st.floats(self.high + 0.01, 1e12), st.integers(math.floor(self.high) + 1, 10**12)]
        if self.base is int:
            kinds += [st.floats(0.01, 0.99), NOT_FINITE]
        if self.base is bool:
            kinds += [WORDS]
        if self.closed:
            kinds += [WORDS.map(lambda word: f"{word} {word}"), st.just("")]
        if not self.optional:
            kinds += [st.none()]
        return st.one_of(kinds)


def kind_of(annotation: Any) -> Kind | None:
    """The same, from an annotation; None where it says nothing that is plain."""
    if get_origin(annotation) is Annotated:
        inner, *notes = get_args(annotation)
        kind = kind_of(inner)
        return kind and _bounded(kind, notes)
    if get_origin(annotation) in (Union, UnionType):
        others = [part for part in get_args(annotation) if part is not NoneType]
        kind = kind_of(others[0]) if len(others) == 1 else None
        return kind and replace(kind, optional=True)
    return Kind(annotation) if annotation in (int, float, bool, str) else None


def _bounded(kind: Kind, notes: list[Any]) -> Kind:
    each = [inner for note in notes for inner in (note.metadata if isinstance(note, FieldInfo) else [note])]
    for note in each:
        kind = replace(
            kind,
            low=max(kind.low, getattr(note, "ge", -math.inf), getattr(note, "gt", -math.inf)),
            high=min(kind.high, getattr(note, "le", math.inf), getattr(note, "lt", math.inf)),
            infinite=kind.infinite or bool(getattr(note, "allow_inf_nan", False)),
            closed=kind.closed or isinstance(note, AfterValidator),
        )
    return kind


def keys_of_schema(schema: Any = Config, path: str = "") -> Iterator[tuple[str, Kind]]:
    """Every key of the schema that holds something plain."""
    hints = get_type_hints(schema, include_extras=True)
    for field in fields(schema):
        key = f"{path}{field.name}"
        if is_dataclass(hints[field.name]):
            yield from keys_of_schema(hints[field.name], f"{key}.")
        elif kind := kind_of(hints[field.name]):
            yield key, kind


def keys_of_classes(cfg: DictConfig, path: str = "") -> Iterator[tuple[str, Kind]]:
    """Every key of a configuration that is an argument of what its node builds, and plain."""
    for name in map(str, cfg):
        if OmegaConf.is_dict(cfg[name]):
            yield from keys_of_classes(cfg[name], f"{path}{name}.")
            continue
        target: Any = get_object(cfg._target_) if "_target_" in cfg else None
        known = target and name in signature(target).parameters
        if known and (kind := kind_of(annotation_of(target, name))):
            yield f"{path}{name}", kind
