"""`grr-torch smm`."""

from __future__ import annotations

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
from grr_torch.cli.options import check_ending, check_unused, numbers, some_numbers
from grr_torch.cli.show import print_json, progress_bar, reports_errors
from grr_torch.cli.show_self_motion import figures_of, print_manifold, write_manifolds

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.robot import Robot
    from grr_torch.spaces.task import TaskSpace

# vertices of the roadmap that is built where none is given, few enough that its edges are seen
_VERTICES = 120
# numbers of a point, in one task space or another
_COUNTS = {2, 3, 4, 6, 7}


@reports_errors
def smm(
    robot: Annotated[
        str | None, typer.Option(help="A bundled robot (grr-torch robots) or the path of a URDF; the roadmap's.")
    ] = None,
    point: Annotated[
        list[str] | None,
        typer.Option(
            help="Point of the task space in metres; repeatable: all are drawn together. None: three neighbouring "
            "vertices of the roadmap.",
            metavar="X Y [Z] …",
        ),
    ] = None,
    task: TaskKind = None,
    rotation: Rotation = None,
    axis: Axis = None,
    roadmap: Annotated[
        Path | None,
        typer.Option(help="Marks what this roadmap has there; for no --point, built if not given.", metavar="FILE.grr"),
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Recording to write.", metavar="FILE.rrd")] = None,
    out: Annotated[Path | None, typer.Option(help="Write all samples here.", metavar="FILE.npz")] = None,
    samples: Annotated[
        int, typer.Option(help="Random starts; of what is no curve, the most samples, half as many starts among them.")
    ] = 1000,
    step: Annotated[float | None, typer.Option(help="Longest step, in radians; 0.05 on curves, else 0.3.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    tool: Tool = None,
    base: Base = None,
    package_dir: PackageDirs = None,
    allow_missing_meshes: AllowMissingMeshes = False,
    hold: Held = None,
    spheres: Spheres = None,
    margin: Margin = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Find all configurations that reach a point: the components of its self-motion manifold.

    Example: grr-torch smm --robot kinova --point 0.5 0.1 0.3 --record smm.rrd

    Example: grr-torch smm --robot planar_3 --record illustration.rrd
    """
    from grr_torch.applications.self_motion import roadmap_choice, self_motion_manifold
    from grr_torch.output import check_outputs
    from grr_torch.robots.presets import robot_names

    check_outputs({"--record": record, "--out": out}, [roadmap, None if robot in robot_names() else robot, spheres])
    check_ending("--record", record, ".rrd")
    check_ending("--out", out, ".npz")
    turning = read_turning(rotation, axis)
    with progress_bar() as progress:
        if roadmap is not None:
            of_arm = {"--tool": tool, "--base": base, "--hold": hold, "--spheres": spheres, "--margin": margin}
            of_meshes = {"--package-dir": package_dir, "--allow-missing-meshes": allow_missing_meshes}
            check_unused({**of_arm, **of_meshes}, "--roadmap, as its arm is taken")
            graph: Roadmap | None = _given_roadmap(roadmap, robot, task, turning)
        elif robot is None:
            raise ParameterError("--robot", "nothing", "a bundled robot, the path of a URDF, or --roadmap")
        else:
            given = load_arm(
                robot,
                tool=tool,
                base=base,
                package_dir=package_dir,
                allow_missing_meshes=allow_missing_meshes,
                hold=hold,
                spheres=spheres,
                margin=margin,
            )
            graph = None if point else _preset_roadmap(given, task, turning, progress)
        arm, space = (given, _task(given, point or [], task, turning)) if graph is None else (graph.robot, graph.task)
        if point:
            places = [numbers("--point", text, space.coordinates) for text in point]
        else:
            assert graph is not None
            places = _triangle(graph)
        manifolds = [
            self_motion_manifold(arm, space, place, samples=samples, step=step, seed=seed, progress=progress)
            for place in places
        ]
        choices = [None if graph is None else roadmap_choice(graph, manifold.point) for manifold in manifolds]
        write_manifolds(manifolds, choices, graph, record, out)
    if as_json:
        print_json({"robot": arm.name, "task": space.to_json(), "points": [*map(figures_of, manifolds, choices)]})
        return
    for manifold, choice in zip(manifolds, choices, strict=True):
        print_manifold(manifold, choice)
    written = ", ".join(str(path) for path in (record, out) if path is not None)
    if written:
        typer.echo(f"\nwritten: {written}")


def _given_roadmap(path: Path, robot: str | None, kind: str | None, turning: dict[str, list[float] | None]) -> Roadmap:
    """The roadmap of a file.

    Raises:
        ParameterError: It is of another robot or task than is told.
    """
    from grr_torch.resolution.roadmap import Roadmap

    graph = Roadmap.load(path)
    if robot is not None and not _is_arm(robot, graph.robot):
        raise ParameterError("--robot", robot, f"{graph.robot.name}, the roadmap's, or none")
    if kind not in (None, graph.task.kind):
        raise ParameterError("--task", kind, f"{graph.task.kind}, the roadmap's, or none")
    told = graph.task.to_json()
    for option, values, own in (
        ("--rotation", turning["rpy"], told.get("rotation")),
        ("--axis", turning["axis"], told.get("axis")),
    ):
        if values not in (None, own):
            valid = f"none: the roadmap's task, {graph.task.kind}, has none"
            if own is not None:
                valid = f"{' '.join(map(str, own))}, the roadmap's, or none"
            raise ParameterError(option, " ".join(map(str, values or [])), valid)
    return graph


def _is_arm(robot: str, arm: Robot) -> bool:
    """Whether a bundled name or a URDF is that of an arm, whose tool, base and held joints are not told."""
    from grr_torch.robots.presets import robot_names
    from grr_torch.robots.read_urdf import read_urdf

    if robot in robot_names() or not Path(robot).exists():
        return robot == arm.name
    urdf = read_urdf(robot)
    return urdf.name == arm.name and set(arm.joint_names) <= set(urdf.joints)


def _preset_roadmap(arm: Robot, kind: str | None, turning: dict[str, list[float] | None], progress: Any) -> Roadmap:
    """A roadmap of the robot's preset, for a command that names no point.

    Raises:
        ParameterError: It has none, or something is told that only points need.
    """
    from grr_torch.resolution.build import build

    if arm.preset is None:
        raise ParameterError("--point", "nothing", f"a point, or --roadmap: {arm.name} has no preset")
    for option, values in (("--rotation", turning["rpy"]), ("--axis", turning["axis"])):
        if values is not None:
            raise ParameterError(option, values, "none without --point: the preset's is taken")
    problem = arm.preset.problems.get(kind or arm.preset.default_task)
    coarse = problem is not None and len(problem.bounds) == 2
    return build(arm, kind, points=_VERTICES if coarse else None, progress=progress)


def _triangle(graph: Roadmap) -> list[list[float]]:
    """Three neighbouring vertices, all joined, as near as there are to two thirds of the way to the farthest one."""
    import torch

    corners = graph.cells()[0].corners
    if len(corners) == 0:
        raise ParameterError("--point", "nothing", "a point: the roadmap has no three vertices that are all joined")
    places = graph.positions
    middle = places[graph.resolved].mean(0)
    away = places[corners].mean(1) - middle
    radius = (places[graph.resolved] - middle).norm(dim=1).max()
    wanted = radius * torch.nn.functional.normalize(torch.ones_like(middle), dim=0) / 1.5
    triangle: list[list[float]] = graph.points[corners[(away - wanted).norm(dim=1).argmin()]].tolist()
    return triangle


def _task(arm: Robot, points: list[str], kind: str | None, turning: dict[str, list[float] | None]) -> TaskSpace:
    """The task space that the options and the preset say, of as many axes as the points have."""
    from grr_torch.resolution.problem import complete_task
    from grr_torch.spaces.task import Pose

    valid = (
        "two or three numbers, x y [z], and where rotation varies yaw, ax ay az or qw qx qy qz after them, all finite"
    )
    count, *_ = [len(some_numbers("--point", text, _COUNTS, valid)) for text in points]
    # x y yaw is a pose in the plane
    plane = count == 2 or (count == 3 and kind == Pose.kind)
    return complete_task(arm, kind, 2 if plane else 3, **turning)
