"""`grr-torch build`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from grr_torch.cli.arm import (
    AllowMissingMeshes,
    Axis,
    Base,
    Held,
    Margin,
    PackageDirs,
    Rotation,
    Spheres,
    TaskKind,
    Tool,
    load_arm,
    read_turning,
)
from grr_torch.cli.options import check_ending, check_unused, named_numbers, some_numbers
from grr_torch.cli.show import (
    ENGINES,
    bounds_of,
    bounds_row,
    print_json,
    print_rows,
    progress_bar,
    quality_rows,
    reports_errors,
)

from grr_torch.errors import ParameterError, UnknownNameError

if TYPE_CHECKING:
    from grr_torch.resolution.quality import Quality
    from grr_torch.resolution.roadmap import Roadmap


@reports_errors
def build(
    robot: Annotated[str, typer.Option(help="A bundled robot (grr-torch robots) or the path of a URDF.")],
    task: TaskKind = None,
    points: Annotated[
        int | None,
        typer.Option(
            help="Vertices that the staggered grid is asked for; without a preset 1,000 in the plane, else 3,000."
        ),
    ] = None,
    rotations: Annotated[
        int | None,
        typer.Option(help="Rotations of the grid, where rotation varies: yaws, directions or orientations."),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            help="preset, auto (found), or a .csv, .txt or .npy FILE, one seed a row; preset if there is one."
        ),
    ] = None,
    candidates: Annotated[
        int | None, typer.Option(help="Sets of seeds that are compared where seeds are found; more may do better.")
    ] = None,
    method: Annotated[str, typer.Option(help="expansion, or random: the baseline, in minutes.")] = "expansion",
    samples: Annotated[
        int | None, typer.Option(help="Random configurations of a vertex, for --method random; 100 by default.")
    ] = None,
    nearest: Annotated[
        int | None,
        typer.Option(
            help="How many of the nearest ones at a neighbouring vertex are tested for each; 6 in the plane, else 2."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Roadmap file; by default ROBOT.grr. Replaced if it exists.")] = None,
    record: Annotated[Path | None, typer.Option(help="Recording; by default beside the roadmap, .rrd.")] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write no recording.")] = False,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Repair, relax and certify the roadmap after the expansion.")
    ] = True,
    objective: Annotated[
        list[str] | None,
        typer.Option(
            help="clearance, manipulability or limits: what refinement serves besides smoothness; repeatable. "
            "At weight 1, 1 % of its mean is worth 1 % of smoothness; at 0 it is only reported.",
            metavar="NAME=WEIGHT",
        ),
    ] = None,
    max_slope: Annotated[
        float | None,
        typer.Option(
            help="Leave out edges whose D_q / D_p is above this, in rad/m, and have info list them; inf: none. "
            "By default that of the preset's grid, which refinement may raise, if it has one; otherwise inf."
        ),
    ] = None,
    reachability: Annotated[
        int, typer.Option(help="Random starts per unresolved vertex, to tell which are reachable; 0: not measured.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    neighbours: Annotated[
        int | None,
        typer.Option(
            help="Nearest vertices averaged over; 24 or 64. Where rotation varies, those so many edges away; 2."
        ),
    ] = None,
    tool: Tool = None,
    base: Base = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            help="Bounds of the grid, in metres; without a preset, what holds all that the arm reaches.",
            metavar="X0 X1 Y0 Y1 [Z0 Z1]",
        ),
    ] = None,
    rotation: Rotation = None,
    axis: Axis = None,
    package_dir: PackageDirs = None,
    allow_missing_meshes: AllowMissingMeshes = False,
    hold: Held = None,
    spheres: Spheres = None,
    margin: Margin = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="Folder in which it is kept what is done, so that a build that was killed can go on."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from what --checkpoint holds; an absent or empty one starts afresh.")
    ] = False,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    engine: Annotated[
        str, typer.Option(help="local; ray: the continuity checks are spread over the workers of a Ray cluster.")
    ] = "local",
    address: Annotated[
        str | None, typer.Option(help="host:port of a Ray cluster, or auto; by default one is started here.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Build a roadmap, print its quality, and write it with a recording of it.

    Example: grr-torch build --robot kinova --objective clearance=0.5 --objective limits=0.1

    Example: grr-torch build --robot kinova --points 1000000 --no-record --checkpoint kinova_1m --resume

    Example: grr-torch build --robot arm.urdf --tool flange

    Example: grr-torch build --robot arm.urdf --tool flange --points 2000 --bounds -0.8 0.8 -0.8 0.8 0 1.2
    --seeds seeds.csv
    """
    from grr_torch.output import atomic_write, check_outputs
    from grr_torch.resolution.build import build as build_roadmap
    from grr_torch.resolution.problem import complete_task, pose_problem
    from grr_torch.resolution.stages import build_stages

    if no_record:
        check_unused({"--record": record}, "--no-record")
    with progress_bar() as progress, _edge_check(engine, address, device) as check:
        progress("loading the robot", 0, 1)
        arm = load_arm(
            robot,
            tool=tool,
            base=base,
            package_dir=package_dir,
            allow_missing_meshes=allow_missing_meshes,
            hold=hold,
            spheres=spheres,
            margin=margin,
            device=device,
        )
        progress("loading the robot", 1, 1)
        out = out or Path(f"{Path(robot).stem}.grr")
        recording = None if no_record else record or out.parent / f"{out.stem}.rrd"
        check_outputs({"--out": out, "--record": recording}, [None if arm.preset else robot, seeds, spheres])
        check_ending("--out", out, ".grr")
        check_ending("--record", recording, ".rrd")
        box = None if bounds is None else _bounds(bounds)
        axes = None if box is None else len(box)
        space = complete_task(arm, task, axes, **read_turning(rotation, axis))
        problem = pose_problem(arm, space, points, box, _seeds(arm, seeds), rotations)
        weights = named_numbers("--objective", objective or (), "NAME=WEIGHT, a number of 0 or more")
        progress.foretell(
            build_stages(
                problem.task,
                method=method,
                found_seeds=isinstance(problem.seeds, str),
                refine=refine,
                objectives=any(weights.values()),
                reachability=reachability > 0,
            )
        )
        try:
            roadmap = build_roadmap(
                arm,
                problem.task,
                points=problem.graph,
                seeds=None if method == "random" and seeds is None else problem.seeds,
                candidates=candidates,
                method=method,
                samples=samples,
                nearest=nearest,
                neighbours=neighbours,
                refine=refine,
                objectives=weights,
                max_slope=max_slope,
                reachability=reachability,
                seed=seed,
                checkpoint=checkpoint,
                resume=resume,
                check=check,
                progress=progress,
            )
        except KeyboardInterrupt:
            if checkpoint is None:
                raise
            typer.echo(f"interrupted: what is done is in {checkpoint}; --resume goes on from there", err=True)
            raise typer.Exit(130) from None
        figures = roadmap.quality(progress)
        progress("writing", 0, 2)
        # both files appear together, or neither does
        with ExitStack() as stack:
            roadmap.save(stack.enter_context(atomic_write(out)))
            progress("writing", 1, 2)
            if recording is not None:
                from grr_torch.recording.roadmap import record_roadmap

                record_roadmap(roadmap, stack.enter_context(atomic_write(recording)))
        progress("writing", 2, 2)
    _show(roadmap, figures, out, recording, as_json)


