"""What is foretold of work that reports where it is."""

from __future__ import annotations

import pytest

from grr_torch import build, load_robot
from grr_torch.progress import Outlook
from grr_torch.resolution.stages import build_stages


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def work(outlook, clock, stages, steps=10):
    """Does stages (name, seconds) and yields what is left and what was foretold, after each step."""
    left = sum(seconds for _, seconds in stages)
    for name, seconds in stages:
        for step in range(steps):
            outlook(name, step, steps)
            clock.now += seconds / steps
            left -= seconds / steps
            outlook(name, step + 1, steps)
            yield left, outlook.left()


def test_work_as_planned_is_foretold_exactly():
    clock = Clock()
    plan = [("a", 1.0), ("b", 5.0), ("a", 2.0), ("c", 3.0)]
    told = work(Outlook(plan, clock), clock, [(name, 7.0 * weight) for name, weight in plan])
    assert all(foretold == pytest.approx(left) for left, foretold in told)


def test_a_stage_that_comes_again_takes_as_long_as_before():
    clock = Clock()
    stages = [("a", 1.0), ("b", 50.0), ("a", 1.0), ("b", 50.0)]
    told = list(work(Outlook([("a", 1.0), ("b", 1.0), ("a", 1.0), ("b", 1.0)], clock), clock, stages))
    assert told[20][1] == pytest.approx(told[20][0], rel=1e-3)


def test_stages_left_out_ended_early_or_unknown_do_no_harm():
    clock = Clock()
    outlook = Outlook([("a", 1.0), ("left out", 1.0), ("b", 1.0), ("c", 1.0)], clock)
    outlook("a", 0, 40)
    assert outlook.left() is None
    clock.now = 2.0
    outlook("a", 10, 40)
    outlook("b", 0, 10)
    assert outlook.left() == pytest.approx(4.0)
    clock.now = 3.0
    outlook("unknown", 1, 2)
    outlook("a", 40, 40)
    assert outlook.left() == pytest.approx(3.0)
    outlook("b", 5, 10)
    outlook("c", 0, 0)
    assert outlook.left() == 0.0
    assert outlook.elapsed() == 3.0


@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize(("task", "rotations"), [("position", None), ("yaw", 4)])
def test_a_build_reports_the_stages_that_are_foretold_of_it(task, rotations, refine):
    robot = load_robot("kinova")
    told = []

    def report(stage, done, total):
        if not told or told[-1] != stage:
            told.append(stage)

    roadmap = build(robot, task, points=400, rotations=rotations, refine=refine, progress=report)
    roadmap.quality(report)
    plan = iter(name for name, _ in build_stages(roadmap.task, refine=refine))
    # each as it comes, but for what is done again for a few edges
    wanted = [stage for stage in told if stage in plan]
    assert set(told) == set(wanted)
