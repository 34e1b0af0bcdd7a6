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
from grr_torch.recording.colours import Colours
from grr_torch.recording.robot import RecordedRobot
from grr_torch.recording.self_motion_view import (
    CHART,
    JOINTS,
    MOTION,
    SPACE,
    blueprint,
    in_space,
    joint_places,
    line,
    palette,
    title,
)
from grr_torch.recording.walk import walk
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance

_RATE = 25.0
# arms drawn in all, and at least of a component
_GHOSTS, _LEAST = 48, 5


def record_self_motion(
    manifolds: Sequence[SelfMotionManifold],
    path: str | os.PathLike[str],
    choices: Sequence[Tensor | None] = (),
    roadmap: Roadmap | None = None,
) -> None:
    """Writes a recording (.rrd) of the self-motion manifolds of one or more points, by an atomic rename.

    One manifold: ghost arms and the elbow's traces, a colour a component. Several: a colour a point, and the roadmap
    behind them. On the timeline `self_motion` the arm runs through every component while its tool stays. Entities:
    `space/…` in metres; `configuration_space/…` with joints as axes: large dots are ends at joint limits, red ones
    samples in self-collision; `joints/…` as curves over time.

    Args:
        manifolds: The manifolds, all of one robot and task.
        path: The file.
        choices: For each manifold the configuration (n,) that a roadmap has there, or None.
        roadmap: Drawn behind several manifolds.

    Raises:
        ParameterError: There is no manifold, they are of different robots, or there are not as many choices.
        OutputError: It cannot be written.
    """
    import rerun as rr

    if not manifolds or any(manifold.robot is not manifolds[0].robot for manifold in manifolds):
        raise ParameterError("manifolds", len(manifolds), "one or more, all of one robot")
    if choices and len(choices) != len(manifolds):
        raise ParameterError("choices", len(choices), f"{len(manifolds)}, one for each manifold")
    scene = _Scene(tuple(manifolds), tuple(choices or [None] * len(manifolds)), roadmap)
    with atomic_write(path) as temporary:
        recording = rr.RecordingStream("grr_torch")
        recording.save(str(temporary), default_blueprint=scene.blueprint())
        with recording:
            scene.log(recording)
        recording.disconnect()


