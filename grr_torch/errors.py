"""Exceptions and warnings: each says what was wrong, what was given and what would be valid.

Every exception keeps these as fields, so that a program can act on them without parsing the text.
"""

from __future__ import annotations

import difflib
import operator
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class GrrError(Exception):
    """Base class of every error that bad input to grr_torch raises."""

    def __reduce__(self) -> tuple[Any, ...]:
        """As it is: its message is not what it is made from. Errors pass between processes."""
        return _remake, (type(self), self.args), vars(self)


def _remake(kind: type[GrrError], arguments: tuple[Any, ...]) -> GrrError:
    error = kind.__new__(kind)
    error.args = arguments
    return error


class GrrWarning(UserWarning):
    """Base class of the warnings: the work goes on, but not with everything that was given."""


def _listing(names: Sequence[str], limit: int = 30) -> str:
    shown = ", ".join(names[:limit])
    return f"{shown}, … ({len(names)} in all)" if len(names) > limit else shown or "none"


class UnknownNameError(GrrError):
    """A name that is not among the known ones.

    Attributes:
        kind: What the name stands for ("robot", "link", "joint", …).
        name: The name that was given.
        known: The names that would have been valid.
        nearest: The known name that is most like the given one, or None.
    """

    def __init__(self, kind: str, name: str, known: Sequence[str], hint: str = "") -> None:
        self.kind, self.name, self.known = kind, name, tuple(known)
        matches = difflib.get_close_matches(name, self.known, n=1, cutoff=0.5)
        self.nearest: str | None = matches[0] if matches else None
        guess = f" Did you mean '{self.nearest}'?" if self.nearest else ""
        super().__init__(f"unknown {kind} '{name}'.{guess} Known: {_listing(self.known)}.{hint}")


class UrdfError(GrrError):
    """A URDF that cannot be read or does not describe a robot.

    Attributes:
        source: The file (or the name of the text) it was read from.
        reason: What is wrong with it.
    """

    def __init__(self, source: str | os.PathLike[str], reason: str) -> None:
        self.source, self.reason = str(source), reason
        super().__init__(f"{source}: {reason}")


class MeshNotFoundError(GrrError):
    """A mesh that a URDF names and that is in none of the places it could be.

    Attributes:
        filename: The name in the URDF.
        link: The link it belongs to.
        searched: The paths that were tried.
    """

    def __init__(self, filename: str, link: str, searched: Sequence[Path]) -> None:
        self.filename, self.link, self.searched = filename, link, tuple(searched)
        places = ", ".join(str(path) for path in searched) or "nowhere: there is no folder to search"
        super().__init__(
            f"mesh '{filename}' of link '{link}' not found; looked at: {places}. "
            "More folders to search for package:// names are given by --package-dir (package_dirs); "
            "--allow-missing-meshes (allow_missing_meshes) does without."
        )


class ParameterError(GrrError, ValueError):
    """A parameter outside its valid range.

    Attributes:
        name: The parameter.
        value: The value that was given.
        valid: What would have been valid.
    """

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name, self.value, self.valid = name, value, valid
        super().__init__(f"{name}: got {value}; valid: {valid}")


def check_whole(name: str, value: object, low: int, high: int | None = None) -> int:
    """A whole number as an int; numpy's integers are such, True and False are not.

    Args:
        name: The parameter, for the error.
        value: What was given.
        low: The smallest valid number.
        high: The largest one; None: there is none.

    Raises:
        ParameterError: It is no whole number, or out of its range.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or number < low or (high is not None and number > high):
        valid = f"a whole number, {low:,} or more" if high is None else f"a whole number from {low:,} to {high:,}"
        # of a text, "got 100" would not say what is wrong
        raise ParameterError(name, repr(value) if isinstance(value, str) else value, valid)
    return number


def check_seed(seed: int) -> int:
    """The seed of a random generator.

    Raises:
        ParameterError: It is no whole number from 0 to 2⁶³ − 1.
    """
    return check_whole("seed", seed, 0, (1 << 63) - 1)


def check_kind(name: str, value: object, kind: type, origin: str) -> None:
    """Finds out whether a parameter is of the class that it should be.

    Args:
        name: The parameter's.
        value: What was given.
        kind: The class.
        origin: An example of one.

    Raises:
        ParameterError: It is not.
    """
    if not isinstance(value, kind):
        raise ParameterError(name, repr(value), f"a {kind.__name__}, such as {origin}")


class SeedError(GrrError):
    """Seeds of which none can start a roadmap.

    Attributes:
        reasons: One reason for each seed, by its index.
    """

    def __init__(self, message: str, reasons: dict[int, str] | None = None) -> None:
        self.reasons = reasons or {}
        super().__init__(message)


class FileFormatError(GrrError):
    """A file that is not what it should be: truncated, of another version, or not consistent with itself.

    Attributes:
        path: The file.
        reason: What is wrong with it.
    """

    def __init__(self, path: str | os.PathLike[str], reason: str) -> None:
        self.path, self.reason = Path(path), reason
        super().__init__(f"{path}: {reason}")


class OutputError(GrrError):
    """An output that cannot be written.

    Attributes:
        path: The file that was to be written.
        reason: Why it was not.
    """

    def __init__(self, path: str | os.PathLike[str], reason: str) -> None:
        self.path, self.reason = Path(path), reason
        super().__init__(f"cannot write {path}: {reason}")


class TrainingError(GrrError):
    """Training that cannot go on.

    Attributes:
        epoch: The epoch in which it stopped, counted from 1.
        checkpoint: The file that holds the last good state; None where none is kept.
    """

    def __init__(self, epoch: int, reason: str, checkpoint: Path | None) -> None:
        self.epoch, self.checkpoint = epoch, checkpoint
        kept = "no checkpoint is kept" if checkpoint is None else f"the last good state is in {checkpoint}"
        super().__init__(f"training stopped in epoch {epoch}: {reason}; {kept}")


class MissingPackageError(GrrError, ImportError):
    """A package that only a part of grr_torch needs, and that is not installed.

    Attributes:
        package: Its name.
        extra: The extra of grr-torch that brings it.
    """

    def __init__(self, package: str, extra: str, use: str) -> None:
        self.package, self.extra = package, extra
        super().__init__(f"{use} needs {package}, which is not installed: pip install 'grr-torch[{extra}]'")
