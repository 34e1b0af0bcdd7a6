"""What recordings of moving arms show over time: joints, and the clearance of self-collision."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from grr_torch.recording.self_motion_view import palette
from grr_torch.robots.robot import Robot

_CLEARANCE = (120, 220, 150)


def log_curves(recording: Any, timeline: Any, robot: Robot, configurations: Tensor) -> None:
    """Logs `joints/…` [rad or m] and `clearance` [mm], the latter beyond the margin, if there is a sphere model.

    Args:
        recording: A rerun recording.
        timeline: A rerun time column of T times.
        robot: The robot.
        configurations: (T, n), unwrapped.
    """
    import rerun as rr

    hues = palette(robot.n)
    curves = [(f"joints/{name}", name, hues[k], configurations[:, k]) for k, name in enumerate(robot.joint_names)]
    if robot.spheres is not None:
        clearance = 1e3 * (robot.self_collision_distance(configurations) - robot.margin)
        curves.append(("clearance", "clearance", _CLEARANCE, clearance))
    for entity, name, hue, values in curves:
        recording.log(entity, rr.SeriesLines(names=name, colors=hue, widths=1.5), static=True)
        recording.send_columns(entity, indexes=[timeline], columns=rr.Scalars.columns(scalars=values.cpu().numpy()))


def curve_views(robot: Robot) -> tuple[list[Any], list[float]]:
    """Views of what `log_curves` logs, from top to bottom, and how high each is beside the others."""
    import rerun.blueprint as rrb

    joints = rrb.TimeSeriesView(origin="/joints", name="joints, unwrapped [rad or m]")
    if robot.spheres is None:
        return [joints], [4.0]
    name = "clearance of self-collision beyond the margin [mm]"
    clearance = rrb.TimeSeriesView(origin="/clearance", name=name, plot_legend=rrb.PlotLegend(visible=False))
    return [joints, clearance], [4.0, 2.0]