@dataclass(frozen=True)
class _Scene:
    """What is drawn: manifolds, a configuration or None for each, and perhaps a roadmap behind them."""

    manifolds: tuple[SelfMotionManifold, ...]
    choices: tuple[Tensor | None, ...]
    roadmap: Roadmap | None

    @property
    def robot(self) -> Robot:
        return self.manifolds[0].robot

    @property
    def several(self) -> bool:
        return len(self.manifolds) > 1

    @cached_property
    def chart(self) -> Chart:
        return Chart.of(self.manifolds)

    @cached_property
    def points(self) -> np.ndarray:
        """(P, 3) the points."""
        d = self.manifolds[0].task.dimension
        return in_space(torch.stack([manifold.point[:d] for manifold in self.manifolds]).numpy())

    @cached_property
    def hues(self) -> list[Colours]:
        """For each manifold the colours (C, 3) of its components."""
        counts = [manifold.components for manifold in self.manifolds]
        if not self.several:
            return [palette(counts[0])]
        return [np.repeat(hue[None], count, axis=0) for hue, count in zip(palette(len(counts)), counts, strict=True)]

    def log(self, recording: Any) -> None:
        robot = RecordedRobot(recording, self.robot)
        for number, manifold in enumerate(self.manifolds):
            for component in range(manifold.components):
                self._log_component(recording, number, component)
                if not self.several:
                    self._log_ghosts(recording, component)
        self._log_frame(recording)
        if any(choice is not None for choice in self.choices):
            self._log_choices(recording)
        if self.several and self.roadmap is not None:
            self._log_roadmap(recording, self.roadmap)
        self._log_motion(recording, robot)

    def _log_component(self, recording: Any, number: int, component: int) -> None:
        """Samples and edges of a component in configuration space."""
        import rerun as rr

        manifold, hue = self.manifolds[number], self.hues[number][component]
        entity = f"{CHART}/point_{number + 1}/component_{component + 1}"
        inside = manifold.component == component
        q, free = manifold.configurations[inside], manifold.free[inside]
        a, b = manifold.configurations[manifold.edges[inside[manifold.edges[:, 0]]]].unbind(1)
        lines = self.chart.segments(a, b, component)
        if manifold.ends is None:
            recording.log(
                f"{entity}/edges", rr.LineStrips3D(lines, colors=(*hue.tolist(), 40), radii=line(0.3)), static=True
            )
            recording.log(
                f"{entity}/samples",
                rr.Points3D(self.chart.place(q, component), colors=hue, radii=line(1.6)),
                static=True,
            )
        else:
            recording.log(f"{entity}/curve", rr.LineStrips3D(lines, colors=hue, radii=line(2.4)), static=True)
            if not bool(manifold.closed[component]):
                tips = rr.Points3D(self.chart.place(q[[0, -1]], component), colors=hue, radii=line(5.0))
                recording.log(f"{entity}/ends", tips, static=True)
        if not bool(free.all()):
            hit = rr.Points3D(self.chart.place(q[~free], component), colors=colours.BROKEN, radii=line(3.2))
            recording.log(f"{entity}/self_collision", hit, static=True)

    def _log_ghosts(self, recording: Any, component: int) -> None:
        """Arms of the one manifold as lines through their joints, and the way of the joint that moves most."""
        import rerun as rr

        manifold, hue = self.manifolds[0], self.hues[0][component]
        q = manifold.configurations[manifold.component == component]
        count = min(len(q), max(_LEAST, _GHOSTS // manifold.components))
        ghosts = joint_places(self.robot, q[np.linspace(0, len(q) - 1, count).round().astype(int)])
        base = rr.CoordinateFrame(self.robot.base)
        entity = f"{SPACE}/component_{component + 1}"
        recording.log(f"{entity}/arms", base, rr.LineStrips3D(ghosts, colors=hue, radii=line(1.4)), static=True)
        if manifold.ends is not None:
            ways = joint_places(self.robot, manifold.curve(component))
            elbow = int(np.ptp(ways, axis=0).max(1).argmax())
            way = rr.LineStrips3D([ways[:, elbow]], colors=hue, radii=line(3.0))
            recording.log(f"{entity}/elbow", base, way, static=True)

    def _log_frame(self, recording: Any) -> None:
        """The points, and a box with the names of its axes around configuration space."""
        import rerun as rr

        shades = np.stack([hues[0] for hues in self.hues]) if self.several else np.array([[255, 255, 255]])
        labels = [f"p{k + 1}" for k in range(len(self.points))] if self.several else ["p"]
        dots = rr.Points3D(self.points, colors=shades, radii=line(7.0), labels=labels, show_labels=True)
        recording.log(f"{SPACE}/points", rr.CoordinateFrame(self.robot.base), dots, static=True)
        low, high = self.chart.low, self.chart.high
        box = rr.Boxes3D(
            mins=[low], sizes=[high - low], colors=(70, 76, 88), radii=line(0.6), fill_mode="MajorWireframe"
        )
        recording.log(f"{CHART}/box", box, static=True)
        middles = np.where(np.eye(3, dtype=bool), 0.5 * (low + high), low)
        names = [
            f"{name} {a:.1f} … {b:.1f}"
            for name, a, b in zip(self.chart.names, low.tolist(), high.tolist(), strict=True)
        ]
        axes = rr.Points3D(middles, colors=(150, 158, 170), radii=line(0.1), labels=names, show_labels=True)
        recording.log(f"{CHART}/axes", axes, static=True)

    def _log_choices(self, recording: Any) -> None:
        """What a roadmap has at the points, and lines between those that the continuity check joins."""
        import rerun as rr

        numbers = [number for number, choice in enumerate(self.choices) if choice is not None]
        q = torch.stack([choice for choice in self.choices if choice is not None])
        labels = [f"q{number + 1}" for number in numbers] if self.several else ["the roadmap's choice"]
        hues = np.stack([self.hues[number][0] for number in numbers]) if self.several else (255, 255, 255)
        shown = [self.chart.place(q[k : k + 1], self._order(number)[0]) for k, number in enumerate(numbers)]
        dots = rr.Points3D(np.concatenate(shown), colors=hues, radii=line(7.0), labels=labels, show_labels=True)
        recording.log(f"{CHART}/roadmap/choices", dots, static=True)
        base = rr.CoordinateFrame(self.robot.base)
        places = joint_places(self.robot, q)
        recording.log(f"{SPACE}/choices", base, rr.LineStrips3D(places, colors=hues, radii=line(4.0)), static=True)
        knees = rr.Points3D(places.reshape(-1, 3), colors=(255, 255, 255), radii=line(4.5))
        recording.log(f"{SPACE}/choices/joints", base, knees, static=True)
        first, second = self._neighbours(numbers, q)
        chart = rr.LineStrips3D(self.chart.segments(q[first], q[second], 0), colors=colours.TOUR, radii=line(2.5))
        recording.log(f"{CHART}/roadmap/path", chart, static=True)
        points = self.points[np.array(numbers)]
        lines = np.stack([points[first.numpy()], points[second.numpy()]], axis=1)
        path = rr.LineStrips3D(lines, colors=colours.TOUR, radii=line(2.5))
        recording.log(f"{SPACE}/path", base, path, static=True)

    def _neighbours(self, numbers: list[int], q: Tensor) -> tuple[Tensor, Tensor]:
        """Pairs of choices q (K, n) that connect: each and the next, and of three also the last and the first."""
        first = torch.arange(len(numbers) if len(numbers) == 3 else len(numbers) - 1)
        second = (first + 1) % len(numbers)
        p = torch.stack([self.manifolds[number].point for number in numbers])
        ends = p[first], p[second], q[first], q[second]
        connected = is_continuous(self.robot, self.manifolds[0].task, *ends).cpu()
        return first[connected], second[connected]

    def _log_roadmap(self, recording: Any, roadmap: Roadmap) -> None:
        """The connected edges of a roadmap, thin: in space, and in configuration space."""
        import rerun as rr

        edges = roadmap.edges[roadmap.connected]
        points = in_space(roadmap.points[:, : roadmap.task.dimension].numpy())
        # in space they would hide the arms
        shade, width = (colours.CONNECTED, 0.7) if roadmap.task.dimension == 2 else (colours.GRID, 0.3)
        grid = rr.LineStrips3D(points[edges.numpy()], colors=shade, radii=line(width))
        recording.log(f"{SPACE}/roadmap", rr.CoordinateFrame(self.robot.base), grid, static=True)
        lines = self.chart.segments(roadmap.configurations[edges[:, 0]], roadmap.configurations[edges[:, 1]], 0)
        mesh = rr.LineStrips3D(lines, colors=(84, 94, 112), radii=line(0.6))
        recording.log(f"{CHART}/roadmap/edges", mesh, static=True)

    def _log_motion(self, recording: Any, robot: RecordedRobot) -> None:
        """The arm running through all components, a dot where it is in configuration space, and its joints."""
        import rerun as rr

        order = [(number, component) for number in range(len(self.manifolds)) for component in self._order(number)]
        parts = [walk(self.manifolds[number], component, self.choices[number]) for number, component in order]
        q = torch.cat(parts)
        times = rr.TimeColumn(MOTION, duration=np.arange(len(q)) / _RATE)
        robot.animate(times, q.numpy())
        dots = rr.Points3D.columns(
            positions=np.concatenate(
                [self.chart.place(part, component) for part, (_, component) in zip(parts, order, strict=True)]
            ),
            colors=[(255, 255, 255)] * len(q),
            radii=[line(5.0)] * len(q),
        )
        recording.send_columns(f"{CHART}/arm", indexes=[times], columns=dots)
        lengths, values = [len(part) for part in parts], q.numpy().copy()
        # lines end with their component
        values[np.cumsum(lengths) - 1] = np.nan
        for index, (name, hue) in enumerate(zip(self.robot.joint_names, palette(self.robot.n), strict=True)):
            recording.log(f"{JOINTS}/{name}", rr.SeriesLines(names=name, colors=hue), static=True)
            scalars = rr.Scalars.columns(scalars=values[:, index])
            recording.send_columns(f"{JOINTS}/{name}", indexes=[times], columns=scalars)
        # a band in the colours of the components
        shade = np.repeat(np.stack([self.hues[number][component] for number, component in order]), lengths, axis=0)
        recording.log(
            f"{JOINTS}/component", rr.SeriesPoints(names="component", markers="square", marker_sizes=4.0), static=True
        )
        columns = [
            *rr.Scalars.columns(scalars=np.full(len(q), float(np.nanmin(values)) - 0.7)),
            *rr.SeriesPoints.columns(colors=shade),
        ]
        recording.send_columns(f"{JOINTS}/component", indexes=[times], columns=columns)

    def _order(self, number: int) -> list[int]:
        """Components of a manifold, the one nearest to its choice first."""
        manifold, choice = self.manifolds[number], self.choices[number]
        order = list(range(manifold.components))
        if choice is None:
            return order
        nearest = distance(manifold.configurations, choice, self.robot.continuous.cpu()).argmin()
        return sorted(order, key=lambda component: component != int(manifold.component[nearest]))

    def blueprint(self) -> Any:
        chosen = [choice[None] for choice in self.choices if choice is not None]
        drawn = chosen if self.several and chosen else [manifold.configurations for manifold in self.manifolds]
        arms = joint_places(self.robot, torch.cat(drawn)).reshape(-1, 3)
        curves = np.concatenate(
            [
                self.chart.place(manifold.configurations[manifold.component == component], component)
                for manifold in self.manifolds
                for component in range(manifold.components)
            ]
        )
        flat = self.manifolds[0].task.dimension == 2
        return blueprint(self.robot.base, title(self.manifolds), arms, self.points, self.chart, curves, flat)
