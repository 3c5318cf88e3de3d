"""Values against the annotations of the schema, and of the classes that a configuration builds."""

from __future__ import annotations

import inspect
import sys
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
        TypeAdapter(Config).validate_python(plain)
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


def check_arguments(node: Any, path: str) -> None:
    """The same for whatever a configuration node builds: the signature of each ``_target_`` is its schema.

    Raises:
        ConfigError: With the key, the value and what is expected.
    """
    if not isinstance(node, DictConfig):
        return
    for key in map(str, node):
        check_arguments(node[key], f"{path}.{key}")
    if "_target_" not in node:
        return
    target = get_object(node._target_)
    parameters = inspect.signature(target).parameters
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    for name in (str(name) for name in node if not str(name).startswith("_")):
        if name not in parameters:
            if open_ended:
                continue
            raise ConfigError(f"{path} has no parameter '{name}': it takes {', '.join(parameters)}")
        value: Any = node[name]
        adapter = _adapter(target, name)
        if adapter is None or (OmegaConf.is_dict(value) and "_target_" in value):
            continue
        if OmegaConf.is_config(value):
            value = OmegaConf.to_container(value)
        try:
            adapter.validate_python(value)
        except ValidationError as error:
            raise ConfigError(f"{path}.{name}={value}: {_words(error.errors()[0]['msg'])}") from None


@cache
def _adapter(target: Any, name: str) -> TypeAdapter[Any] | None:
    """Validates one argument of a class or function; None where its annotation says nothing that can be checked here."""
    function = target.__init__ if inspect.isclass(target) and "__init__" in vars(target) else target
    annotation = inspect.signature(target).parameters[name].annotation
    names = vars(sys.modules[function.__module__])
    try:
        kind = eval(annotation, names) if isinstance(annotation, str) else annotation
        if not _is_plain(kind):
            return None
        return TypeAdapter(kind, config=ConfigDict(strict=True))
    except (NameError, TypeError, PydanticSchemaGenerationError):
        return None


def _is_plain(kind: Any) -> bool:
    """Whether a type is made of numbers, words and optional ones of these."""
    if get_origin(kind) is Annotated:
        return _is_plain(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return all(part is NoneType or _is_plain(part) for part in get_args(kind))
    return kind in (int, float, bool, str)


def _words(message: str) -> str:
    message = message.removeprefix("Value error, ").replace("Input should", "it must")
    message = message.replace("greater than or equal to", "at least").replace("less than or equal to", "at most")
    return message.replace("greater than", "above")
