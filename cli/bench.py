"""`grr-torch bench`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.bench_bound import bound
from grr_torch.cli.bench_cluster import cluster
from grr_torch.cli.bench_devices import devices
from grr_torch.cli.bench_effort import effort
from grr_torch.cli.bench_learning import learning
from grr_torch.cli.bench_rotations import rotations
from grr_torch.cli.bench_scale import scale
from grr_torch.cli.bench_teleop import teleop
from grr_torch.cli.figures import SLOPES, FiguresFile, share, show_machine, slopes_cell, write_figures
from grr_torch.cli.options import check_unused
from grr_torch.cli.show import progress_bar, reports_errors, show_table

if TYPE_CHECKING:
    from grr_torch.experiments.roadmaps import Result
    from grr_torch.experiments.speed import Row, SpeedTable
    from grr_torch.robots.robot import Robot

app = typer.Typer(name="bench", help="Measure: the tables of the README.", no_args_is_help=True)


app.command()(effort)
app.command()(bound)
app.command()(teleop)
app.command()(learning)
app.command()(rotations)
app.command()(scale)
app.command()(cluster)
app.command()(devices)


@app.callback()
def _bench() -> None:
    pass


@app.command()
@reports_errors
def speed(
    only: Annotated[
        list[str] | None,
        typer.Option(help="kinematics, projection, self-collision, build, process, growth or use; repeatable."),
    ] = None,
    peers: Annotated[
        str | None, typer.Option(help="Of pytorch-kinematics,Pinocchio,Klampt; by default those that are installed.")
    ] = None,
    repeats: Annotated[int | None, typer.Option(help="Medians are taken over so many; 7 by default.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="For torch; by default what torch takes.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    profile: Annotated[
        bool,
        typer.Option("--profile", help="Where the time of builds and of the projection goes, instead of the table."),
    ] = False,
    json_file: FiguresFile = None,
) -> None:
    """Print how fast everything is beside other libraries, as a table.

    Example: grr-torch bench speed --only kinematics --only projection

    Example: grr-torch bench speed --profile
    """
    import torch

    from grr_torch.experiments.speed import measure_speed
    from grr_torch.output import check_outputs

    if profile:
        check_unused({"--only": only, "--peers": peers, "--repeats": repeats, "--json": json_file}, "--profile")
    if threads is not None:
        torch.set_num_threads(threads)
    if profile:
        _show_profile(device)
        return
    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        table = measure_speed(
            sections=only,
            peers=None if peers is None else [name.strip() for name in peers.split(",") if name.strip()],
            repeats=7 if repeats is None else repeats,
            device=device,
            progress=progress,
        )
    write_figures(json_file, table.to_dict())
    _show_speed(table)


@app.command()
@reports_errors
def roadmap(
    robot: Annotated[list[str] | None, typer.Option(help="planar_5 or kinova; repeatable; both by default.")] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="random, preset or auto (seeds); repeatable; all by default.")
    ] = None,
    reachability: Annotated[int, typer.Option(min=1, help="Random starts a vertex: which are reachable?")] = 40,
    samples: Annotated[int, typer.Option(min=1, help="Random configurations a vertex, for random.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    repeats: Annotated[int, typer.Option(min=1, help="Times are medians of so many; random is built once.")] = 3,
    json_file: FiguresFile = None,
) -> None:
    """Print the quality of the paper's four problems by every method, as a table.

    The method random takes minutes a problem.

    Example: grr-torch bench roadmap --method preset --method auto
    """
    from grr_torch.experiments.roadmaps import measure_roadmaps
    from grr_torch.output import check_outputs

    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        results = measure_roadmaps(
            robots=robot,
            methods=method,
            reachability=reachability,
            samples=samples,
            seed=seed,
            repeats=repeats,
            progress=progress,
        )
    write_figures(json_file, {"roadmaps": [result.to_dict() for result in results]})
    show_machine()
    head = ["problem", "method", "resolved / reachable", "connected / edges", "smoothness", SLOPES]
    head += ["certified triangles", "squares", "time [s]", "the paper: connectivity, smoothness, time"]
    show_table(head, [_roadmap_row(result) for result in results])


@app.command()
@reports_errors
def trade(
    robot: Annotated[str, typer.Option(help="A bundled robot.")] = "kinova",
    task: Annotated[str | None, typer.Option(help="position or fixed-rotation; the preset's default.")] = None,
    objective: Annotated[
        list[str] | None, typer.Option(help="clearance, manipulability or limits; repeatable; by default all.")
    ] = None,
    weight: Annotated[list[float] | None, typer.Option(help="Repeatable; by default 0.1, 0.3, 1 and 3.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    json_file: FiguresFile = None,
) -> None:
    """Print what secondary objectives cost in smoothness, as a table.

    Example: grr-torch bench trade --robot kinova --objective clearance --weight 0.3 --weight 1
    """
    from grr_torch.experiments.trade import WEIGHTS, measure_trade
    from grr_torch.output import check_outputs

    check_outputs({"--json": json_file})
    with progress_bar() as progress:
        trades = measure_trade(
            robot, task, objectives=objective, weights=weight or WEIGHTS, seed=seed, progress=progress
        )
    write_figures(json_file, {"trades": [row.to_dict() for row in trades]})
    names = list(trades[0].values)
    head = ["objective", "weight", "smoothness", SLOPES, "connected", "certified"]
    head += [f"{name}: mean, worst" for name in names]
    rows = [
        [
            row.objective or "none",
            f"{row.weight:g}",
            _number(row.quality.smoothness, 3),
            slopes_cell(row.quality),
            f"{row.quality.connected_edges:,}",
            share(row.quality.triangles_certified),
            *(f"{row.values[name]['mean']:.4g}, {row.values[name]['worst']:.3g}" for name in names),
        ]
        for row in trades
    ]
    show_table(head, rows)


def _roadmap_row(result: Result) -> list[str]:
    quality, paper = result.quality, result.paper
    return [
        f"{result.robot} {result.task}",
        f"{result.method}{', refined' if result.refined else ''}",
        f"{quality.resolved_vertices:,} / {quality.reachable_vertices:,}",
        f"{quality.connected_edges:,} / {quality.reachable_edges:,} ({share(quality.connectivity)})",
        _number(quality.smoothness, 3),
        slopes_cell(quality),
        share(quality.triangles_certified),
        share(quality.squares_certified),
        f"{result.seconds:.2f}",
        "" if paper is None else f"{paper[0]} %, {paper[1]}, {60.0 * paper[2]:.0f} s",
    ]


def _number(value: float | None, digits: int) -> str:
    return "none" if value is None else f"{value:.{digits}f}"


def _show_speed(table: SpeedTable) -> None:
    versions = {**table.machine, **table.peers}
    typer.echo(", ".join(f"{name} {value}" for name, value in versions.items()) + "\n")
    rows = [[row.what, _figure(row.ours), row.unit, _beside(row), _more(row)] for row in table.rows]
    show_table(["what", "grr-torch", "unit", "beside it", "more"], rows)


def _beside(row: Row) -> str:
    ratios = row.ratios()
    return ", ".join(f"{name} {_figure(value)} ({_figure(ratios[name])}×)" for name, value in row.peers.items())


def _more(row: Row) -> str:
    return ", ".join(f"{name} {_figure(value)}" for name, value in row.more.items())


def _figure(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _show_profile(device: str) -> None:
    from grr_torch.experiments.profile import profile_build
    from grr_torch.experiments.speed import GROWTH
    from grr_torch.robots.load import load_robot

    kinova = load_robot("kinova", device=device)
    builds, growth = {}, {}
    for name in ("planar_5", "kinova"):
        robot = kinova if name == "kinova" else load_robot(name, device=device)
        for task in ("position", "fixed-rotation"):
            stages, _ = profile_build(robot, task)
            builds[f"{name} {task}"] = {stage.name: 1e3 * stage.seconds for stage in stages}
    for points in GROWTH:
        stages, vertices = profile_build(kinova, "position", points)
        growth[f"{vertices:,} vertices"] = {stage.name: 1e6 * stage.seconds / vertices for stage in stages}
    _show_stages("build, own time, ms", builds)
    _show_stages("build, kinova position, µs a vertex", growth)
    if kinova.device.type == "cpu":
        _show_projection_cost(kinova)


def _show_stages(what: str, columns: dict[str, dict[str, float]]) -> None:
    values = list(columns.values())
    rows = [[stage, *(f"{column[stage]:.2f}" for column in values)] for stage in values[0]]
    rows.append(["sum", *(f"{sum(column.values()):.2f}" for column in values)])
    show_table([what, *columns], rows)
    typer.echo()


def _show_projection_cost(robot: Robot) -> None:
    from grr_torch.experiments.projection_cost import projection_cost

    cost = projection_cost(robot)
    head = ["projection of 10,000 poses from ±0.3 rad", "times a pose", "calls", "µs each", "µs a pose"]
    head += ["of it cost of torch calls", "operators a call", "operations each in products", "in others"]
    rows = [
        [
            part.name,
            f"{part.columns:.2f}",
            f"{part.calls:.0f}",
            f"{1e6 * part.seconds / part.columns:.3f}" if part.columns else "",
            f"{1e6 * part.seconds:.3f}",
            *(
                (f"{1e6 * part.waiting:.3f}", f"{part.operators}", f"{part.products:.0f}", f"{part.pointwise:.0f}")
                if part.operators
                else [""] * 4
            ),
        ]
        for part in cost.parts
    ]
    show_table(head, rows)
    for what, seconds in {
        "all of it, CPU time on one thread": cost.seconds,
        "the first four rows, if a torch call cost nothing": cost.without_calls(),
        f"the floor: their operations at the {cost.product_rate / 1e9:.1f} GFLOP/s of torch.mm and the "
        f"{cost.pointwise_rate / 1e9:.1f} of torch.addcmul on operands in the cache, and {1e6 * cost.functions:.2f} µs "
        f"of sines and cosines": cost.floor(),
    }.items():
        typer.echo(f"\n{1e6 * seconds:.2f} µs a pose, {1.0 / seconds:,.0f} poses / s: {what}")
