"""`grr-torch solve`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.options import numbers
from grr_torch.cli.show import markdown_table, print_json, print_rows, progress_bar, reports_errors

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np

    from grr_torch.resolution.roadmap import Roadmap


@reports_errors
def solve(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    point: Annotated[
        list[str] | None,
        typer.Option(
            help="Point of the task space in metres; repeatable. Where rotation varies, a yaw in radians, a direction, "
            "or a quaternion W X Y Z follows.",
            metavar="X Y [Z] …",
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Points, one a row: .csv, .npy or .parquet; of columns, those named x, y, z (yaw, ax …, qw …)."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write points, joints, valid and status here: .csv, .npy, .npz or .parquet."),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Solve inverse kinematics on a roadmap: one configuration for any point of the task space.

    Points that the map does not solve have a status that says why; they are no error.

    Example: grr-torch solve kinova.grr --point 0.4 0.2 0.3

    Example: grr-torch solve kinova.grr --points points.csv --out joints.csv
    """
    import numpy as np

    from grr_torch.applications.solve_table import solve_table
    from grr_torch.output import check_outputs
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.tables import check_suffix, read_points

    if (points is None) == (not point):
        raise ParameterError("--point and --points", "both" if point else "neither", "one of them")
    if points is not None and out is None:
        raise ParameterError("--out", "nothing", "a file for the solutions of --points")
    if out is not None:
        check_suffix("--out", out)
        check_outputs({"--out": out}, [file, points])
    roadmap = Roadmap.load(file, device=device)
    width, axes = roadmap.task.width, roadmap.task.coordinates
    places = np.array([numbers("--point", text, axes) for text in point or []]).reshape(-1, width)
    counts = {}
    if out is not None:
        with progress_bar() as progress:
            # read twice: what is wrong with the file is said before the work starts
            count = len(places) if points is None else sum(map(len, read_points(points, axes)))
            pieces = [places] if points is None else read_points(points, axes)
            counts = solve_table(roadmap, pieces, count, out, progress=progress)
    _show(roadmap, places, counts, out, as_json)


def _show(roadmap: Roadmap, places: np.ndarray, counts: dict[str, int], out: Path | None, as_json: bool) -> None:
    import torch

    solution = roadmap.solve(torch.from_numpy(places))
    joints = [q if valid else None for q, valid in zip(solution.configurations.tolist(), solution.valid, strict=True)]
    if as_json:
        solved = [
            {"point": place, "configuration": q, "valid": q is not None, "status": str(status)}
            for place, q, status in zip(places.tolist(), joints, solution.status, strict=True)
        ]
        files = {} if out is None else {"counts": counts, "out": str(out)}
        names = list(roadmap.robot.joint_names)
        print_json({"robot": roadmap.robot.name, "joint_names": names, "points": solved, **files})
        return
    if len(places):
        rows = [
            [" ".join(f"{value:g}" for value in place), str(status), *(f"{value:.4f}" for value in q or [])]
            for place, q, status in zip(places.tolist(), joints, solution.status, strict=True)
        ]
        head = ["point [m]", "status", *roadmap.robot.joint_names]
        typer.echo(markdown_table(head, [row + ["–"] * (len(head) - len(row)) for row in rows]))
    if out is not None:
        total = sum(counts.values())
        shares = [(status, f"{number:,} ({100.0 * number / total:.2f} %)") for status, number in counts.items()]
        print_rows(f"{total:,} points", [*shares, ("written", str(out))])
