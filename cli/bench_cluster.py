"""`grr-torch bench cluster`."""

from __future__ import annotations

from typing import Annotated

import typer
from grr_torch.cli.figures import show_machine
from grr_torch.cli.show import progress_bar, reports_errors, show_table


@reports_errors
def cluster(
    robot: Annotated[str, typer.Option(help="A bundled robot.")] = "kinova",
    task: Annotated[str | None, typer.Option(help="The kind of a task; the preset's default.")] = None,
    points: Annotated[int | None, typer.Option(help="Vertices that are asked for; the preset's.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="The most workers of a cluster on this machine.")] = 2,
    repeats: Annotated[int, typer.Option(min=1, help="The fastest of so many counts.")] = 3,
) -> None:
    """Print what a build costs by vertex and edge, and how fast Ray's workers check its edges, as tables.

    Example: grr-torch bench cluster --robot planar_5 --task position --points 2000
    """
    from grr_torch.experiments.cluster import measure_cluster

    with progress_bar() as progress:
        cost = measure_cluster(robot, task, points, workers=workers, repeats=repeats, progress=progress)
    show_machine()
    edge, vertex = 1e6 / max(1, cost.checked), 1e6 / cost.vertices
    rows = [
        ["memory of a vertex", f"{cost.bytes_vertex:.0f} bytes"],
        ["memory of an edge", f"{cost.bytes_edge:.0f} bytes"],
        ["edges a vertex", f"{cost.edges / cost.vertices:.1f}"],
        ["expansion, a vertex", f"{vertex * cost.expansion_seconds:.1f} µs"],
        ["refinement, a vertex", f"{vertex * cost.refinement_seconds:.1f} µs"],
        ["continuity, a checked edge", f"{edge * cost.check_seconds:.1f} µs"],
    ]
    show_table([f"{cost.vertices:,} vertices, {cost.edges:,} edges", "cost"], rows)
    typer.echo()
    rows = [["this process, one thread", f"{cost.check_seconds:.3f}", "", ""]]
    for count, seconds in cost.cluster_seconds.items():
        faster = f"{cost.check_seconds / seconds:.2f}×"
        rows.append(
            [f"Ray, {count} worker{'s' * (count > 1)}", f"{seconds:.3f}", faster, f"{cost.start_seconds[count]:.1f}"]
        )
    show_table([f"continuity of {cost.checked:,} edges", "s", "speed-up", "start [s]"], rows)
