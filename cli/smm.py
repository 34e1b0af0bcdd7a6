"""`grr-torch smm`."""

from __future__ import annotations

from contextlib import ExitStack
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
from grr_torch.cli.show import NOT_CHECKED, markdown_table, print_json, progress_bar, reports_errors

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    from torch import Tensor

    from grr_torch.applications.self_motion import SelfMotionManifold
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.robot import Robot
    from grr_torch.spaces.task import TaskSpace

# vertices of the roadmap that is built where none is given, few enough that its edges are seen
_VERTICES = 120


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
    samples: Annotated[int, typer.Option(help="Random starts, and most samples of what is no curve.")] = 1000,
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
    from grr_torch.output import atomic_write, check_outputs
    from grr_torch.recording.self_motion import record_self_motion
    from grr_torch.robots.presets import robot_names

    check_outputs({"--record": record, "--out": out}, [roadmap, None if robot in robot_names() else robot, spheres])
    with progress_bar() as progress:
        given = None
        if robot is not None:
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
        turning = read_turning(rotation, axis)
        graph = _roadmap(roadmap, given, task, turning, bool(point), progress)
        places = _triangle(graph) if graph is not None and not point else [_numbers(text) for text in point or []]
        arm, space = (graph.robot, graph.task) if graph else (given, _task(given, places, task, turning))
        assert arm is not None
        manifolds = [
            self_motion_manifold(arm, space, place, samples=samples, step=step, seed=seed, progress=progress)
            for place in places
        ]
        choices = [None if graph is None else roadmap_choice(graph, manifold.point) for manifold in manifolds]
        # both files appear together, or neither does
        with ExitStack() as stack:
            if record is not None:
                record_self_motion(manifolds, stack.enter_context(atomic_write(record)), choices, graph)
            if out is not None:
                _save(stack.enter_context(atomic_write(out)), manifolds, choices)
    if as_json:
        print_json({"robot": arm.name, "task": space.to_json(), "points": [*map(_figures, manifolds, choices)]})
        return
    for manifold, choice in zip(manifolds, choices, strict=True):
        _print(manifold, choice)
    written = ", ".join(str(path) for path in (record, out) if path is not None)
    if written:
        typer.echo(f"\nwritten: {written}")


def _roadmap(
    path: Path | None,
    arm: Robot | None,
    kind: str | None,
    turning: dict[str, list[float] | None],
    has_points: bool,
    progress: Any,
) -> Roadmap | None:
    """The roadmap that is given; where there is neither one nor a point, one of the robot's preset."""
    from grr_torch.resolution.build import build
    from grr_torch.resolution.roadmap import Roadmap

    if path is not None:
        graph = Roadmap.load(path)
        if arm is not None and (arm.name, arm.joint_names) != (graph.robot.name, graph.robot.joint_names):
            raise ParameterError("--robot", arm.name, f"{graph.robot.name}, the roadmap's, or none")
        if kind not in (None, graph.task.kind):
            raise ParameterError("--task", kind, f"{graph.task.kind}, the roadmap's, or none")
        told = graph.task.to_json()
        for option, values, own in (
            ("--rotation", turning["rpy"], told.get("rotation")),
            ("--axis", turning["axis"], told.get("axis")),
        ):
            if values not in (None, own):
                raise ParameterError(option, values, "the roadmap's, or none")
        return graph
    if arm is None:
        raise ParameterError("--robot", "nothing", "a bundled robot, the path of a URDF, or --roadmap")
    if has_points:
        return None
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


def _numbers(text: str) -> list[float]:
    try:
        numbers = [float(value) for value in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3, 4, 6, 7):
        valid = "two or three numbers, x y [z], and where rotation varies yaw, ax ay az or qw qx qy qz after them"
        raise ParameterError("--point", repr(text), valid)
    return numbers


