"""`grr-torch catalogue`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from grr_torch.cli.show import print_json, reports_errors, show_table

_FIGURES = ("coverage", "connectivity", "smoothness", "smoothness_p99", "smoothness_max", "steep_edges", "seconds")
_SHOWN = ("hash", "robot", "task", "orientation", "status", *_FIGURES)


@reports_errors
def catalogue(
    folder: Annotated[Path, typer.Argument(help="Folder of a sweep.", metavar="DIR")],
    best: Annotated[
        str | None, typer.Option(help="Only the best by this figure: smoothness, coverage, seconds, …")
    ] = None,
    per: Annotated[
        list[str] | None, typer.Option(help="… of each value of this column: orientation, robot, task, …; repeatable.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Show the roadmaps of a fleet, their quality and cost, and bring DIR/catalogue.parquet up to date.

    Example: grr-torch catalogue factory --best smoothness --per orientation
    """
    from grr_torch.errors import ParameterError
    from grr_torch.fleet.catalogue import best as best_rows
    from grr_torch.fleet.catalogue import read_catalogue, write_catalogue

    if per and best is None:
        raise ParameterError("--per", ", ".join(per), "none without --best")
    every = read_catalogue(folder)
    rows = every if best is None else best_rows(every, best, per or [])
    if not every:
        raise ParameterError("DIR", folder, "a folder of `grr-torch sweep`, with roadmaps of it or failures")
    write_catalogue(folder)
    if as_json:
        print_json({"roadmaps": rows})
        return
    shown = list(dict.fromkeys([*_SHOWN, *([best] if best else []), *(per or [])]))
    if rows:
        show_table(shown, [[_cell(row.get(name)) for name in shown] for row in rows])
    for row in rows:
        if row["error"] is not None:
            typer.secho(f"failed {row['hash']}: {row['error']}", err=True, fg=typer.colors.RED)
    typer.echo(f"{len(rows)} rows; all columns are in {folder / 'catalogue.parquet'}")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
