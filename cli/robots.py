"""`grr-torch robots`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer
from grr_torch.cli.show import print_json, reports_errors


@reports_errors
def robots(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the bundled robots and their tasks.

    Example: grr-torch robots
    """
    from grr_torch.robots.presets import load_preset, robot_names

    presets = {name: load_preset(name) for name in robot_names()}
    if as_json:
        data: dict[str, Any] = {}
        for name, preset in presets.items():
            data[name] = {**asdict(preset), "urdf": str(preset.urdf)}
            data[name]["spheres"] = None if preset.spheres is None else str(preset.spheres)
        print_json(data)
        return
    for name, preset in presets.items():
        typer.secho(name, bold=True)
        typer.echo(f"  {preset.description}")
        typer.echo(f"  tool {preset.tool}, base {preset.base}")
        for kind, problem in preset.problems.items():
            bounds = " × ".join(f"[{low:g}, {high:g}]" for low, high in problem.bounds)
            turns = f" × {problem.rotations} rotations" if problem.rotations else ""
            default = " (default)" if kind == preset.default_task else ""
            typer.echo(f"  {kind}{default}: {problem.points:,} points{turns} in {bounds} m, {len(problem.seeds)} seeds")
