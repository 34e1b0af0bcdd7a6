"""What `eval-ik` and `bench learning` print of a network."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from grr_torch.experiments.learning import WarmStart
    from grr_torch.learning.evaluate import Evaluation, Statistics

ERROR_HEAD = ["Newton steps", "position [mm]: mean, median, 95 %, 99 %, largest", "rotation [°]", "within 0.1 mm, 0.1°"]
WARM_HEAD = ["exact solutions of held-out points", "valid", "points / s", "from the map [rad], median"]


def error_rows(evaluation: Evaluation) -> list[list[str]]:
    """A row for each number of Newton steps."""
    return [
        [
            str(errors.steps),
            statistics(errors.millimetres),
            statistics(errors.degrees),
            f"{100.0 * errors.exact:.2f} %",
        ]
        for errors in evaluation.errors
    ]


def figure_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """The other figures."""
    network, roadmap = evaluation.continuity, evaluation.roadmap
    return [
        (
            "largest joint step over 1 cm of lines",
            f"{network.step:.3f} rad, 99.9 % below {network.p999:.3f}; the roadmap's own {roadmap.step:.3f} and "
            f"{roadmap.p999:.3f} ({network.step / roadmap.step:.2f}×)",
        ),
        (
            "joints after closed loops",
            f"{network.closure:.2g} rad from where they began; by Newton steps {evaluation.newton_closure:.2g}",
        ),
        ("beyond joint limits", f"{100.0 * evaluation.beyond_limits:.3f} %"),
        ("in self-collision", f"{100.0 * evaluation.in_self_collision:.3f} %"),
        ("from the roadmap's configurations", f"{evaluation.from_map:.4f} rad, largest joint, mean"),
        ("poses / s in a batch", f"{evaluation.poses_per_second:,.0f}"),
        ("one pose", f"{1e3 * evaluation.one_pose:.3f} ms"),
    ]


def warm_rows(rows: list[WarmStart]) -> list[list[str]]:
    """A row for each way of solving."""
    return [
        [row.method, f"{100.0 * row.valid:.2f} %", f"{row.points_per_second:,.0f}", f"{row.from_map:.4f}"]
        for row in rows
    ]


def statistics(values: Statistics) -> str:
    """Mean, median, 95 %, 99 % and largest."""
    figures = (values.mean, values.median, values.p95, values.p99, values.largest)
    return ", ".join(f"{figure:.3g}" for figure in figures)
