"""How long work reports where it is."""

from __future__ import annotations

from collections.abc import Callable

# called as progress(what is being done, how much of it is done, how much there is)
Progress = Callable[[str, int, int], None]


def silent(stage: str, done: int, total: int) -> None:
    """Reports nothing."""
