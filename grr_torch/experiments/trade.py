"""What secondary objectives cost: a roadmap refined with rising weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from grr_torch.errors import GrrError, ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.objectives import OBJECTIVES, check_objectives
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.refine import refine
from grr_torch.robots.load import load_robot
from grr_torch.robots.robot import Robot

WEIGHTS = (0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True)
class Trade:
    """One roadmap.

    Attributes:
        objective: What it was refined for besides smoothness; none at weight 0.
        weight: Of the objective.
        values: Mean and worst of every objective over its vertices.
        quality: Its other figures.
    """

    objective: str
    weight: float
    values: dict[str, dict[str, float]]
    quality: Quality

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        own = {"objective": self.objective, "weight": self.weight, "values": self.values}
        return {**own, **self.quality.to_dict()}


def measure_trade(
    name: str,
    task: str | None = None,
    *,
    objectives: Sequence[str] | None = None,
    weights: Sequence[float] = WEIGHTS,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Trade]:
    """Refines one roadmap for smoothness alone, and then for each objective with each weight.

    Args:
        name: A bundled robot.
        task: The kind of task; the preset's default.
        objectives: Of clearance, manipulability and limits; by default all that the robot has.
        weights: Weights, above 0.
        seed: Of all random draws.
        progress: Told which roadmap is refined.

    Raises:
        UnknownNameError: No such robot, task or objective.
        ParameterError: A weight is not above 0, or the robot has no such objective.
    """
    robot = load_robot(name)
    shown = [known for known in OBJECTIVES if _has(robot, known)]
    wanted = shown if objectives is None else list(objectives)
    for weight in weights:
        check_objectives(robot, dict.fromkeys(wanted, weight))
        if weight == 0.0:
            raise ParameterError("weight", weight, "above 0: the first row is without objectives")
    plain = build(robot, task, refine=False, seed=seed)
    jobs = [("", 0.0), *((objective, weight) for objective in wanted for weight in weights)]
    trades: list[Trade] = []
    for index, (objective, weight) in enumerate(jobs):
        progress(f"{objective or 'smoothness'} {weight:g}", index, len(jobs))
        given = {**dict.fromkeys(shown, 0.0), **({objective: weight} if objective else {})}
        refined = refine(plain, objectives=given, seed=seed)
        told = refined.parameters["refinement"]["objectives"]
        trades.append(Trade(objective, weight, {k: told[k]["after"] for k in shown}, refined.quality()))
    progress("done", len(jobs), len(jobs))
    return trades


def _has(robot: Robot, objective: str) -> bool:
    try:
        check_objectives(robot, {objective: 1.0})
    except GrrError:
        return False
    return True
