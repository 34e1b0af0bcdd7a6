"""What the commands share: messages, progress, tables, and errors as one line with exit code 2."""

from __future__ import annotations

import functools
import json
import math
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, ParamSpec, TextIO, TypeVar

import typer

from grr_torch.errors import GrrError, GrrWarning
from grr_torch.progress import Outlook, Plan

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

P = ParamSpec("P")
R = TypeVar("R")

# said in place of distances and shares
NOT_CHECKED = "not checked: no sphere model"

# connected parts whose sizes are listed
_PARTS = 5

# seconds from one line about progress to the next, where there is no terminal
_EVERY = 10.0

# where builds run
ENGINES = ("local", "ray")


def reports_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Turns bad input into one line on standard error and exit code 2, Ctrl-C into exit code 130."""

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", GrrWarning)
                warnings.showwarning = _show_warning
                return command(*args, **kwargs)
        except GrrError as error:
            typer.secho(f"error: {error}", err=True, fg=typer.colors.RED)
            raise typer.Exit(2) from error
        except (RuntimeError, MemoryError) as error:
            # torch's are RuntimeErrors; it is not imported here, where it may not be needed
            signs = ("out of memory", "ALLOC_FAILED", "can't allocate memory")
            if not isinstance(error, MemoryError) and not any(sign in str(error) for sign in signs):
                raise
            given = (str(error).splitlines() or [type(error).__name__])[0]
            typer.secho(
                f"error: the memory is full, of this machine or its GPU: {given}", err=True, fg=typer.colors.RED
            )
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            typer.echo("interrupted: nothing was written", err=True)
            raise typer.Exit(130) from error

    return wrapped


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if issubclass(category, GrrWarning):
        typer.secho(f"warning: {message}", err=True, fg=typer.colors.YELLOW)


@contextmanager
def progress_bar() -> Iterator[ProgressBar]:
    """A bar for each stage on standard error, gone when the work is done; lines where there is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    left = TextColumn("{task.fields[left]}")
    shown = console.is_terminal
    with Bar(*columns, left, console=console, transient=True, disable=not shown) as bar:
        progress = ProgressBar(bar)
        with nullcontext() if shown else _lines(progress):
            yield progress


@contextmanager
def _lines(progress: ProgressBar) -> Iterator[None]:
    """Says on standard error every ten seconds how long the work has taken and how far it is."""
    begun, finished = time.perf_counter(), threading.Event()

    def tell() -> None:
        while not finished.wait(_EVERY):
            if progress.line:
                typer.echo(f"{_duration(time.perf_counter() - begun)} {progress.line}", err=True)

    # reports come when they come: between two, minutes may pass
    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


class ProgressBar:
    """What work reports to.

    Where there is a plan of its stages, what is left of all of it is told; else, of the present stage alone, from how
    fast that has been. Stages may end early.

    Attributes:
        line: What was reported last, as a line.
    """

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._tasks: dict[str, Any] = {}
        self._reported: dict[str, int] = {}
        self._outlook: Outlook | None = None
        self.line = ""

    def foretell(self, plan: Plan) -> None:
        """Tells from here on what is left of a plan."""
        self._outlook = Outlook(plan)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Takes a report, as of `Progress`."""
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(stage, total=total, left="")
        elif done < self._reported[stage]:
            self._bar.reset(self._tasks[stage])  # it is done once more, or goes on from a checkpoint, at another speed
        self._reported[stage] = done
        for task in self._tasks.values():
            self._bar.update(task, left="")
        left = self._left(stage, done, total)
        self._bar.update(self._tasks[stage], completed=done, total=total, left=left)
        self.line = f"{stage} {done:,}/{total:,}" + (f", {left}" if left else "")

    def _left(self, stage: str, done: int, total: int) -> str:
        if self._outlook is not None:
            self._outlook(stage, done, total)
            seconds = self._outlook.left()
            return "" if seconds is None else f"about {_duration(seconds)} left of all"
        seconds = self._bar.tasks[self._tasks[stage]].time_remaining
        return "" if seconds is None or done == total else f"about {_duration(seconds)} left"


def _duration(seconds: float) -> str:
    hours, minutes = divmod(round(seconds) // 60, 60)
    return f"{hours}:{minutes:02}:{round(seconds) % 60:02}"


def print_json(data: dict[str, Any]) -> None:
    """One object on standard output; what is no finite number is null, as JSON has no other word for it."""
    typer.echo(json.dumps(finite(data), indent=2, allow_nan=False))


def finite(data: Any) -> Any:
    """Data for JSON in which all numbers are finite; None stands for others."""
    if isinstance(data, dict):
        return {name: finite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def print_rows(title: str, rows: list[tuple[str, str]]) -> None:
    """Names and values on standard output, a line each, however narrow the terminal."""
    typer.secho(title, bold=True)
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:{width}}  {value}")


def _cells_row(name: str, quality: dict[str, Any]) -> tuple[str, str]:
    certified, wound, spread = (quality[f"{name}_{figure}"] for figure in ("certified", "wound", "spread"))
    text = f"{100.0 * certified:.2f} % of {quality[name]:,}; {wound} with a winding, {spread} spread by more than 1 rad"
    return f"certified {name}", text


def _parts(sizes: Sequence[int]) -> str:
    """The sizes of connected parts, the largest first."""
    if len(sizes) < 2:
        return f"1: all {sizes[0]:,} vertices" if sizes else "none"
    listed, rest = sizes[:_PARTS], sizes[_PARTS:]
    more = f", and {len(rest):,} more of {sum(rest):,} in all" if rest else ""
    text = ", ".join(f"{size:,}" for size in listed)
    return f"{len(sizes):,}: {text} vertices{more}; no path leads from one to another"


def bounds_of(roadmap: Roadmap) -> list[list[float]]:
    """[low, high] of the roadmap's points along each axis [m]."""
    low, high = roadmap.positions.aminmax(dim=0)
    return [list(side) for side in zip(low.tolist(), high.tolist(), strict=True)]


