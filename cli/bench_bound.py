"""`grr-torch bench bound`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import FiguresFile, show_machine, write_figures
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.bound import Bound


@reports_errors
def bound(
    file: Annotated[Path, typer.Argument(help="A roadmap (.grr) whose task leaves one or two degrees of freedom.")],
    samples: Annotated[int, typer.Option(min=2, help="Of each vertex's self-motion manifold.")] = 300,
    iterations: Annotated[int, typer.Option(min=1, help="Of message passing, at most.")] = 60,
    leave_out: Annotated[
        list[int] | None, typer.Option(min=0, help="How many edges a map may leave out; repeatable; 0 by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random starts.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    json_file: FiguresFile = None,
) -> None:
    """Print how much smoother than a roadmap another could be, as a table.

    Self-motion manifolds are sampled, and message passing over all edges gives a bound that no choice among the
    samples is below. Maps between the samples may be smoother, the less the closer these lie. Takes some minutes,
    and 4 bytes for each edge and pair of samples.

    Example: grr-torch bench bound kinova.grr --samples 400 --leave-out 0 --leave-out 10
    """
    from grr_torch.experiments.bound import measure_bound
    from grr_torch.output import check_outputs
    from grr_torch.resolution.roadmap import Roadmap

    check_outputs({"--json": json_file}, [file])
    roadmap = Roadmap.load(file, device=device)
    with progress_bar() as progress:
        numbers = list(dict.fromkeys(leave_out or [0]))
        results = measure_bound(
            roadmap, samples=samples, iterations=iterations, left_out=numbers, seed=seed, progress=progress
        )
    write_figures(json_file, {"file": str(file), "bounds": [result.to_dict() for result in results]})
    show_machine()
    head = ["problem", "edges", "samples, spacing [rad]", "this roadmap", "smoothest found", "bound", "time [s]"]
    show_table(head, [_row(result) for result in results])


def _row(result: Bound) -> list[str]:
    of = f"{result.edges - result.left_out:,} of {result.edges:,}" if result.left_out else f"all {result.edges:,}"
    median, largest = result.spacing
    return [
        f"{result.robot} {result.task}",
        of,
        f"{result.samples:,}, {median:.2f} to {largest:.2f}",
        f"{result.smoothness:.4f}",
        f"{result.best:.4f}",
        f"{result.bound:.4f}",
        f"{result.seconds:.0f}",
    ]