def _task(
    arm: Robot | None, places: list[list[float]], kind: str | None, turning: dict[str, list[float] | None]
) -> TaskSpace:
    """The task space that the options and the preset say, of as many axes as the points have."""
    from grr_torch.resolution.problem import complete_task
    from grr_torch.spaces.task import Pose

    assert arm is not None
    # x y yaw is a pose in the plane
    plane = len(places[0]) == 2 or (len(places[0]) == 3 and kind == Pose.kind)
    return complete_task(arm, kind, 2 if plane else 3, **turning)


def _figures(manifold: SelfMotionManifold, choice: Tensor | None) -> dict[str, Any]:
    """What is printed of a manifold."""
    counts = manifold.component.bincount(minlength=manifold.components).tolist()
    names, ranges = manifold.robot.joint_names, manifold.ranges().tolist()
    checked = manifold.robot.spheres is not None
    return {
        "point": manifold.point.tolist(),
        "dimension": manifold.dimension,
        "components": [
            {
                "samples": counts[c],
                "closed": bool(manifold.closed[c]) if manifold.dimension == 1 else None,
                "free": float(manifold.free[manifold.component == c].double().mean()) if checked else None,
                "ranges": dict(zip(names, ranges[c], strict=True)),
            }
            for c in range(manifold.components)
        ],
        "roadmap": None if choice is None else choice.tolist(),
        "roadmap_component": None if choice is None else manifold.component_of(choice),
    }


def _print(manifold: SelfMotionManifold, choice: Tensor | None) -> None:
    figures = _figures(manifold, choice)
    place = ", ".join(f"{value:g}" for value in figures["point"])
    typer.secho(
        f"\n{manifold.robot.name}, {manifold.task.kind}, tool at ({place}): dimension {manifold.dimension}", bold=True
    )
    rows = [
        [
            f"{number + 1}{' *' if number == figures['roadmap_component'] else ''}",
            f"{part['samples']:,}",
            {True: "closed", False: "open", None: "no curve"}[part["closed"]],
            NOT_CHECKED if part["free"] is None else f"{100.0 * part['free']:.1f} %",
            *(f"{low:.2f} … {high:.2f}" for low, high in part["ranges"].values()),
        ]
        for number, part in enumerate(figures["components"])
    ]
    head = ["component", "samples", "curve", "free of self-collision", *manifold.robot.joint_names]
    typer.echo(markdown_table(head, rows))
    if choice is not None:
        values = ", ".join(f"{value:.3f}" for value in figures["roadmap"])
        on = "on no component found" if figures["roadmap_component"] is None else "on the component marked *"
        typer.echo(f"the roadmap's choice, {on}: {values}")


def _save(path: Path, manifolds: list[SelfMotionManifold], choices: list[Tensor | None]) -> None:
    """All samples as arrays: each with its point, its component (numbered over all points) and whether it is free."""
    import numpy as np
    import torch

    firsts = np.cumsum([0, *(manifold.components for manifold in manifolds)])
    rows = np.cumsum([0, *(len(manifold.configurations) for manifold in manifolds)])
    nothing = torch.full((manifolds[0].robot.n,), torch.nan)
    joined = zip(manifolds, firsts, rows, strict=False)
    parts = [(m.component.numpy() + first, m.edges.numpy() + row) for m, first, row in joined]
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            joint_names=np.array(manifolds[0].robot.joint_names),
            points=torch.stack([manifold.point for manifold in manifolds]).numpy(),
            configurations=torch.cat([manifold.configurations for manifold in manifolds]).numpy(),
            free=torch.cat([manifold.free for manifold in manifolds]).numpy(),
            component=np.concatenate([component for component, _ in parts]),
            edges=np.concatenate([edges for _, edges in parts]),
            closed=torch.cat([manifold.closed for manifold in manifolds]).numpy(),
            component_point=np.repeat(np.arange(len(manifolds)), np.diff(firsts)),
            roadmap=torch.stack([nothing if choice is None else choice for choice in choices]).numpy(),
        )
