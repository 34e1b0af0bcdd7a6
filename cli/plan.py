"""`grr-torch plan`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated, Any

import typer
from grr_torch.cli.options import check_ending, numbers
from grr_torch.cli.show import print_json, print_rows, reports_errors

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    from grr_torch.applications.path import Path
    from grr_torch.resolution.roadmap import Roadmap


@reports_errors
def plan(
    file: Annotated[FilePath, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    start: Annotated[str | None, typer.Option(help="Where the tool starts, as for solve.", metavar="X Y [Z] …")] = None,
    goal: Annotated[
        str | None, typer.Option(help="Where the tool is to go, as for solve.", metavar="X Y [Z] …")
    ] = None,
    start_configuration: Annotated[
        str | None, typer.Option(help="Where the arm starts, in radians or metres; on the map or off it.", metavar="Q…")
    ] = None,
    goal_configuration: Annotated[
        str | None, typer.Option(help="Where the arm is to go, in radians or metres.", metavar="Q…")
    ] = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Shorten the path by straight lines on the map.")] = False,
    step: Annotated[float, typer.Option(help="Distance that neighbouring waypoints stay below, in radians.")] = 0.05,
    velocity: Annotated[
        float | None,
        typer.Option(help="Velocity limit of all joints, in rad/s or m/s; the robot's, or 1."),
    ] = None,
    acceleration: Annotated[
        float | None, typer.Option(help="Acceleration limit of all joints, in rad/s² or m/s²; none.")
    ] = None,
    out: Annotated[
        FilePath | None, typer.Option(help="Write times, points and joints here: .csv, .npy, .npz or .parquet.")
    ] = None,
    record: Annotated[FilePath | None, typer.Option(help="Recording to write.", metavar="FILE.rrd")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Plan a path over a roadmap; exit code 1, and no file, if there is none.

    Example: grr-torch plan kinova.grr --start 0.4 -0.3 0.2 --goal 0.4 0.3 0.4 --smooth --out path.csv --record path.rrd
    """
    from grr_torch.applications.path import save_path
    from grr_torch.output import atomic_write, check_outputs
    from grr_torch.recording.plan import record_plan
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.tables import check_suffix

    for option, given in (("--start", (start, start_configuration)), ("--goal", (goal, goal_configuration))):
        if given.count(None) != 1:
            told = "both" if None not in given else "neither"
            raise ParameterError(f"{option} and {option}-configuration", told, "one of them")
    if out is not None:
        check_suffix("--out", out)
    check_outputs({"--out": out, "--record": record}, [file])
    check_ending("--record", record, ".rrd")
    roadmap = Roadmap.load(file)
    axes, joints = roadmap.task.coordinates, roadmap.robot.joint_names
    path = roadmap.plan(
        _tensor("--start", start, axes),
        _tensor("--goal", goal, axes),
        start_configuration=_tensor("--start-configuration", start_configuration, joints),
        goal_configuration=_tensor("--goal-configuration", goal_configuration, joints),
        smooth=smooth,
        step=step,
        velocity_limits=velocity,
        acceleration_limits=acceleration,
    )
    if path.found:
        # both files appear together, or neither does
        with ExitStack() as stack:
            if record is not None:
                record_plan(roadmap, path, stack.enter_context(atomic_write(record)))
            if out is not None:
                save_path(roadmap, path, stack.enter_context(atomic_write(out)))
    _show(roadmap, path, [str(target) for target in (out, record) if target is not None], as_json)
    if not path.found:
        raise typer.Exit(1)


def _tensor(option: str, text: str | None, names: tuple[str, ...]) -> Any:
    import torch

    return None if text is None else torch.tensor(numbers(option, text, names), dtype=torch.float64)


def _show(roadmap: Roadmap, path: Path, files: list[str], as_json: bool) -> None:
    if not path.found:
        if as_json:
            print_json({"found": False, "reason": path.reason})
        else:
            typer.echo(f"no path: {path.reason}", err=True)
        return
    figures = {
        "waypoints": len(path.times),
        "vertices": path.vertices.tolist(),
        "task_length": path.task_length,
        "joint_length": path.joint_length,
        "duration": path.duration,
        "max_deviation": path.max_deviation,
        "mean_deviation": path.mean_deviation,
    }
    if as_json:
        print_json({"found": True, **figures, "files": files})
        return
    rows = [
        ("waypoints", f"{len(path.times):,}, vertices of the roadmap on it: {len(path.vertices)}"),
        ("length", f"{path.task_length:.4f} m in task space, {path.joint_length:.4f} rad in joint space"),
        ("duration", f"{path.duration:.3f} s"),
        ("deviation", f"{1e3 * path.max_deviation:.3f} mm at most, {1e3 * path.mean_deviation:.3f} mm on average"),
        *([("written", ", ".join(files))] if files else []),
    ]
    print_rows(f"{roadmap.robot.name}, {roadmap.task.kind}: a path", rows)
