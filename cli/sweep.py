"""`grr-torch sweep`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.show import ENGINES, progress_bar, reports_errors


@reports_errors
def sweep(
    file: Annotated[Path, typer.Argument(help="The sweep, in YAML.", metavar="SWEEP.yaml")],
    engine: Annotated[
        str, typer.Option(help="local: one after another, here; ray: as tasks of a Ray cluster.")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            help="host:port of a Ray cluster, or auto: the one that runs here; by default one is started here.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the roadmaps; by default named like the sweep. A cluster must share it."),
    ] = None,
) -> None:
    r"""Build the roadmaps of a fleet that are missing, and the catalogue of them all; exit code 1 if some fail.

    Example: grr-torch sweep factory.yaml --engine ray --out factory

    where factory.yaml says, for instance,

    defaults: {robot: planar_5, points: 300}

    grid: {task: \[position, fixed-rotation], seed: [0, 1, 2]}

    builds: [{robot: kinova, objectives: {clearance: 0.5}}]

    needs: {cpus: 1, memory: 2}

    Names are those of grr_torch.build's and load_robot's arguments; needs are cores, GiB and gpus a build.
    """
    from grr_torch.errors import ParameterError, UnknownNameError

    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if address is not None and engine != "ray":
        raise ParameterError("--address", address, "none without --engine ray")
    from grr_torch.fleet.order import Order
    from grr_torch.fleet.ray_engine import RayEngine
    from grr_torch.fleet.run import Engine, LocalEngine, run_sweep
    from grr_torch.fleet.sweep import read_sweep

    orders = read_sweep(file)
    folder = out or file.with_suffix("")
    if folder.exists() and not folder.is_dir():
        raise ParameterError("--out", folder, "a folder")
    built: list[Order] = []

    def told(order: Order, error: str | None) -> None:
        if error is None:
            built.append(order)
            typer.echo(f"built {order.label}")
        else:
            typer.secho(f"failed {order.label}: {error}", err=True, fg=typer.colors.RED)

    chosen: Engine = RayEngine(address) if engine == "ray" else LocalEngine()
    try:
        with progress_bar() as progress:
            rows = run_sweep(orders, folder, chosen, told=told, progress=progress)
    except KeyboardInterrupt as error:
        typer.echo(f"interrupted: {len(built)} built; the same command goes on from there", err=True)
        raise typer.Exit(130) from error
    failed = sum(row["status"] == "failed" for row in rows)
    typer.echo(f"{folder}: {len(rows) - failed} of {len(orders)} roadmaps, {len(built)} of them built now")
    if failed:
        typer.secho(f"{failed} failed; the next run tries them again", err=True, fg=typer.colors.RED)
        raise typer.Exit(1)
