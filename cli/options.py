"""What options take: numbers, files of known kinds, and nothing where they would have no effect."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from grr_torch.errors import ParameterError


def numbers(option: str, text: str, names: Sequence[str]) -> list[float]:
    """The numbers that an option takes, one for each name.

    Raises:
        ParameterError: They are not so many finite numbers.
    """
    return some_numbers(option, text, {len(names)}, f"{len(names)} finite numbers: {' '.join(names)}")


def some_numbers(option: str, text: str, counts: Collection[int], valid: str) -> list[float]:
    """The numbers that an option takes of which there may be more or fewer.

    Args:
        option: The option.
        text: What it was given, with spaces or commas between.
        counts: How many there may be.
        valid: What is valid, in words.

    Raises:
        ParameterError: They are not as many, or not all finite numbers.
    """
    try:
        values = [float(value) for value in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ParameterError(option, repr(text), valid)
    return values


def named_numbers(option: str, items: Sequence[str], valid: str) -> dict[str, float]:
    """The numbers that a repeatable option NAME=NUMBER gives.

    Raises:
        ParameterError: One is no number, or given twice.
    """
    found: dict[str, float] = {}
    for item in items:
        name, _, value = item.partition("=")
        if name in found:
            raise ParameterError(option, repr(item), f"one value for '{name}'")
        try:
            found[name] = float(value)
        except ValueError as error:
            raise ParameterError(option, repr(item), valid) from error
    return found


def check_ending(option: str, path: Path | None, ending: str) -> None:
    """Finds out whether a file to write, if there is one, is named after what will be in it.

    Raises:
        ParameterError: It is not.
    """
    if path is not None and path.suffix.lower() != ending:
        raise ParameterError(option, path, f"a file that ends in {ending}")


def check_unused(options: Mapping[str, object], beside: str) -> None:
    """Finds out whether options are given that would have no effect beside another one.

    Raises:
        ParameterError: One is given.
    """
    for option, value in options.items():
        if value is None or value is False or value == []:
            continue
        given = " ".join(map(str, value)) if isinstance(value, list) else value
        raise ParameterError(option, given, f"none with {beside}")
