"""Recording a teleoperation with rerun: target, tool and arm in space; status, joints and clearance over time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from grr_torch.applications.steps import STATUSES
from grr_torch.applications.teleoperation_log import TeleoperationLog
from grr_torch.errors import ParameterError
from grr_torch.output import atomic_write
from grr_torch.recording import colours
from grr_torch.recording.colours import Colours
from grr_torch.recording.robot import RecordedRobot
from grr_torch.recording.self_motion_view import in_space, line, palette
from grr_torch.resolution.slices import fullest_slice

TIME = "teleoperation"
_DARK = (18, 20, 26)
# of the points at which the trace in space is drawn
_SHORTEST = 1e-3


def record_teleoperation(log: TeleoperationLog, path: str | os.PathLike[str]) -> None:
    """Writes a recording (.rrd) of a teleoperation, by an atomic rename.

    All of it is on the timeline `teleoperation`. Entities: `space/target` and `space/tool` are where they are,
    `space/trace` the tool's way so far in the colours of the status, `space/whole` all of it, `space/asked` the
    target's way; `joints/…` are curves, unwrapped; `status`, `clearance`, `distance` and `turn` what their names
    say.

    Args:
        log: The steps.
        path: The file.

    Raises:
        ParameterError: There was no step.
        OutputError: It cannot be written.
    """
    import rerun as rr

    if len(log) == 0:
        raise ParameterError("log", "no step", "at least one to record")
    scene = _Scene(log)
    with atomic_write(path) as temporary:
        recording = rr.RecordingStream("grr_torch")
        recording.save(str(temporary), default_blueprint=scene.blueprint())
        with recording:
            scene.log_all(recording)
        recording.disconnect()


@dataclass(frozen=True)
class _Scene:
    log: TeleoperationLog

    @property
    def tools(self) -> np.ndarray:
        """(T, 3) where the tool was, in the plane at z = 0."""
        return in_space(self.log.tools[:, : self.log.roadmap.task.dimension].numpy())

    @property
    def targets(self) -> np.ndarray:
        return in_space(self.log.targets[:, : self.log.roadmap.task.dimension].numpy())

    def log_all(self, recording: Any) -> None:
        import rerun as rr

        robot = RecordedRobot(recording, self.log.roadmap.robot)
        times = rr.TimeColumn(TIME, duration=self.log.times.numpy())
        robot.animate(times, self.log.configurations.numpy())
        self._log_map(recording)
        self._log_ways(recording)
        self._log_dots(recording, times)
        self._log_status(recording)
        self._log_curves(recording, times)

    def _log_map(self, recording: Any) -> None:
        """The roadmap, faint behind the arm; where rotation varies, one rotation of it."""
        import rerun as rr

        roadmap = fullest_slice(self.log.roadmap)
        points, frame = in_space(roadmap.positions.numpy()), rr.CoordinateFrame(roadmap.robot.base)
        resolved = roadmap.resolved.numpy()
        dots = rr.Points3D(points[resolved], colors=(96, 104, 120), radii=line(1.0))
        recording.log("space/roadmap/vertices", frame, dots, static=True)
        broken = roadmap.edges[~roadmap.connected].numpy()
        broken = broken[resolved[broken].all(1)]
        edges = rr.LineStrips3D(points[broken], colors=colours.BROKEN, radii=line(0.8))
        recording.log("space/roadmap/broken", frame, edges, static=True)

    def _log_ways(self, recording: Any) -> None:
        """The target's whole way; the tool's, and as much of it as has been gone."""
        import rerun as rr

        frame = rr.CoordinateFrame(self.log.roadmap.robot.base)
        asked = rr.LineStrips3D([self.targets], colors=(235, 235, 235, 70), radii=line(0.7))
        recording.log("space/asked", frame, asked, static=True)
        kept = _spaced(self.tools)
        ends, shade = self.tools[kept], status_colours(self.log.status[kept])
        strips = np.stack([ends[:-1], ends[1:]], axis=1)
        faint = np.column_stack([shade[1:], np.full(len(strips), 60, dtype=np.uint8)])
        recording.log("space/whole", frame, rr.LineStrips3D(strips, colors=faint, radii=line(1.0)), static=True)
        recording.log("space/trace", frame, static=True)
        if len(strips):
            recording.send_columns(
                "space/trace",
                indexes=[rr.TimeColumn(TIME, duration=self.log.times.numpy()[kept[1:]])],
                columns=rr.LineStrips3D.columns(strips=strips, colors=shade[1:], radii=[line(2.2)] * len(strips)),
            )

    def _log_dots(self, recording: Any, times: Any) -> None:
        """The target, the tool, and between them a line."""
        import rerun as rr

        frame, count = rr.CoordinateFrame(self.log.roadmap.robot.base), len(self.log)
        shade = status_colours(self.log.status)
        for name, places, hues, size in (
            ("target", self.targets, np.full((count, 3), 255, dtype=np.uint8), 7.0),
            ("tool", self.tools, shade, 5.0),
        ):
            recording.log(f"space/{name}", frame, static=True)
            columns = rr.Points3D.columns(positions=places, colors=hues, radii=[line(size)] * count)
            recording.send_columns(f"space/{name}", indexes=[times], columns=columns)
        between = np.stack([self.tools, self.targets], axis=1)
        recording.log("space/between", frame, static=True)
        columns = rr.LineStrips3D.columns(
            strips=between, colors=[(255, 255, 255, 120)] * count, radii=[line(0.8)] * count
        )
        recording.send_columns("space/between", indexes=[times], columns=columns)

    def _log_status(self, recording: Any) -> None:
        """The status, where it changes."""
        import rerun as rr

        names = STATUSES.tolist()
        shown = rr.StateConfiguration(values=names, labels=names, colors=status_colours(STATUSES))
        recording.log("status", shown, static=True)
        status = self.log.status
        changes = np.concatenate([[0], np.flatnonzero(status[1:] != status[:-1]) + 1])
        recording.send_columns(
            "status",
            indexes=[rr.TimeColumn(TIME, duration=self.log.times.numpy()[changes])],
            columns=rr.StateChange.columns(state=status[changes].tolist()),
        )

    def _log_curves(self, recording: Any, times: Any) -> None:
        import rerun as rr

        robot = self.log.roadmap.robot
        curves = [
            (f"joints/{name}", name, hue, self.log.configurations[:, index])
            for index, (name, hue) in enumerate(zip(robot.joint_names, palette(robot.n), strict=True))
        ]
        curves.append(("distance", "tool to target", (150, 190, 255), 1e3 * self.log.deviations))
        if (turns := self.log.turns) is not None:
            curves.append(("turn", "tool to target", (230, 190, 140), turns.rad2deg()))
        if robot.spheres is not None:
            curves.append(("clearance", "clearance", (120, 220, 150), 1e3 * self.log.clearances))
        for entity, name, hue, values in curves:
            recording.log(entity, rr.SeriesLines(names=name, colors=hue, widths=1.5), static=True)
            recording.send_columns(entity, indexes=[times], columns=rr.Scalars.columns(scalars=values.numpy()))

    def blueprint(self) -> Any:
        """Space on the left, what there is over time on the right."""
        import rerun.blueprint as rrb

        roadmap = self.log.roadmap
        space = rrb.Spatial3DView(
            origin="/",
            contents=["+ /robot/**", "+ /space/**"],
            name=f"{roadmap.robot.name}, {roadmap.task.kind}: white the target, in colours of the status the tool",
            spatial_information=rrb.SpatialInformation(target_frame=roadmap.robot.base, show_axes=False),
            eye_controls=self._camera(),
            line_grid=False,
            background=_DARK,
            # what has been gone so far stays
            overrides={"space/trace": rrb.VisibleTimeRanges(_so_far())},
        )
        over_time = [
            rrb.StateTimelineView(origin="/status", name="status"),
            rrb.TimeSeriesView(
                origin="/joints", name="joints, unwrapped [rad or m]", plot_legend=rrb.PlotLegend(corner="RightTop")
            ),
            rrb.TimeSeriesView(origin="/distance", name="from tool to target [mm]", plot_legend=_no_legend()),
        ]
        shares = [1.1, 4.0, 2.0]
        if roadmap.task.rotations is not None:
            over_time.append(rrb.TimeSeriesView(origin="/turn", name="turned from it [°]", plot_legend=_no_legend()))
            shares.append(2.0)
        if roadmap.robot.spheres is not None:
            clearance = "self-collision distance beyond the margin [mm]"
            over_time.append(rrb.TimeSeriesView(origin="/clearance", name=clearance, plot_legend=_no_legend()))
            shares.append(2.0)
        return rrb.Blueprint(
            rrb.Horizontal(space, rrb.Vertical(*over_time, row_shares=shares), column_shares=[3, 2]),
            rrb.TimePanel(timeline=TIME, state="collapsed", play_state="playing", loop_mode="all"),
            rrb.SelectionPanel(state="hidden"),
            rrb.BlueprintPanel(state="collapsed"),
        )

    def _camera(self) -> Any:
        """From beside the targets in space, from above in the plane; arm and ways are in sight."""
        import rerun.blueprint as rrb

        seen = np.concatenate([self.tools, self.targets, np.zeros((1, 3))])
        centre, size = 0.5 * (seen.min(0) + seen.max(0)), float(np.linalg.norm(np.ptp(seen, axis=0))) + 0.3
        flat = self.log.roadmap.task.dimension == 2
        middle = self.tools.mean(0)
        azimuth = float(np.arctan2(middle[1], middle[0])) - 0.9
        side = np.array([0.0, -0.02, 1.0] if flat else [np.cos(azimuth), np.sin(azimuth), 0.55])
        eye = centre + 0.95 * size * side / np.linalg.norm(side)
        return rrb.EyeControls3D(position=eye, look_target=centre, eye_up=(0, 1, 0) if flat else (0, 0, 1))


def status_colours(status: np.ndarray) -> Colours:
    """Colours (T, 3) of statuses (T,)."""
    table = np.array([colours.STATUS[name] for name in STATUSES.tolist()], dtype=np.uint8)
    return table[[STATUSES.tolist().index(name) for name in status.tolist()]]


def _spaced(places: np.ndarray) -> np.ndarray:
    """Indices of places (T, 3) of which each is at least a little way from the one before; the last one is in."""
    travelled = np.concatenate([[0.0], np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()])
    kept = np.flatnonzero(np.diff(np.floor(travelled / _SHORTEST), prepend=-1.0))
    return np.unique(np.append(kept, len(places) - 1))


def _so_far() -> Any:
    import rerun.blueprint as rrb

    boundary = rrb.TimeRangeBoundary
    return rrb.VisibleTimeRange(TIME, start=boundary.infinite(), end=boundary.cursor_relative(seconds=0.0))


def _no_legend() -> Any:
    import rerun.blueprint as rrb

    return rrb.PlotLegend(visible=False)
