"""`grr-torch bench rotations`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import SLOPES, FiguresFile, share, show_machine, slopes_cell, write_figures
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.rotations import Result


@reports_errors
def rotations(
    problem: Annotated[
        list[str] | None,
        typer.Option(help="'planar_5 pose', 'kinova yaw', 'kinova axis' or 'kinova pose'; repeatable; all by default."),
    ] = None,
    points: Annotated[int | None, typer.Option(help="Positions; the presets' by default.")] = None,
    rotations: Annotated[int | None, typer.Option(help="Rotations at each; the presets' by default.")] = None,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="Refine the roadmaps.")] = True,
    reachability: Annotated[int, typer.Option(min=1, help="Random starts a vertex: which are reachable?")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    json_file: FiguresFile = None,
) -> None:
    """Print the quality and the cost of roadmaps in which rotation varies, as a table.

    Of the cells of each, a random 20,000 triangles and 20,000 squares stand for all. Takes some minutes.

    Example: grr-torch bench rotations --problem "planar_5 pose"
    """
    from grr_torch.experiments.rotations import measure_rotations
    from grr_torch.output import check_outputs

    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        results = measure_rotations(
            problem,
            points=points,
            rotations=rotations,
            refine=refine,
            reachability=reachability,
            seed=seed,
            progress=progress,
        )
    write_figures(json_file, {"roadmaps": [result.to_dict() for result in results]})
    show_machine()
    head = [
        "problem",
        "positions × rotations",
        "resolved / reachable",
        "connected / edges",
        "smoothness [rad/m]",
        SLOPES,
    ]
    head += ["certified triangles", "certified squares", "time [s]", "peak memory [MiB]"]
    show_table(head, [_row(result) for result in results])


def _row(result: Result) -> list[str]:
    quality = result.quality
    return [
        f"{result.problem}{', refined' if result.refined else ''}",
        f"{result.positions:,} × {result.rotations:,}",
        f"{quality.resolved_vertices:,} / {quality.reachable_vertices:,} ({share(quality.coverage)})",
        f"{quality.connected_edges:,} / {quality.reachable_edges:,} ({share(quality.connectivity)})",
        "none" if quality.smoothness is None else f"{quality.smoothness:.2f}",
        slopes_cell(quality),
        share(quality.triangles_certified),
        share(quality.squares_certified),
        f"{result.seconds:.1f}",
        f"{result.memory:,.0f}",
    ]
