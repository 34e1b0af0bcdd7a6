"""`grr-torch bench effort`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import SLOPES, FiguresFile, share, show_machine, slopes_cell, write_figures
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.effort import Best


@reports_errors
def effort(
    draws: Annotated[int, typer.Option(min=1, help="How often seeds are found, each time anew.")] = 60,
    robot: Annotated[list[str] | None, typer.Option(help="planar_5 or kinova; repeatable; both by default.")] = None,
    task: Annotated[
        list[str] | None, typer.Option(help="position or fixed-rotation; repeatable; both by default.")
    ] = None,
    max_slope: Annotated[
        float | None, typer.Option(help="Leave out steeper edges, in rad/m; by default those that `build` does.")
    ] = None,
    json_file: FiguresFile = None,
) -> None:
    """Print the best refined roadmaps of many draws of found seeds, as a table.

    A roadmap is left out if another one of its problem is as good in vertices, edges, smoothness and certified
    triangles, and better in one of them. Takes some minutes a problem.

    Example: grr-torch bench effort --robot kinova --task position --draws 20
    """
    from grr_torch.experiments.effort import measure_effort
    from grr_torch.output import check_outputs

    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        results = measure_effort(draws, robots=robot, tasks=task, max_slope=max_slope, progress=progress)
    told = "inf" if max_slope == float("inf") else max_slope
    write_figures(json_file, {"draws": draws, "max_slope": told, "roadmaps": [result.to_dict() for result in results]})
    show_machine()
    head = ["problem", "seeds", "resolved", "connected", "smoothness", SLOPES, "certified triangles", "time [s]"]
    show_table(head, [_row(result) for result in results])


def _row(result: Best) -> list[str]:
    quality = result.quality
    return [
        f"{result.robot} {result.task}",
        "preset" if result.seed is None else f"auto, --seed {result.seed}",
        f"{quality.resolved_vertices:,}",
        f"{quality.connected_edges:,}",
        "none" if quality.smoothness is None else f"{quality.smoothness:.4f}",
        slopes_cell(quality),
        share(quality.triangles_certified),
        f"{result.seconds:.2f}",
    ]
