"""`grr-torch bench scale`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import FiguresFile, show_machine, write_figures
from grr_torch.cli.options import check_ending
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.scale import Size

_COLUMNS = {
    "edges": ("edges", "{:,.0f}"),
    "resolved": ("resolved", "{:,.0f}"),
    "seconds": ("build [s]", "{:.3g}"),
    "cell_seconds": ("cells [s]", "{:.3g}"),
    "cpu_seconds": ("CPU [s]", "{:.3g}"),
    "peak_mib": ("peak [MiB]", "{:,.0f}"),
    "save_seconds": ("write [s]", "{:.3g}"),
    "file_mib": ("file [MiB]", "{:,.1f}"),
    "load_seconds": ("load [s]", "{:.3f}"),
    "first_seconds": ("first point [s]", "{:.3f}"),
    "next_seconds": ("one more [s]", "{:.4f}"),
    "process_seconds": ("solve, process − torch [s]", "{:.2f}"),
}


@reports_errors
def scale(
    robot: Annotated[str, typer.Option(help="A bundled robot.")] = "kinova",
    task: Annotated[str | None, typer.Option(help="A task of its preset; the default one by default.")] = None,
    points: Annotated[
        list[int] | None,
        typer.Option(
            help="Vertices asked for, or where rotation varies positions, each in as many rotations as the preset has; "
            "repeatable; 1000, 10000, 100000, 1000000 by default."
        ),
    ] = None,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="Whether roadmaps are refined.")] = True,
    repeats: Annotated[int, typer.Option(min=1, help="Opening and solving: medians over so many processes.")] = 3,
    plot: Annotated[Path | None, typer.Option(help="Draw all figures into this PNG file.", metavar="FILE.png")] = None,
    json_file: FiguresFile = None,
) -> None:
    """Print how time, memory, file size and opening grow with the vertices, as a table.

    CPU is the processor time of the build, in all its processes; peak is the memory of the first of them. The last
    line has exponents, fitted to sizes above 10,000: 1 is a straight line. A million refined vertices take minutes.

    Example: grr-torch bench scale --points 1000 --points 10000 --points 100000 --plot scale.png
    """
    from grr_torch.experiments.scale import SIZES, exponents, measure_scale
    from grr_torch.experiments.scale import plot as draw
    from grr_torch.output import atomic_write, check_outputs

    check_outputs({"--plot": plot, "--json": json_file})
    check_ending("--plot", plot, ".png")
    with progress_bar() as progress:
        rows = measure_scale(robot, task, sizes=points or SIZES, refine=refine, repeats=repeats, progress=progress)
    powers = exponents(rows)
    # both files appear together, or neither does
    with ExitStack() as stack:
        if plot is not None:
            draw(rows, stack.enter_context(atomic_write(plot)))
        write_figures(json_file, {"sizes": [row.__dict__ for row in rows], "exponents": powers})
    show_machine()
    lines = [_line(row) for row in rows]
    if powers:
        lines.append(["exponent", *(f"{powers[name]:.2f}" for name in _COLUMNS)])
    show_table(["vertices", *(head for head, _ in _COLUMNS.values())], lines)


def _line(row: Size) -> list[str]:
    return [f"{row.vertices:,}", *(shape.format(getattr(row, name)) for name, (_, shape) in _COLUMNS.items())]
