"""How recordings of self-motion manifolds are shown: what stands where, and from which side it is seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from grr_torch.applications.self_motion import SelfMotionManifold
from grr_torch.recording import colours
from grr_torch.recording.chart import Chart
from grr_torch.recording.colours import Colours
from grr_torch.robots.robot import Robot

SPACE, CHART, JOINTS = "space", "configuration_space", "joints"
MOTION = "self_motion"
_DARK = (18, 20, 26)


def blueprint(
    base: str, name: str, arms: np.ndarray, points: np.ndarray, chart: Chart, curves: np.ndarray, flat: bool
) -> Any:
    """Arms on the left; configuration space on the right, and for one point the joints below it.

    Args:
        base: The frame of the robot's base.
        name: What is seen on the left.
        arms: (K, 3) positions that are to be in sight.
        points: (P, 3) the points of the task space.
        chart: The axes of configuration space.
        curves: (S, 3) where the samples are on it.
        flat: Whether the task is in the plane.
    """
    import rerun.blueprint as rrb

    azimuth = float(np.arctan2(points[0, 1], points[0, 0])) - 1.15
    side = np.array([0.0, -0.02, 1.0] if flat else [np.cos(azimuth), np.sin(azimuth), 0.3])
    several = len(points) > 1
    space = rrb.Spatial3DView(
        origin="/",
        contents=["+ /robot/**", f"+ /{SPACE}/**"],
        name=name,
        spatial_information=rrb.SpatialInformation(target_frame=base, show_axes=False),
        eye_controls=_camera(arms.min(0), arms.max(0), side, flat, 1.0 if flat else 0.85),
        line_grid=False,
        background=_DARK,
    )
    axes = ", ".join(chart.names)
    space_of_joints = rrb.Spatial3DView(
        origin=f"/{CHART}",
        name=f"configuration space ({axes}): a colour for each {'point' if several else 'component'}",
        eye_controls=_camera(chart.low, chart.high, _side_of(curves, 0.9 if several else 0.45), False, 1.0),
        line_grid=False,
        background=_DARK,
    )
    joints = rrb.TimeSeriesView(
        origin=f"/{JOINTS}",
        name="joints as the arm runs through the components [rad or m]",
        plot_legend=rrb.PlotLegend(corner="RightBottom"),
    )
    right = space_of_joints if several else rrb.Vertical(space_of_joints, joints, row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(space, right, column_shares=[1, 1]),
        rrb.TimePanel(timeline=MOTION, state="collapsed", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def title(manifolds: Sequence[SelfMotionManifold]) -> str:
    """What is seen in space."""
    name, first = manifolds[0].robot.name, manifolds[0]
    if len(manifolds) > 1:
        return f"{name}, task space: {len(manifolds)} points and the roadmap's arm at each"
    place = ", ".join(f"{value:.3g}" for value in first.point.tolist())
    families = f"{first.components} families of configurations" if first.components > 1 else "all configurations"
    return f"{name}: {families} with the tool at ({place})"


def _side_of(points: np.ndarray, tilt: float) -> np.ndarray:
    """The direction from which points (S, 3) cover each other least, tilted to the side and up."""
    directions = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    side: np.ndarray = directions[-1] * np.sign(directions[-1, 0] + 0.3 * directions[-1, 1] + 1e-9)
    side = np.array([*side[:2] / max(float(np.linalg.norm(side[:2])), 0.2), 0.0])
    turn = np.array([-side[1], side[0], 0.0])
    return side + tilt * (turn + np.array([0.0, 0.0, 1.0]))


def _camera(low: np.ndarray, high: np.ndarray, direction: np.ndarray, flat: bool, far: float) -> Any:
    import rerun.blueprint as rrb

    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = centre + far * size * direction / np.linalg.norm(direction)
    return rrb.EyeControls3D(position=eye, look_target=centre, eye_up=(0, 1, 0) if flat else (0, 0, 1))


def joint_places(robot: Robot, configurations: Tensor) -> np.ndarray:
    """Where the base, the joints and the tool are [m]: (K, L, 3) for configurations (K, n)."""
    poses = robot.link_poses(configurations)
    links = [robot.base, *(joint.child for joint in robot.urdf.path(robot.base, robot.tool))]
    return np.stack([poses[link][:, :3, 3].cpu().numpy() for link in links], axis=1)


def in_space(points: np.ndarray) -> np.ndarray:
    """Points (V, 3); those of the plane at z = 0."""
    return np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])


def palette(count: int) -> Colours:
    """(count, 3) colours all round."""
    return colours.circle(2.0 * np.pi * np.arange(count) / max(count, 1))


def line(width: float) -> Any:
    """Width in points of the screen."""
    import rerun as rr

    return rr.components.Radius.ui_points(width)
