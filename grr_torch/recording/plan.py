"""Recording a plan with rerun: the arm on its way over the roadmap; joints and clearance beside it."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from grr_torch.applications.path import Path
from grr_torch.errors import ParameterError
from grr_torch.output import atomic_write
from grr_torch.recording import colours
from grr_torch.recording.curves import curve_views, log_curves
from grr_torch.recording.robot import RecordedRobot
from grr_torch.recording.self_motion_view import in_space, line
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slices import fullest_slice

TIME = "plan"
_DARK = (18, 20, 26)
_VERTEX, _EDGE = (96, 104, 120), (58, 66, 78, 90)
_USED, _WAY, _TRACE = (255, 176, 0), (235, 235, 235, 110), (70, 200, 120)
_START, _GOAL = (70, 150, 255), (240, 85, 75)


def record_plan(roadmap: Roadmap, path: Path, file: str | os.PathLike[str]) -> None:
    """Writes a recording (.rrd) of a path, by an atomic rename.

    All of it is on the timeline `plan`. Entities: `space/way` is the tool's whole way, `space/trace` as much of it as
    has been gone, `space/tool` where it is, `space/start` and `space/goal` its ends; `space/used` are the roadmap's
    vertices and edges that it goes through, `space/vertices`, `space/edges` and `space/broken` the others;
    `joints/…` are curves, unwrapped, and `clearance` is that of self-collision.

    Args:
        roadmap: The roadmap.
        path: A path over it.
        file: The file.

    Raises:
        ParameterError: There is no path.
        OutputError: It cannot be written.
    """
    import rerun as rr

    if not path.found:
        raise ParameterError("path", path.reason, "one that was found")
    with atomic_write(file) as temporary:
        recording = rr.RecordingStream("grr_torch")
        recording.save(str(temporary), default_blueprint=_blueprint(roadmap, path))
        with recording:
            times = rr.TimeColumn(TIME, duration=path.times.numpy())
            RecordedRobot(recording, roadmap.robot).animate(times, path.configurations.numpy())
            _log_map(recording, roadmap)
            _log_way(recording, roadmap, path)
            log_curves(recording, times, roadmap.robot, path.configurations)
        recording.disconnect()


def _log_map(recording: Any, roadmap: Roadmap) -> None:
    """The roadmap, faint behind the arm; where rotation varies, in one rotation."""
    import rerun as rr

    roadmap = fullest_slice(roadmap)
    points, frame = in_space(roadmap.positions.numpy()), rr.CoordinateFrame(roadmap.robot.base)
    resolved, edges, connected = roadmap.resolved.numpy(), roadmap.edges.numpy(), roadmap.connected.numpy()
    broken = ~connected & resolved[edges].all(1)
    for name, shapes in (
        ("vertices", rr.Points3D(points[resolved], colors=_VERTEX, radii=line(1.0))),
        ("edges", rr.LineStrips3D(points[edges[connected]], colors=_EDGE, radii=line(0.3))),
        ("broken", rr.LineStrips3D(points[edges[broken]], colors=colours.BROKEN, radii=line(0.8))),
    ):
        recording.log(f"space/{name}", frame, shapes, static=True)


def _log_way(recording: Any, roadmap: Roadmap, path: Path) -> None:
    """The tool's way, the vertices and edges on it, and as much of it as has been gone."""
    import rerun as rr

    frame = rr.CoordinateFrame(roadmap.robot.base)
    tools = roadmap.robot.forward_kinematics(path.configurations)[0].cpu()[:, : roadmap.task.dimension]
    places = in_space(tools.numpy())
    vertices = path.vertices.numpy()
    used = in_space(roadmap.positions.numpy()[vertices])
    joined = {frozenset(edge) for edge in roadmap.edges[roadmap.connected].tolist()}
    pairs = [pair for pair in np.stack([vertices[:-1], vertices[1:]], axis=1) if frozenset(pair.tolist()) in joined]
    edges = in_space(roadmap.positions.numpy())[np.array(pairs, dtype=np.int64).reshape(-1, 2)]
    for name, shapes in (
        ("used/vertices", rr.Points3D(used, colors=_USED, radii=line(3.5))),
        ("used/edges", rr.LineStrips3D(edges, colors=_USED, radii=line(1.6))),
        ("way", rr.LineStrips3D([places], colors=_WAY, radii=line(0.8))),
        ("start", rr.Points3D(places[:1], colors=_START, radii=line(6.0), labels=["start"], show_labels=True)),
        ("goal", rr.Points3D(places[-1:], colors=_GOAL, radii=line(6.0), labels=["goal"], show_labels=True)),
    ):
        recording.log(f"space/{name}", frame, shapes, static=True)
    times = path.times.numpy()
    recording.log("space/tool", frame, static=True)
    tool = rr.Points3D.columns(positions=places, colors=[_TRACE] * len(places), radii=[line(5.0)] * len(places))
    recording.send_columns("space/tool", indexes=[rr.TimeColumn(TIME, duration=times)], columns=tool)
    recording.log("space/trace", frame, static=True)
    if len(places) > 1:
        strips = np.stack([places[:-1], places[1:]], axis=1)
        trace = rr.LineStrips3D.columns(strips=strips, colors=[_TRACE] * len(strips), radii=[line(2.5)] * len(strips))
        recording.send_columns("space/trace", indexes=[rr.TimeColumn(TIME, duration=times[1:])], columns=trace)


def _blueprint(roadmap: Roadmap, path: Path) -> Any:
    """Space on the left, what there is over time on the right."""
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    so_far = rrb.VisibleTimeRange(TIME, start=boundary.infinite(), end=boundary.cursor_relative(seconds=0.0))
    space = rrb.Spatial3DView(
        origin="/",
        contents=["+ /robot/**", "+ /space/**"],
        name=f"{roadmap.robot.name}, {roadmap.task.kind}: a path of {path.task_length:.2f} m in {path.duration:.2f} s",
        spatial_information=rrb.SpatialInformation(target_frame=roadmap.robot.base, show_axes=False),
        eye_controls=_camera(roadmap, path),
        line_grid=False,
        background=_DARK,
        # what has been gone so far stays
        overrides={"space/trace": rrb.VisibleTimeRanges(so_far)},
    )
    views, heights = curve_views(roadmap.robot)
    return rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(*views, row_shares=heights), column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIME, state="collapsed", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _camera(roadmap: Roadmap, path: Path) -> Any:
    """From beside the path in space, from above in the plane; arm and path are in sight."""
    import rerun.blueprint as rrb

    places = in_space(path.points[:, : roadmap.task.dimension].numpy())
    seen = np.concatenate([places, np.zeros((1, 3))])
    centre, size = 0.5 * (seen.min(0) + seen.max(0)), float(np.linalg.norm(np.ptp(seen, axis=0))) + 0.3
    flat = roadmap.task.dimension == 2
    middle = places.mean(0)
    azimuth = float(np.arctan2(middle[1], middle[0])) - 0.9
    side = np.array([0.0, -0.02, 1.0] if flat else [np.cos(azimuth), np.sin(azimuth), 0.55])
    eye = centre + 1.15 * size * side / np.linalg.norm(side)
    return rrb.EyeControls3D(position=eye, look_target=centre, eye_up=(0, 1, 0) if flat else (0, 0, 1))
