"""Values against the annotations of the schema, and of the classes that a configuration builds."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Collection, Mapping
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from pydantic import ConfigDict, PydanticSchemaGenerationError, TypeAdapter, ValidationError

from see2act.errors import ConfigError
from see2act.experiment.config import Config


def check_schema(cfg: DictConfig, only_keys: bool = False) -> None:
    """Refuse keys that do not exist and values out of their range, by the schema's own annotations.

    Args:
        cfg: A configuration.
        only_keys: Leave values alone, as of a sweep, whose jobs check their own.

    Raises:
        ConfigError: With the first key that is wrong.
    """
    plain = OmegaConf.to_container(OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"]), resolve=True)
    try:
        _schema().validate_python(plain)
    except ValidationError as error:
        unknown = [problem for problem in error.errors() if problem["type"] == "unexpected_keyword_argument"]
        if only_keys and not unknown:
            return
        problem = (unknown or error.errors())[0]
        *path, last = problem["loc"]
        if unknown:
            group = OmegaConf.select(cfg, ".".join(map(str, path))) if path else cfg
            known = [str(key) for key in group if key != last]
            where = f" of {'.'.join(map(str, path))}" if path else ""
            raise ConfigError(
                f"there is no configuration key '{'.'.join(map(str, problem['loc']))}': the keys{where} are {', '.join(known)}"
            ) from None
        raise ConfigError(f"{'.'.join(map(str, problem['loc']))}={problem['input']}: {_words(problem['msg'])}") from None


@cache
def _schema() -> TypeAdapter[Config]:
    return TypeAdapter(Config)


def check_arguments(node: Any, path: str, given: Collection[str] = (), partial: bool = False) -> None:
    """The same for whatever a configuration node builds: the signature of each ``_target_`` is its schema.

    Args:
        node: Part of a configuration.
        path: Its key.
        given: Arguments that it gets besides.
        partial: Whether what it builds is called for the rest of its arguments, whatever they are.

    Raises:
        ConfigError: With the key, the value and what is expected.
    """
    if not isinstance(node, DictConfig):
        return
    for key in map(str, node):
        check_arguments(node[key], f"{path}.{key}")
    if "_target_" not in node:
        return
    if node.get("_partial_", False) is not partial or "_args_" in node:
        raise ConfigError(f"{path} has a _partial_ or _args_ of its own: leave both as they are in conf/")
    target = _target(node._target_, path)
    parameters = _parameters(target)
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    for name in (str(name) for name in node if not str(name).startswith("_")):
        if name in parameters:
            _check_argument(target, name, node[name], path)
        elif not open_ended:
            raise ConfigError(f"{path} has no parameter '{name}': it takes {', '.join(parameters)}")
    missing = [name for name, parameter in parameters.items() if _is_required(parameter) and name not in (*node, *given)]
    if missing and not partial:
        raise ConfigError(f"{path}.{missing[0]} is missing: leave it as it is in conf/, or give a value")


def check_builds(node: Any, path: str) -> None:
    """Refuse a node that does not say what it builds.

    Raises:
        ConfigError: It has no ``_target_``.
    """
    if not _builds(node):
        raise ConfigError(f"{path}={node} builds nothing: choose an option of conf/, or give a mapping with its _target_")


def _builds(node: Any) -> bool:
    return OmegaConf.is_dict(node) and "_target_" in node


def _target(name: Any, path: str) -> Any:
    """What a ``_target_`` names.

    Raises:
        ConfigError: Nothing that can be called.
    """
    try:
        target = get_object(name) if isinstance(name, str) else None
    except (ImportError, ValueError) as error:
        reason = str(error).partition("\nAre you sure")[0]  # Hydra asks on a line of its own
        raise ConfigError(f"{path}._target_={name!r} cannot be imported ({' '.join(reason.split())}): {_PATH}") from None
    if not callable(target):
        raise ConfigError(f"{path}._target_={name!r} is no class or function: {_PATH}")
    return target


def _is_required(parameter: inspect.Parameter) -> bool:
    return parameter.default is parameter.empty and parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)


_PATH = "give the path of one, as package.module.Class"


def _parameters(target: Any) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(target).parameters


def _check_argument(target: Any, name: str, value: Any, path: str) -> None:
    kind = annotation_of(target, name)
    if _is_ours(kind) and not (_builds(value) or (value is None and _parameters(target)[name].default is None)):
        raise ConfigError(
            f"{path}.{name}={value} builds no {kind.__name__}: leave it as it is in conf/, and change keys below it"
        )
    adapter = _adapter(target, name)
    if adapter is None or _builds(value):
        return
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value)
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        raise ConfigError(f"{path}.{name}={value}: {_words(error.errors()[0]['msg'])}") from None


@cache
def annotation_of(target: Any, name: str) -> Any:
    """The annotation of one argument of a class or function; None where it names what its module does not know."""
    function = target.__init__ if inspect.isclass(target) and "__init__" in vars(target) else target
    annotation = _parameters(target)[name].annotation
    try:
        return eval(annotation, vars(sys.modules[function.__module__])) if isinstance(annotation, str) else annotation
    except (NameError, TypeError):
        return None


@cache
def _adapter(target: Any, name: str) -> TypeAdapter[Any] | None:
    """Validates one argument; None where its annotation says nothing that can be checked here. A number must be finite unless
    the annotation allows others."""
    try:
        kind = annotation_of(target, name)
        return TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False)) if _is_plain(kind) else None
    except (TypeError, PydanticSchemaGenerationError):
        return None


def _is_plain(kind: Any) -> bool:
    """Whether a type is made of numbers, words and optional ones of these."""
    if get_origin(kind) is Annotated:
        return _is_plain(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return all(part is NoneType or _is_plain(part) for part in get_args(kind))
    return kind in (int, float, bool, str)


def _is_ours(kind: Any) -> bool:
    """Whether a type is a class of this package, which a configuration builds from a mapping of its own."""
    return inspect.isclass(kind) and kind.__module__.partition(".")[0] == "see2act"


def _words(message: str) -> str:
    message = message.removeprefix("Value error, ").replace("Input should", "it must")
    message = message.replace("greater than or equal to", "at least").replace("less than or equal to", "at most")
    return message.replace("greater than", "above")
