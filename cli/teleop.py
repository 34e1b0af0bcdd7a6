"""`grr-torch teleop`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.options import check_ending, check_unused
from grr_torch.cli.show import NOT_CHECKED, print_json, print_rows, progress_bar, reports_errors

if TYPE_CHECKING:
    from grr_torch.applications.teleoperate import Teleoperator
    from grr_torch.applications.teleoperation_log import Summary, TeleoperationLog

# where the page is, unless told otherwise
_HOST, _PORT = "127.0.0.1", 8080


@reports_errors
def teleop(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    path: Annotated[
        str | None,
        typer.Option(
            help="Replay circle, line or a FILE of waypoints (.csv, .npy or .parquet: one a row and control step, as "
            "the roadmap's points: metres, and where rotation varies radians or unit vectors) without a browser.",
            metavar="circle|line|FILE",
        ),
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Recording to write at the end.", metavar="FILE.rrd")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write the joint trajectory, unwrapped.", metavar="FILE.csv|.npy|.npz|.parquet")
    ] = None,
    rate: Annotated[float, typer.Option(help="Control steps in a second.")] = 50.0,
    max_step: Annotated[
        float | None,
        typer.Option(
            help="The most that a joint moves in a step, in radians; by default its velocity limit over the rate."
        ),
    ] = None,
    acceleration: Annotated[
        float | None, typer.Option(help="Acceleration limit of all joints, in rad/s²; by default none.")
    ] = None,
    foresight: Annotated[
        float,
        typer.Option(
            help="For how many seconds at most an arm that cannot follow its target takes it to go straight on, and "
            "heads for where they will meet; 0: it heads for where the target is.",
        ),
    ] = 2.0,
    host: Annotated[
        str | None, typer.Option(help=f"Address of the page; {_HOST} by default: no other machine can open it.")
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help=f"Port of the page; 0: any that is free; {_PORT} by default.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Teleoperate an arm on its roadmap, in the browser until Ctrl-C, or along a path.

    Example: grr-torch teleop kinova.grr --record teleop.rrd

    Example: grr-torch teleop kinova.grr --path circle --out circle.csv
    """
    from grr_torch.applications.teleoperate import Teleoperator
    from grr_torch.output import check_outputs
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.tables import check_suffix

    if path is not None:
        check_unused({"--host": host, "--port": port}, "--path, as no page is opened")
    if out is not None:
        check_suffix("--out", out)
    check_outputs({"--record": record, "--out": out}, [file, path])
    check_ending("--record", record, ".rrd")
    roadmap = Roadmap.load(file)
    teleoperator = Teleoperator(roadmap, rate, max_step=max_step, acceleration_limits=acceleration, foresight=foresight)
    if path is None:
        log = _interact(teleoperator, _HOST if host is None else host, _PORT if port is None else port)
    else:
        log = _replay(teleoperator, path)
    _write(log, record, out)
    summary = log.summary()
    if as_json:
        print_json(summary.to_dict())
        return
    print_rows(f"{roadmap.robot.name}, {roadmap.task.kind}: {summary.steps:,} control steps", _rows(summary))
    files = ", ".join(str(name) for name in (record, out) if name is not None)
    if files:
        typer.echo(f"written: {files}")


def _replay(teleoperator: Teleoperator, path: str) -> TeleoperationLog:
    from grr_torch.applications.example_paths import KINDS, example_path
    from grr_torch.applications.replay import read_waypoints, replay
    from grr_torch.errors import UnknownNameError

    if path not in KINDS and not Path(path).suffix and not Path(path).exists():
        raise UnknownNameError("path", path, KINDS, " Or the name of a file of waypoints.")
    roadmap = teleoperator.roadmap
    example = path in KINDS
    waypoints = example_path(roadmap, path, teleoperator.rate) if example else read_waypoints(path, roadmap.task)
    with progress_bar() as progress:
        return replay(teleoperator, waypoints, progress=progress)


def _interact(teleoperator: Teleoperator, host: str, port: int) -> TeleoperationLog:
    """Until Ctrl-C, or until the process is asked to end."""
    import signal
    from threading import Event

    from grr_torch.interactive.drive import drive
    from grr_torch.interactive.page import Page
    from grr_torch.interactive.session import Session

    session = Session(teleoperator)
    page = Page(session, host, port)
    stop = Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        typer.echo(f"{session.roadmap.robot.name} at {page.url}; Ctrl-C ends it", err=True)
        drive(session, page.show, stop)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        page.close()
    return session.log


def _write(log: TeleoperationLog, record: Path | None, out: Path | None) -> None:
    """Both files appear together, or neither does."""
    from grr_torch.output import atomic_write
    from grr_torch.recording.teleoperation import record_teleoperation

    with ExitStack() as stack:
        if record is not None:
            record_teleoperation(log, stack.enter_context(atomic_write(record)))
        if out is not None:
            log.save_trajectory(stack.enter_context(atomic_write(out)))


def _rows(summary: Summary) -> list[tuple[str, str]]:
    shares = ", ".join(f"{name} {100.0 * share:.1f} %" for name, share in summary.shares.items() if share)
    clearance = NOT_CHECKED if summary.clearance is None else f"{1e3 * summary.clearance:.1f} mm"
    deviations = (summary.deviation, summary.largest_deviation, summary.final_deviation)
    turns = [math.degrees(t) for t in (summary.turn, summary.largest_turn, summary.final_turn) if t is not None]
    return [
        ("status", shares),
        ("time", f"{summary.seconds:.2f} s; a step takes {summary.step_milliseconds:.2f} ms (median)"),
        ("largest joint step", f"{summary.joint_step:.4f} rad or m"),
        ("longest stall", f"{summary.stall:.2f} s"),
        ("smallest clearance", clearance),
        ("from tool to target: mean, largest, last", ", ".join(f"{1e3 * value:.2f}" for value in deviations) + " mm"),
        *([("turned: mean, largest, last", ", ".join(f"{value:.2f}" for value in turns) + "°")] if turns else []),
    ]
