"""`grr-torch bench teleop`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import show_machine
from grr_torch.cli.options import check_ending
from grr_torch.cli.show import print_json, progress_bar, reports_errors, show_table

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    from grr_torch.experiments.teleoperation import Run


@reports_errors
def teleop(
    file: Annotated[
        Path | None,
        typer.Argument(help="A roadmap file; by default the Kinova preset's roadmap is built.", metavar="[FILE.grr]"),
    ] = None,
    paths: Annotated[
        Path | None,
        typer.Option(
            help="Paths to follow: an .npz with an array (paths, waypoints, numbers of a point) for each kind of path."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the joint trajectories to this .npz: METHOD__KIND, (paths, steps, n), NaN after the end."
        ),
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Of expansion,random,newton,relaxed; random builds a map first, which takes minutes.")
    ] = "expansion,random,newton,relaxed",
    count: Annotated[int, typer.Option(min=1, help="Paths of each kind that are drawn.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw, and of the method random.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Print how well arms follow targets at 50 Hz, on roadmaps and with IK solvers: the paper's Table II.

    Kinds of paths: line_random, line_self, circle_random, circle_out. A joint moves at most 0.04 rad a step.

    Example: grr-torch bench teleop --methods expansion,newton

    Example: grr-torch bench teleop kinova.grr --paths mine.npz --out results.npz
    """
    from grr_torch.experiments.paths import KINDS, read_paths
    from grr_torch.experiments.teleoperation import aggregate, check_methods, run_teleoperation, save_trajectories
    from grr_torch.experiments.timing import machine
    from grr_torch.output import check_outputs
    from grr_torch.resolution.build import build
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.load import load_robot

    names = [name.strip() for name in methods.split(",") if name.strip()]
    if not names:
        raise ParameterError("--methods", repr(methods), "some of expansion, random, newton, relaxed")
    check_methods(names)
    check_outputs({"--out": out}, [file, paths])
    check_ending("--out", out, ".npz")
    with progress_bar() as progress:
        roadmap = Roadmap.load(file) if file else build(load_robot("kinova"), "fixed-rotation", progress=progress)
        given = None if paths is None else read_paths(paths, roadmap.task.width)
        runs = run_teleoperation(roadmap, paths=given, methods=names, count=count, seed=seed, progress=progress)
    results = aggregate(runs)
    if out is not None:
        save_trajectories(runs, out)
    if as_json:
        print_json({"machine": machine(), "runs": results})
        return
    show_machine()
    head = ["kind", "method", "success", "deviation [m]: all, of paths that all solve", "tilt [rad]"]
    head += ["smoothness [rad/m]: all, of paths that all solve", "largest step [rad]", "acceleration [rad/s²]"]
    head += ["closure [rad]", "longest stall [s]", "step [ms]"]
    order = sorted(range(len(runs)), key=lambda index: KINDS.index(runs[index].kind))
    show_table(head, [_row(runs[index], results[index]) for index in order])


def _row(run: Run, result: dict[str, float | str | int | None]) -> list[str]:
    def number(name: str, digits: int) -> str:
        return "" if result[name] is None else f"{result[name]:.{digits}f}"

    return [
        run.kind,
        run.method,
        f"{100.0 * float(result['success'] or 0.0):.0f} %",
        f"{number('deviation', 4)}, {number('deviation_solved', 4) or 'none'}",
        number("tilt", 4),
        f"{number('smoothness', 2)}, {number('smoothness_solved', 2) or 'none'}",
        number("joint_step", 4),
        number("acceleration", 0),
        number("closure", 3),
        number("stall", 2),
        f"{1e3 * run.step_seconds:.2f}",
    ]
