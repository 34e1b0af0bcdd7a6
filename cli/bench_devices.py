"""`grr-torch bench devices`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import FiguresFile, show_machine, write_figures
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.devices import Result


@reports_errors
def devices(
    device: Annotated[
        list[str] | None,
        typer.Option(help="cpu, cuda, cuda:0, …; repeatable; by default cpu, and cuda if there is one."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="roadmaps, solve, export, train or large; repeatable; all by default.")
    ] = None,
    solves: Annotated[int, typer.Option(min=1, help="Points to solve.")] = 1_000_000,
    samples: Annotated[int, typer.Option(min=1, help="Rows to export, and to train from.")] = 100_000,
    epochs: Annotated[int, typer.Option(min=1, help="Epochs to train.")] = 3,
    repeats: Annotated[int, typer.Option(min=1, help="Roadmaps and solving: medians of so many.")] = 3,
    json_file: FiguresFile = None,
) -> None:
    """Print how long the same work takes on several devices, and what comes out, as a table.

    The large build has a million vertices and takes minutes.

    Example: grr-torch bench devices --only roadmaps --only solve
    """
    import torch

    from grr_torch.experiments.devices import measure_devices
    from grr_torch.output import check_outputs

    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        results = measure_devices(
            device or (("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)),
            work=only,
            solves=solves,
            samples=samples,
            epochs=epochs,
            repeats=repeats,
            progress=progress,
        )
    write_figures(json_file, {"work": [result.to_dict() for result in results]})
    show_machine()
    show_table(["work", "device", "time [s]", "what comes out"], [_row(result) for result in results])


def _row(result: Result) -> list[str]:
    outcome = ", ".join(f"{name} {value:,.6g}" for name, value in result.outcome.items())
    return [result.work, result.device, f"{result.seconds:.3g}", outcome]