def bounds_row(roadmap: Roadmap) -> tuple[str, str]:
    """Where the roadmap lies, as --bounds takes it."""
    return "bounds", " ".join(f"{end:.6g}" for side in bounds_of(roadmap) for end in side) + " m"


def show_table(head: list[str], rows: list[list[str]]) -> None:
    """Prints a table: on a terminal one that fits it, elsewhere in Markdown."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        typer.echo(markdown_table(head, rows))
        return
    table = Table()
    for name in head:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table, markup=False, highlight=False)


def markdown_table(head: list[str], rows: list[list[str]]) -> str:
    """A table that reads well as it is, and in a README."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def quality_rows(quality: dict[str, Any], parts: Sequence[int]) -> list[tuple[str, str]]:
    """The figures of `Roadmap.quality()` for people, and the sizes of the roadmap's connected parts."""

    def share(name: str) -> str:
        return "not measured" if quality[name] is None else f"{100.0 * quality[name]:.2f} %"

    def number(name: str, unit: str, digits: str = ".3f") -> str:
        return "none" if quality[name] is None else f"{quality[name]:{digits}} {unit}"

    reachable = quality["reachable_vertices"]
    of_reachable = "reachability not measured: --reachability 40" if reachable is None else f"of {reachable:,}"
    edges = quality["reachable_edges"]
    of_edges = "" if edges is None else f" of {edges:,} between reachable vertices"
    return [
        ("vertices", f"{quality['vertices']:,}, edges {quality['edges']:,}"),
        ("resolved", f"{quality['resolved_vertices']:,} ({of_reachable})"),
        ("coverage", share("coverage")),
        ("connected edges", f"{quality['connected_edges']:,}{of_edges}"),
        ("connectivity", share("connectivity")),
        ("connectivity, resolved edges only", share("connectivity_resolved")),
        ("connected parts", _parts(parts)),
        ("smoothness", number("smoothness", "rad/m")),
        (
            "  median, 99 %, largest",
            ", ".join(number(f"smoothness_{which}", "").strip() for which in ("median", "p99", "max")),
        ),
        ("edges steeper than 10 × median", str(quality["steep_edges"])),
        *(_cells_row(name, quality) for name in ("triangles", "squares") if quality[name]),
        ("largest position error", number("max_position_error", "m", ".1e")),
        ("largest rotation error", number("max_rotation_error", "rad", ".1e")),
        (
            "smallest self-collision distance",
            number("min_self_collision_distance", "m", ".4f").replace("none", NOT_CHECKED),
        ),
        ("self-collisions", "not checked" if quality["self_collisions"] is None else str(quality["self_collisions"])),
        ("joint limit violations", str(quality["joint_limit_violations"])),
    ]
