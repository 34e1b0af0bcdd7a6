"""Recording a roadmap with rerun: the map, how it grew, and the arm moving over it."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
from typing import Any

import numpy as np

from grr_torch.errors import GrrError
from grr_torch.output import atomic_write
from grr_torch.recording import colours
from grr_torch.recording.robot import RecordedRobot
from grr_torch.recording.tour import tour
from grr_torch.resolution.cells import windings
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slices import fullest_slice

WAVE, TOUR = "wave", "tour"
_TOUR_RATE = 25.0
_WAVES_PER_SECOND = 2.0


def record_roadmap(roadmap: Roadmap, path: str | os.PathLike[str]) -> None:
    """Writes a roadmap's recording (.rrd), by an atomic rename.

    On the timeline `wave` the expansion grows; on `tour` the arm moves along connected edges. Entities:
    `roadmap/by_joint/…` and `roadmap/clearance` colour the resolved vertices, `roadmap/connected`, `roadmap/broken`
    and `roadmap/grid` are edges, `roadmap/cells/wound` are triangles with a winding, `roadmap/cells/spread` others that
    are not certified because of a spread above 1 rad or a broken edge, `roadmap/unresolved` are vertices that are
    reachable but have no configuration.

    Where rotation varies, the map is shown in the rotation in which most vertices are resolved.

    Raises:
        OutputError: It cannot be written.
    """
    import rerun as rr

    roadmap = fullest_slice(roadmap)

    with atomic_write(path) as temporary:
        recording = rr.RecordingStream("grr_torch")
        recording.save(str(temporary), default_blueprint=_blueprint(roadmap))
        with recording:
            _log(recording, roadmap)
        recording.disconnect()


def show_roadmap(roadmap: Roadmap) -> None:
    """Opens a roadmap in the rerun viewer.

    Raises:
        GrrError: The viewer cannot be started.
    """
    import rerun as rr

    # the viewer lies beside the interpreter, which need not be on the PATH
    viewer = shutil.which("rerun", path=os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", "")]))
    if viewer is None:
        raise GrrError("the rerun viewer is not installed (pip install rerun-sdk); or write a file with --save F.rrd")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise GrrError("there is no screen to open the rerun viewer on; write a file with --save F.rrd")
    recording = rr.RecordingStream("grr_torch")
    roadmap = fullest_slice(roadmap)
    try:
        rr.spawn(executable_path=viewer, recording=recording, default_blueprint=_blueprint(roadmap))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise GrrError(f"the rerun viewer cannot be started: {reason}; write a file with --save F.rrd") from error
    with recording:
        _log(recording, roadmap)


def _log(recording: Any, roadmap: Roadmap) -> None:
    robot = RecordedRobot(recording, roadmap.robot)
    _log_map(recording, roadmap)
    if bool(roadmap.resolved.any()):
        _log_waves(recording, roadmap, robot)
        _log_tour(recording, roadmap, robot)


def _log_map(recording: Any, roadmap: Roadmap) -> None:
    import rerun as rr

    points = _in_space(roadmap.positions.numpy())
    resolved = roadmap.resolved.numpy()
    radius = _radius(roadmap)
    q = roadmap.configurations[roadmap.resolved]
    frame = rr.CoordinateFrame(roadmap.robot.base)

    def log(entity: str, *archetypes: Any) -> None:
        recording.log(f"roadmap/{entity}", frame, *archetypes, static=True)

    for index, name in enumerate(roadmap.robot.joint_names):
        values = q[:, index].numpy()
        shade = colours.circle(values) if roadmap.robot.continuous[index] else colours.scale(values)
        log(f"by_joint/{name}", rr.Points3D(points[resolved], colors=shade, radii=radius))
    clearance = roadmap.robot.self_collision_distance(q).cpu()
    if bool(clearance.isfinite().all()) and len(clearance):
        log("clearance", rr.Points3D(points[resolved], colors=colours.scale(clearance.numpy()), radii=radius))
    edges = roadmap.edges.numpy()
    connected = roadmap.connected.numpy()
    broken = ~connected & resolved[edges].all(1)
    log("connected", rr.LineStrips3D(points[edges[connected]], colors=colours.CONNECTED, radii=_line(0.4)))
    log("broken", rr.LineStrips3D(points[edges[broken]], colors=colours.BROKEN, radii=_line(1.6)))
    log("grid", rr.LineStrips3D(points[edges], colors=colours.GRID, radii=_line(0.25)))
    uncertified = roadmap.uncertified[0]
    wound = (windings(roadmap, uncertified) != 0).any(1)
    for name, cells, colour in (("wound", wound, colours.WOUND), ("spread", ~wound, colours.SPREAD)):
        corners = uncertified[cells].numpy()
        if len(corners):
            log(f"cells/{name}", rr.Mesh3D(vertex_positions=points, triangle_indices=corners, albedo_factor=colour))
    if roadmap.reachable is not None:
        left = (roadmap.reachable & ~roadmap.resolved).numpy()
        log("unresolved", rr.Points3D(points[left], colors=colours.UNRESOLVED, radii=1.6 * radius))


def _log_waves(recording: Any, roadmap: Roadmap, robot: RecordedRobot) -> None:
    """The expansion: what is resolved after each wave, and an arm at its latest vertex."""
    import rerun as rr

    points, wave = _in_space(roadmap.positions.numpy()), roadmap.wave.numpy()
    edges = roadmap.edges[roadmap.connected].numpy()
    edge_wave = wave[edges].max(1) if len(edges) else np.empty(0, dtype=np.int32)
    frame = rr.CoordinateFrame(roadmap.robot.base)
    radius = _radius(roadmap)
    latest: list[int] = []
    for entity in ("vertices", "edges"):
        recording.log(f"expansion/{entity}", frame, static=True)
    for step in range(int(wave.max()) + 1):
        # the map also grows at the start of the tour, so that it is seen without changing the timeline
        recording.set_time(WAVE, sequence=step)
        recording.set_time(TOUR, duration=step / _WAVES_PER_SECOND)
        done = (wave >= 0) & (wave <= step)
        shade = np.where((wave[done] == step)[:, None], (255, 176, 0), (90, 150, 200)).astype(np.uint8)
        recording.log("expansion/vertices", rr.Points3D(points[done], colors=shade, radii=radius))
        lines = points[edges[edge_wave <= step]]
        recording.log("expansion/edges", rr.LineStrips3D(lines, colors=colours.CONNECTED, radii=_line(0.4)))
        latest.append(int(np.flatnonzero(wave == step)[0]) if (wave == step).any() else latest[-1])
    recording.reset_time()
    robot.animate(rr.TimeColumn(WAVE, sequence=range(len(latest))), roadmap.configurations[latest].numpy())


def _log_tour(recording: Any, roadmap: Roadmap, robot: RecordedRobot) -> None:
    """The arm moving along connected edges, its joints as curves, and the tool's trace."""
    import rerun as rr

    points, q = tour(roadmap)
    times = rr.TimeColumn(TOUR, duration=np.arange(len(q)) / _TOUR_RATE)
    robot.animate(times, q.numpy())
    hues = colours.circle(2.0 * np.pi * np.arange(roadmap.robot.n) / roadmap.robot.n)
    for index, (name, hue) in enumerate(zip(roadmap.robot.joint_names, hues, strict=True)):
        recording.log(f"joints/{name}", rr.SeriesLines(names=name, colors=hue), static=True)
        recording.send_columns(
            f"joints/{name}", indexes=[times], columns=rr.Scalars.columns(scalars=q[:, index].numpy())
        )
    trace = _in_space(points[:, : roadmap.task.dimension].numpy())
    recording.log(
        "tour/path",
        rr.CoordinateFrame(roadmap.robot.base),
        rr.LineStrips3D([trace], colors=colours.TOUR, radii=_line(0.7)),
        static=True,
    )
    recording.log("tour/tool", rr.CoordinateFrame(roadmap.robot.base), static=True)
    recording.send_columns(
        "tour/tool",
        indexes=[times],
        columns=rr.Points3D.columns(
            positions=trace, colors=[(255, 255, 255)] * len(trace), radii=[1.6 * _radius(roadmap)] * len(trace)
        ),
    )


