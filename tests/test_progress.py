"""What is foretold of work that reports where it is."""

from __future__ import annotations

import re
import time

import pytest
from grr_torch.cli import show

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
    assert outlook.left() == pytest.approx(4.0)
    outlook("b", 5, 10)
    outlook("c", 0, 0)
    assert outlook.left() == 0.0


def test_what_was_done_before_tells_nothing_of_speed():
    clock = Clock()
    outlook = Outlook([("a", 1.0), ("b", 1.0), ("c", 2.0)], clock)
    outlook("a", 10, 10)  # was kept
    outlook("b", 20, 40)  # so was half of it
    assert outlook.left() is None
    clock.now = 50.0
    outlook("b", 30, 40)
    assert outlook.left() == pytest.approx(50.0 + 400.0)


def test_a_stage_that_begins_anew_does_not_stand_for_a_later_one():
    clock = Clock()
    outlook = Outlook([("a", 1.0), ("again", 1.0), ("b", 5.0), ("again", 1.0), ("again", 2.0)], clock)
    outlook("a", 0, 10)
    clock.now = 10.0
    for done, total in ((0, 3), (3, 3), (0, 90), (90, 90)):
        outlook("again", done, total)
    assert outlook.left() == pytest.approx(80.0)
    outlook("b", 0, 1)
    outlook("again", 4, 4)
    outlook("again", 0, 4)
    assert outlook._at == 4, "next to each other, they are two"


@pytest.mark.parametrize("options", [{"refine": False}, {"refine": True}, {"objectives": {"manipulability": 0.3}}])
@pytest.mark.parametrize(("task", "rotations"), [("position", None), ("yaw", 4)])
def test_a_build_goes_through_all_stages_that_are_foretold_of_it(task, rotations, options):
    robot = load_robot("kinova")
    turning = {"rotations": rotations}
    plain = build(robot, task, points=400, **turning, refine=False)
    plan = build_stages(plain.task, **{**options, "objectives": "objectives" in options})
    outlook = Outlook(plan)
    entered = []

    def report(stage, done, total):
        outlook(stage, done, total)
        entered.extend([outlook._at] if [outlook._at] != entered[-1:] else [])

    build(robot, task, points=400, **turning, **options, progress=report).quality(report)
    assert [plan[at][0] for at in entered] == [stage for stage, _ in plan[:-1]], "all but writing, none skipped"


def test_without_a_terminal_lines_at_times_say_how_far_the_work_is(monkeypatch, capfd):
    monkeypatch.setattr(show, "_EVERY", 0.2)
    begun = time.perf_counter()
    with show.progress_bar() as progress:
        for done in range(50):
            progress("fitting spheres", done, 2000)
            time.sleep(0.02)
        progress("fitting spheres", 2000, 2000)
        # one step that takes long
        time.sleep(0.7)
    seconds = time.perf_counter() - begun
    printed, told = capfd.readouterr()
    lines = told.splitlines()
    assert printed == ""
    assert 3 <= len(lines) <= seconds / 0.2
    said = r"\d+:\d\d:\d\d fitting spheres [\d,]+/2,000(, about \d+:\d\d:\d\d left)?"
    assert all(re.fullmatch(said, line) for line in lines)
    assert lines[-1].endswith("fitting spheres 2,000/2,000")
    assert lines[-2].endswith("fitting spheres 2,000/2,000")


def test_what_is_done_soon_says_nothing(monkeypatch, capfd):
    monkeypatch.setattr(show, "_EVERY", 30.0)
    begun = time.perf_counter()
    with show.progress_bar() as progress:
        progress("fitting spheres", 3, 8)
        time.sleep(0.1)
    assert time.perf_counter() - begun < 10.0
    assert capfd.readouterr() == ("", "")
