"""`grr-torch info`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from grr_torch.cli.show import bounds_row, print_json, print_rows, progress_bar, quality_rows, reports_errors

if TYPE_CHECKING:
    from torch import Tensor

    from grr_torch.resolution.roadmap import Roadmap


# steep edges that are listed
_LISTED = 20


@reports_errors
def info(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    verify: Annotated[
        bool, typer.Option("--verify", help="Recompute everything and hold it against what is stored.")
    ] = False,
    max_slope: Annotated[
        float | None,
        typer.Option(
            help="List connected edges whose D_q / D_p is above this, in rad/m; by default ten times the median."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Show what a roadmap file holds; exit code 2 if it is not consistent with itself.

    Example: grr-torch info kinova.grr --verify
    """
    from grr_torch.applications.routes import part_sizes
    from grr_torch.errors import ParameterError
    from grr_torch.resolution.quality import Quality
    from grr_torch.resolution.report import summary, traded
    from grr_torch.resolution.roadmap_file import load_roadmap, read_file
    from grr_torch.resolution.slopes import left_out_edges, slope_bound, steep_edges
    from grr_torch.resolution.verify import verify_file

    if max_slope is not None and not max_slope > 0.0:
        raise ParameterError("--max-slope", max_slope, "above 0, in rad/m")
    metadata = read_file(file)[0]
    roadmap = load_roadmap(file)
    quality: dict[str, Any] = metadata["quality"]
    parts = part_sizes(roadmap)
    checks = []
    if verify:
        with progress_bar() as progress:
            checks = verify_file(file, progress=progress)
    steep, left_out = steep_edges(roadmap, max_slope), left_out_edges(roadmap)
    passed = all(check.passed for check in checks)
    robot = roadmap.robot
    if as_json:
        seeds = roadmap.parameters.get("seeds", ())
        data = {
            **quality,
            "parts": parts,
            "build_seconds": roadmap.build_seconds,
            "robot": robot.name,
            "tool": robot.tool,
            "base": robot.base,
            "task": metadata["task"],
            "parameters": {**roadmap.parameters, "seeds": seeds if isinstance(seeds, str) else len(seeds)},
            "format_version": metadata["format_version"],
            "package_version": metadata.get("package_version"),
        }
        data["steep"], data["left_out"] = (roadmap.edges[edges].tolist() for edges in (steep, left_out))
        if verify:
            data["verified"] = passed
            data["checks"] = {check.name: {"passed": check.passed, "detail": check.detail} for check in checks}
        print_json(data)
    else:
        rotation = metadata["task"].get("rotation")
        spheres = robot.spheres
        rows = [
            ("robot", f"{robot.name}, {robot.n} joints, {robot.base} → {robot.tool}"),
            ("task", roadmap.task.name + ("" if rotation is None else f", roll pitch yaw {rotation} rad")),
            *_turning(roadmap),
            (
                "self-collision model",
                f"{sum(map(len, spheres.spheres.values()))} spheres, {len(spheres.checked)} pairs of links, "
                f"margin {1e3 * robot.margin:g} mm"
                if spheres
                else "none",
            ),
            bounds_row(roadmap),
            *quality_rows(quality, parts),
            ("built in", f"{roadmap.build_seconds:.2f} s by grr-torch {metadata.get('package_version')}"),
        ]
        figures = Quality(**{field.name: quality[field.name] for field in fields(Quality)})
        change = summary(roadmap, figures)
        rows += [*([("refined", change)] if change else []), *traded(roadmap, figures).items()]
        print_rows(f"{file}: {robot.name}, {roadmap.task.kind}", rows)
        if len(steep):
            print_rows(f"{len(steep):,} steep edges, the steepest first", _steep_rows(roadmap, steep))
        if len(left_out):
            limit = slope_bound(roadmap)
            title = f"{len(left_out):,} edges left out, steeper than {limit:g} rad/m, the steepest first"
            print_rows(title, _steep_rows(roadmap, left_out))
        if checks:
            results = [(f"{'✓' if check.passed else '✗'} {check.name}", check.detail) for check in checks]
            print_rows("verified" if passed else "NOT verified", results)
    if not passed:
        failed = ", ".join(check.name for check in checks if not check.passed)
        typer.secho(f"error: {file} is not consistent with itself: {failed}", err=True, fg=typer.colors.RED)
        raise typer.Exit(2)


def _turning(roadmap: Roadmap) -> list[tuple[str, str]]:
    """What the grid of rotations is, where rotation varies."""
    from grr_torch.spaces.product import ProductGraph

    graph = roadmap.graph
    if not isinstance(graph, ProductGraph):
        return []
    d = roadmap.task.dimension
    places, turns = len(graph.positions.points), len(graph.rotations.values)
    return [("grid", f"{places:,} positions × {turns:,} rotations ({', '.join(roadmap.task.coordinates[d:])})")]


def _steep_rows(roadmap: Roadmap, edges: Tensor) -> list[tuple[str, str]]:
    from grr_torch.resolution.slopes import edge_slopes

    def place(vertex: int) -> str:
        return "(" + ", ".join(f"{value:.3f}" for value in roadmap.points[vertex].tolist()) + ")"

    listed = edges[:_LISTED]
    rows = [
        (f"{a} – {b}", f"{slope:.1f} rad/m between {place(a)} and {place(b)} m")
        for (a, b), slope in zip(roadmap.edges[listed].tolist(), edge_slopes(roadmap, listed).tolist(), strict=True)
    ]
    if len(edges) > len(listed):
        rows.append(("…", f"and {len(edges) - len(listed):,} more; --json lists all"))
    return rows