def _blueprint(roadmap: Roadmap) -> Any:
    """The map with the arm at once; the expansion and the joints beside it."""
    import rerun.blueprint as rrb

    first = roadmap.robot.joint_names[0]
    others = [f"- /roadmap/by_joint/{name}" for name in roadmap.robot.joint_names if name != first]

    def space(name: str, *contents: str) -> Any:
        return rrb.Spatial3DView(
            origin="/",
            contents=["+ /robot/**", *contents],
            name=name,
            spatial_information=rrb.SpatialInformation(target_frame=roadmap.robot.base, show_axes=False),
            eye_controls=_camera(roadmap),
            line_grid=False,
            background=(18, 20, 26),
        )

    hidden = ["- /roadmap/grid", "- /roadmap/clearance", *others]
    title = f"{roadmap.robot.name}, {roadmap.task.kind}: colour = {first}"
    main = space(title, "+ /roadmap/**", "+ /tour/**", *hidden)
    growth = space("expansion", "+ /expansion/**")
    clearance = space("clearance", "+ /roadmap/clearance", "+ /roadmap/broken")
    joints = rrb.TimeSeriesView(origin="/joints", name="joints on the tour [rad]")
    side = rrb.Vertical(rrb.Tabs(growth, clearance, active_tab=0), joints, row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(main, side, column_shares=[2, 1]),
        rrb.TimePanel(timeline=TOUR, state="collapsed", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _camera(roadmap: Roadmap) -> Any:
    """From the side and above in space, from above in the plane."""
    import rerun.blueprint as rrb

    shown = roadmap.positions[roadmap.resolved] if bool(roadmap.resolved.any()) else roadmap.positions
    points = _in_space(shown.numpy())
    centre = 0.5 * (points.min(0) + points.max(0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    flat = roadmap.task.dimension == 2
    direction = np.array([0.0, -0.02, 1.0]) if flat else np.array([0.9, -0.42, 0.42])
    eye = centre + (0.85 if flat else 0.8) * size * direction / np.linalg.norm(direction)
    return rrb.EyeControls3D(position=eye, look_target=centre, eye_up=(0, 1, 0) if flat else (0, 0, 1))


def _in_space(points: np.ndarray) -> np.ndarray:
    """Points (V, 3); those of the plane at z = 0."""
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points))])


def _radius(roadmap: Roadmap) -> float:
    """Radius [m] of a vertex as it is drawn: small enough in space that the arm is seen between them."""
    a, b = roadmap.positions[roadmap.edges].unbind(1)
    share = 0.125 if roadmap.task.dimension == 2 else 0.05
    return share * float((a - b).norm(dim=1).median()) if len(a) else 0.01


def _line(width: float) -> Any:
    """Width of a line in points of the screen, so that edges stay thin from near and far."""
    import rerun as rr

    return rr.components.Radius.ui_points(width)
