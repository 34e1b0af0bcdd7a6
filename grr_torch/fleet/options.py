"""What a build of a sweep may say: the arguments of `load_robot`, `make_task` and `build`, by their names."""

from __future__ import annotations

import inspect
import math
import sys
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.resolution.build import build
from grr_torch.robots.load import load_robot
from grr_torch.spaces.task import make_task

# arguments that a file cannot hold, or that are named otherwise there
_NOT_NAMED = {
    *("name_or_path", "robot", "dtype", "kind", "dimension"),
    *("tolerances", "check", "checkpoint", "resume", "progress"),
}
_RENAMED = {"rpy": "rotation"}
# whole numbers beyond it are none that a float holds
_LARGEST = sys.float_info.max
_SIMPLE = {bool: "true or false", int: "a whole number", float: "a number", str: "text", types.NoneType: "null"}


@dataclass(frozen=True)
class Option:
    """An argument that a build of a sweep may give.

    Attributes:
        owner: "robot", "task" or "build": which function takes it.
        argument: Its name there.
        hint: Its type there.
        default: Its default there.
    """

    owner: str
    argument: str
    hint: Any
    default: Any


@cache
def known_options() -> Mapping[str, Option]:
    """Every option by its name in a sweep; arguments that these functions gain are options from then on."""
    found = {"robot": Option("robot", "name_or_path", str, None)}
    for owner, function in (("robot", load_robot), ("task", make_task), ("build", build)):
        hints = get_type_hints(function)
        for name, parameter in inspect.signature(function).parameters.items():
            if name not in _NOT_NAMED:
                found[_RENAMED.get(name, name)] = Option(owner, name, hints[name], parameter.default)
    return found


def check_option(name: str, value: Any) -> Any:
    """A value as the option takes it: numbers that stand for lengths, angles and weights as floats.

    Raises:
        UnknownNameError: There is no such option.
        ParameterError: The value is of no type that it takes.
    """
    options = known_options()
    if name not in options:
        raise UnknownNameError("option of a build", name, tuple(options))
    hint = options[name].hint
    if name == "max_slope" and value == math.inf:
        return value  # no bound, where null is that of the preset
    if not _fits(value, hint):
        raise ParameterError(name, repr(value), _describe(hint))
    return _floats(value, top=_takes(hint, float) and not _takes(hint, int))


def of_owner(owner: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the options that a function takes, by its names for them."""
    known = known_options()
    return {known[name].argument: value for name, value in options.items() if known[name].owner == owner}


def _members(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _takes(hint: Any, kind: type) -> bool:
    return kind in _members(hint)


def _fits(value: Any, hint: Any) -> bool:
    return any(_fits_one(value, member) for member in _members(hint))


def _fits_one(value: Any, hint: Any) -> bool:
    origin = get_origin(hint) or hint
    if origin in (bool, str, types.NoneType):
        return isinstance(value, origin)
    if origin in (int, float):
        if not isinstance(value, int if origin is int else int | float) or isinstance(value, bool):
            return False
        return -_LARGEST <= value <= _LARGEST
    if not isinstance(origin, type) or not issubclass(origin, Mapping | Sequence):
        return False  # a tensor, a graph, a path: none that a file could hold as such
    inside = [part for part in get_args(hint) if part is not Ellipsis]
    if issubclass(origin, Mapping):
        return isinstance(value, dict) and all(
            _fits(key, inside[0]) and _fits(item, inside[1]) for key, item in value.items()
        )
    if not isinstance(value, list):
        return False
    if issubclass(origin, tuple) and len(inside) == len(get_args(hint)) and len(inside) != len(value):
        return False
    return all(any(_fits(item, part) for part in inside) for item in value)


def _describe(hint: Any) -> str:
    said = [_SIMPLE[part] for part in _members(hint) if part in _SIMPLE]
    origins = [get_origin(part) or part for part in _members(hint)]
    kinds = [part for part in origins if isinstance(part, type)]
    said += ["names with values"] if any(issubclass(part, Mapping) for part in kinds) else []
    lists = any(issubclass(part, Sequence) and part is not str for part in kinds)
    return ", or ".join(said + (["a list of as many entries as it takes"] if lists else []))


def _floats(value: Any, top: bool) -> Any:
    if isinstance(value, list):
        return [_floats(item, True) for item in value]
    if isinstance(value, dict):
        return {key: _floats(item, True) for key, item in value.items()}
    return float(value) if top and isinstance(value, int) and not isinstance(value, bool) else value
