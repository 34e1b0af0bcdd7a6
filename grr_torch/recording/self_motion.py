"""Recording self-motion manifolds with rerun: arms at them, their curves in configuration space, joints along them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.self_motion import SelfMotionManifold
from grr_torch.errors import ParameterError
from grr_torch.output import atomic_write
from grr_torch.projection.continuity import is_continuous
from grr_torch.recording import colours
from grr_torch.recording.chart import Chart
from grr_torch.recording.ghosts import log_ghosts
from grr_torch.recording.robot import RecordedRobot
from grr_torch.recording.walk import walk
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance

MOTION = "self_motion"
_RATE = 25.0
# ghosts in all, and at least of a component
_GHOSTS, _LEAST = 24, 2
_SPACE, _CHART = "space", "configuration_space"


def record_self_motion(
    manifolds: Sequence[SelfMotionManifold],
    path: str | os.PathLike[str],
    roadmap: Roadmap | None = None,
    choices: Sequence[Tensor | None] | None = None,
) -> None:
    """Writes a recording (.rrd) of the self-motion manifolds of one or more points, by an atomic rename.

    One manifold: ghost arms, a colour a component. Several: a colour a point, and the roadmap behind them. On the
    timeline `self_motion` the arm runs through every component while its tool stays. Entities: `space/…` in metres,
    `configuration_space/…` on the axes of the joints or of their principal directions, `joints/…` as curves.

    Args:
        manifolds: The manifolds, all of one robot and task.
        path: The file.
        roadmap: Drawn behind several manifolds.
        choices: For each manifold the configuration (n,) that a roadmap has there, or None.

    Raises:
        ParameterError: There is no manifold, or they are of different robots.
        OutputError: It cannot be written.
    """
    import rerun as rr

    if not manifolds or any(manifold.robot is not manifolds[0].robot for manifold in manifolds):
        raise ParameterError("manifolds", len(manifolds), "one or more, all of one robot")
    scene = _Scene(tuple(manifolds), tuple(choices or [None] * len(manifolds)), roadmap)
    with atomic_write(path) as temporary:
        recording = rr.RecordingStream("grr_torch")
        recording.save(str(temporary), default_blueprint=scene.blueprint())
        with recording:
            scene.log(recording)
        recording.disconnect()


@dataclass(frozen=True)
class _Scene:
    """What is drawn.

    Attributes:
        manifolds: The manifolds.
        choices: A configuration for each, or None.
        roadmap: Drawn behind several manifolds.
    """

    manifolds: tuple[SelfMotionManifold, ...]
    choices: tuple[Tensor | None, ...]
    roadmap: Roadmap | None

    @property
    def robot(self) -> Robot:
        return self.manifolds[0].robot

    @cached_property
    def chart(self) -> Chart:
        return Chart.of(self.robot, torch.cat([manifold.configurations for manifold in self.manifolds]))

    @cached_property
    def points(self) -> np.ndarray:
        """(P, 3) positions of the points; those of the plane at z = 0."""
        d = self.manifolds[0].task.dimension
        rows = torch.stack([manifold.point[:d] for manifold in self.manifolds]).numpy()
        return np.column_stack([rows, np.zeros((len(rows), 3 - d))])

    @cached_property
    def chosen(self) -> list[tuple[int, Tensor]]:
        """The manifolds that have a chosen configuration, and it."""
        return [(number, q) for number, q in enumerate(self.choices) if q is not None]

    def hues(self) -> list[np.ndarray]:
        """For each manifold a colour (3,) for each component."""
        counts = [manifold.components for manifold in self.manifolds]
        if len(counts) == 1:
            return [_hues(counts[0])]
        return [np.repeat(hue[None], count, axis=0) for hue, count in zip(_hues(len(counts)), counts, strict=True)]

    def log(self, recording: Any) -> None:
        robot = RecordedRobot(recording, self.robot)
        for number, (manifold, hues) in enumerate(zip(self.manifolds, self.hues(), strict=True)):
            for component, hue in enumerate(hues):
                self._log_component(recording, number, manifold, component, hue)
        self._log_space(recording)
        self._log_box(recording)
        if self.chosen:
            self._log_choices(recording)
        if self.roadmap is not None and len(self.manifolds) > 1:
            self._log_roadmap(recording, self.roadmap)
        self._log_motion(recording, robot)

    def _log_component(
        self, recording: Any, number: int, manifold: SelfMotionManifold, component: int, hue: np.ndarray
    ) -> None:
        """Its samples and edges in configuration space, and ghost arms."""
        import rerun as rr

        name = f"point_{number + 1}/component_{component + 1}"
        inside = manifold.component == component
        q = manifold.configurations[inside]
        a, b = manifold.edges[inside[manifold.edges[:, 0]]].T
        lines = self.chart.segments(manifold.configurations[a], manifold.configurations[b])
        curve = manifold.ends is not None
        shade = (*hue.tolist(), 255 if curve else 60)
        width = _line(2.2 if curve else 0.4)
        recording.log(f"{_CHART}/{name}", rr.LineStrips3D(lines, colors=shade, radii=width), static=True)
        if not curve:
            dots = rr.Points3D(self.chart.place(q), colors=hue, radii=_line(1.6))
            recording.log(f"{_CHART}/{name}/samples", dots, static=True)
        hit = q[~manifold.free[inside]]
        if len(hit):
            dots = rr.Points3D(self.chart.place(hit), colors=colours.BROKEN, radii=_line(3.2))
            recording.log(f"{_CHART}/{name}/self_collision", dots, static=True)
        if curve and not bool(manifold.closed[component]):
            tips = rr.Points3D(self.chart.place(q[[0, -1]]), colors=hue, radii=_line(5.0))
            recording.log(f"{_CHART}/{name}/ends", tips, static=True)
        if len(self.manifolds) == 1:
            count = max(_LEAST, _GHOSTS // manifold.components)
            shown = q[np.linspace(0, len(q) - 1, count + 2).round().astype(int)[1:-1]]
            log_ghosts(recording, self.robot, f"{_SPACE}/ghosts/{name}", shown, (*hue.tolist(), 70))

    def _log_space(self, recording: Any) -> None:
        """The points."""
        import rerun as rr

        several = len(self.points) > 1
        hues = np.stack([hues[0] for hues in self.hues()]) if several else colours.TOUR
        labels = [f"p{k + 1}" for k in range(len(self.points))] if several else ["p"]
        recording.log(
            f"{_SPACE}/points",
            rr.CoordinateFrame(self.robot.base),
            rr.Points3D(self.points, colors=hues, radii=_line(7.0), labels=labels, show_labels=True),
            static=True,
        )

    def _log_box(self, recording: Any) -> None:
        """A box around what is shown in configuration space, with the names of its axes."""
        import rerun as rr

        low, high = self._box()
        recording.log(
            f"{_CHART}/box",
            rr.Boxes3D(mins=[low], sizes=[high - low], colors=(70, 76, 88, 255), radii=_line(0.5)),
            static=True,
        )
        middles = np.array([np.where(np.arange(3) == k, 0.5 * (low + high), low) for k in range(3)])
        names = rr.Points3D(middles, colors=(70, 76, 88, 255), radii=_line(0.1), labels=self.chart.names)
        recording.log(f"{_CHART}/axes", names, static=True)

    def _log_choices(self, recording: Any) -> None:
        """What the roadmap has at the points, and lines between neighbours that the continuity check lets pass."""
        import rerun as rr

        several = len(self.manifolds) > 1
        numbers, q = [number for number, _ in self.chosen], torch.stack([q for _, q in self.chosen])
        labels = [f"q{number + 1}" for number in numbers] if several else ["the roadmap's choice"]
        dots = rr.Points3D(self.chart.place(q), colors=(255, 255, 255), radii=_line(6.0), labels=labels, show_labels=True)
        recording.log(f"{_CHART}/roadmap/choices", dots, static=True)
        hues = self.hues()
        for number, configuration in self.chosen:
            hue = hues[number][0] if several else np.array(colours.TOUR[:3])
            entity = f"{_SPACE}/choices/point_{number + 1}"
            log_ghosts(recording, self.robot, entity, configuration[None], (*hue.tolist(), 255))
        first, second = self._neighbours()
        if len(first):
            chart = rr.LineStrips3D(self.chart.segments(q[first], q[second]), colors=colours.TOUR, radii=_line(2.5))
            recording.log(f"{_CHART}/roadmap/path", chart, static=True)
            lines = np.stack([self.points[np.array(numbers)[side]] for side in (first, second)], axis=1)
            path = rr.LineStrips3D(lines, colors=colours.TOUR, radii=_line(2.5))
            recording.log(f"{_SPACE}/path", rr.CoordinateFrame(self.robot.base), path, static=True)

    def _neighbours(self) -> tuple[Tensor, Tensor]:
        """Pairs of chosen configurations, one after the other (of three, also the last and the first), that connect."""
        count = len(self.chosen)
        first = torch.arange(count if count == 3 else max(count - 1, 0))
        second = (first + 1) % max(count, 1)
        if len(first) == 0:
            return first, second
        p = torch.stack([self.manifolds[number].point for number, _ in self.chosen])
        q = torch.stack([q for _, q in self.chosen])
        ends = p[first], p[second], q[first], q[second]
        connected = is_continuous(self.robot, self.manifolds[0].task, *ends).cpu()
        return first[connected], second[connected]

    def _log_roadmap(self, recording: Any, roadmap: Roadmap) -> None:
        """The task graph in space, and the roadmap's edges in configuration space, thin."""
        import rerun as rr

        points = roadmap.points[:, : roadmap.task.dimension].numpy()
        points = np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])
        a, b = roadmap.edges[roadmap.connected].T
        frame = rr.CoordinateFrame(self.robot.base)
        grid = rr.LineStrips3D(points[roadmap.edges[roadmap.connected].numpy()], colors=colours.CONNECTED, radii=_line(0.6))
        recording.log(f"{_SPACE}/roadmap", frame, grid, static=True)
        lines = self.chart.segments(roadmap.configurations[a], roadmap.configurations[b])
        mesh = rr.LineStrips3D(lines, colors=(120, 130, 150, 60), radii=_line(0.5))
        recording.log(f"{_CHART}/roadmap/edges", mesh, static=True)

    def _log_motion(self, recording: Any, robot: RecordedRobot) -> None:
        """The arm running through all components, a dot where it is in configuration space, and its joints."""
        import rerun as rr

        parts = [
            walk(manifold, component, choice)
            for manifold, choice in zip(self.manifolds, self.choices, strict=True)
            for component in _order(manifold, choice)
        ]
        q = torch.cat(parts)
        times = rr.TimeColumn(MOTION, duration=np.arange(len(q)) / _RATE)
        robot.animate(times, q.numpy())
        dots = rr.Points3D.columns(
            positions=self.chart.place(q), colors=[(255, 255, 255)] * len(q), radii=[_line(8.0)] * len(q)
        )
        recording.send_columns(f"{_CHART}/arm", indexes=[times], columns=dots)
        # curves end with their component
        last = np.cumsum([len(part) for part in parts]) - 1
        values = q.numpy().copy()
        values[last] = np.nan
        for index, (name, hue) in enumerate(zip(self.robot.joint_names, _hues(self.robot.n), strict=True)):
            recording.log(f"joints/{name}", rr.SeriesLines(names=name, colors=hue), static=True)
            columns = rr.Scalars.columns(scalars=values[:, index])
            recording.send_columns(f"joints/{name}", indexes=[times], columns=columns)

    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        shown = np.concatenate([self.chart.place(manifold.configurations) for manifold in self.manifolds])
        margin = 0.06 * float(np.ptp(shown, axis=0).max()) + 1e-3
        return shown.min(0) - margin, shown.max(0) + margin

    def blueprint(self) -> Any:
        """Arms on the left; configuration space, and for one point the joints, on the right."""
        import rerun.blueprint as rrb

        manifold, several = self.manifolds[0], len(self.manifolds) > 1
        dark = (18, 20, 26)
        robot = [] if several and self.chosen else ["+ /robot/**"]
        flat = manifold.task.dimension == 2
        space = rrb.Spatial3DView(
            origin="/",
            contents=[*robot, f"+ /{_SPACE}/**"],
            name=self._title(),
            spatial_information=rrb.SpatialInformation(target_frame=self.robot.base, show_axes=False),
            eye_controls=_camera(*self._extent(), (0.0, -0.02, 1.0) if flat else (0.9, -0.5, 0.35), flat, 1.25),
            line_grid=False,
            background=dark,
        )
        chart = rrb.Spatial3DView(
            origin=f"/{_CHART}",
            name="configuration space: " + ("a curve for each point" if several else "a colour for each component"),
            eye_controls=_camera(*self._box(), (0.75, -1.0, 0.55), False, 1.25),
            line_grid=False,
            background=dark,
        )
        joints = rrb.TimeSeriesView(origin="/joints", name="joints along the components [rad]")
        right = chart if several else rrb.Vertical(chart, joints, row_shares=[3, 2])
        return rrb.Blueprint(
            rrb.Horizontal(space, right, column_shares=[1, 1] if several else [5, 4]),
            rrb.TimePanel(timeline=MOTION, state="collapsed", play_state="playing", loop_mode="all"),
            rrb.SelectionPanel(state="hidden"),
            rrb.BlueprintPanel(state="collapsed"),
        )

    def _title(self) -> str:
        manifold = self.manifolds[0]
        if len(self.manifolds) > 1:
            return f"task space: {len(self.manifolds)} points, and the arm that the roadmap has there"
        place = ", ".join(f"{value:.3g}" for value in manifold.point.tolist())
        count = manifold.components
        return f"{self.robot.name}: {count} component{'s' if count > 1 else ''} with the tool at ({place})"

    def _extent(self) -> tuple[np.ndarray, np.ndarray]:
        """A box that holds the arm wherever it is drawn."""
        q = torch.cat([manifold.configurations[:: max(1, len(manifold.configurations) // 50)] for manifold in self.manifolds])
        if len(self.manifolds) > 1 and self.chosen:
            q = torch.stack([choice for _, choice in self.chosen])
        poses = self.robot.link_poses(q)
        places = np.concatenate([pose[:, :3, 3].cpu().numpy() for pose in poses.values()])
        return places.min(0), places.max(0)


def _order(manifold: SelfMotionManifold, choice: Tensor | None) -> list[int]:
    """Components, the one of the choice first."""
    order = list(range(manifold.components))
    if choice is None:
        return order
    nearest = distance(manifold.configurations, choice, manifold.robot.continuous.cpu()).argmin()
    first = int(manifold.component[nearest])
    return [first, *(component for component in order if component != first)]


def _camera(low: np.ndarray, high: np.ndarray, direction: Sequence[float], flat: bool, far: float) -> Any:
    import rerun.blueprint as rrb

    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = centre + far * size * np.array(direction) / np.linalg.norm(direction)
    return rrb.EyeControls3D(position=eye, look_target=centre, eye_up=(0, 1, 0) if flat else (0, 0, 1))


def _hues(count: int) -> np.ndarray:
    """(count, 3) colours all round."""
    return colours.circle(2.0 * np.pi * np.arange(count) / max(count, 1))


def _line(width: float) -> Any:
    """Widths in points of the screen."""
    import rerun as rr

    return rr.components.Radius.ui_points(width)