def _show(roadmap: Roadmap, figures: Quality, out: Path, recording: Path | None, as_json: bool) -> None:
    from grr_torch.applications.routes import part_sizes
    from grr_torch.resolution.report import summary, traded

    quality, parts = figures.to_dict(), part_sizes(roadmap)
    if as_json:
        files = {"out": str(out), "record": None if recording is None else str(recording)}
        told = {"bounds": bounds_of(roadmap), "refinement": roadmap.parameters.get("refinement")}
        print_json({**quality, "parts": parts, "build_seconds": roadmap.build_seconds, **told, **files})
        return
    rotation = roadmap.task.to_json().get("rotation")
    turned = "" if rotation is None else f", roll pitch yaw {' '.join(f'{angle:.4g}' for angle in rotation)} rad"
    title = f"{roadmap.robot.name}, {roadmap.task.kind} in {roadmap.task.name}{turned}"
    written = str(out) if recording is None else f"{out}, {recording} (grr-torch view {out})"
    change = summary(roadmap, figures)
    rows = [
        *([("refined", change)] if change else []),
        *traded(roadmap, figures).items(),
        ("built in", f"{roadmap.build_seconds:.2f} s (the algorithm alone)"),
        ("written", written),
    ]
    print_rows(title, [bounds_row(roadmap), *quality_rows(quality, parts), *rows])


@contextmanager
def _edge_check(engine: str, address: str | None, device: str) -> Iterator[Any]:
    """What checks edges, for as long as it is needed."""
    from grr_torch.projection.continuity import is_continuous

    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if engine == "local":
        if address is not None:
            raise ParameterError("--address", address, "none without --engine ray")
        yield is_continuous
        return
    from grr_torch.fleet.edges import spread_check

    if device != "cpu":
        raise ParameterError("--device", device, "cpu with --engine ray, whose workers check on their cores")
    with spread_check(address) as check:
        yield check


def _seeds(arm: Any, seeds: str | None) -> Any:
    """What `build` takes for --seeds."""
    from grr_torch.resolution.seeds import read_seeds

    problems = () if arm.preset is None else arm.preset.problems.values()
    if seeds == "preset" and not any(len(problem.seeds[0]) == arm.n for problem in problems):
        reason = "has no preset" if arm.preset is None else "has seeds for all of its joints only"
        raise ParameterError("--seeds", "preset", f"auto or a file: {arm.name} {reason}")
    if seeds in (None, "preset", "auto"):
        return "auto" if seeds == "auto" else None
    if not Path(seeds).exists() and not Path(seeds).suffix:
        raise ParameterError("--seeds", repr(seeds), "preset, auto, or a .csv, .txt or .npy file")
    return read_seeds(seeds, arm.joint_names)


def _bounds(text: str) -> list[tuple[float, float]]:
    values = some_numbers("--bounds", text, {4, 6}, "four or six numbers, all finite: x0 x1 y0 y1 [z0 z1]")
    return list(zip(values[::2], values[1::2], strict=True))
