"""How fast everything is, beside other libraries at the same work in the same run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.experiments.peers import (
    installed_peers,
    klampt_ik,
    pinocchio_jacobian,
    pytorch_kinematics_jacobian,
)
from grr_torch.experiments.projection_cost import AnyPose, PoseProblem
from grr_torch.experiments.scale import measure_build
from grr_torch.experiments.timing import machine, median_process_seconds, median_seconds
from grr_torch.experiments.use_speed import measure_use
from grr_torch.pieces import in_pieces
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import DEFAULT_TOLERANCES, project_columns
from grr_torch.resolution.build import build
from grr_torch.robots.load import load_robot
from grr_torch.robots.robot import Robot

# configurations that a peer is asked for one by one
_ONE_BY_ONE = 10_000
# vertices, about, of builds that are compared
GROWTH = (3_299, 30_000, 300_000)


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: What was done.
        unit: Of all its figures.
        ours: Our figure.
        peers: Theirs.
        more: What else was measured.
        higher_is_better: Whether a ratio is ours over theirs, or theirs over ours.
    """

    what: str
    unit: str
    ours: float
    peers: dict[str, float] = field(default_factory=dict)
    more: dict[str, float] = field(default_factory=dict)
    higher_is_better: bool = False

    def ratios(self) -> dict[str, float]:
        """How many times as fast as each peer we are."""
        return {name: self.ours / x if self.higher_is_better else x / self.ours for name, x in self.peers.items()}


@dataclass(frozen=True)
class SpeedTable:
    """The table, and what it was measured on.

    Attributes:
        machine: Processor, threads and versions.
        peers: Versions of the peers, or why they are not there.
        rows: The lines.
    """

    machine: dict[str, str]
    peers: dict[str, str]
    rows: list[Row]

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        rows = [{**row.__dict__, "ratios": row.ratios()} for row in self.rows]
        return {"machine": self.machine, "peers": self.peers, "rows": rows}


def measure_speed(
    *,
    sections: Sequence[str] | None = None,
    peers: Sequence[str] | None = None,
    repeats: int = 7,
    device: str = "cpu",
    progress: Progress = silent,
) -> SpeedTable:
    """Measures the sections of the table, one after the other.

    Args:
        sections: Of `SECTIONS`; all by default.
        peers: Of `PEERS`; those that are installed by default.
        repeats: Medians are taken over so many.
        device: Where we compute; the peers compute on the CPU.
        progress: Told which section is measured.

    Raises:
        UnknownNameError: No such section or peer.
        ParameterError: `repeats` is below 1, or there is no such device.
    """
    wanted = tuple(SECTIONS) if sections is None else tuple(sections)
    for name in wanted:
        if name not in SECTIONS:
            raise UnknownNameError("section", name, tuple(SECTIONS))
    if repeats < 1:
        raise ParameterError("repeats", repeats, "1 or more")
    found, missing = installed_peers(None if peers is None else tuple(peers))
    bench = _Bench(load_robot("kinova", device=device), tuple(found), repeats)
    rows: list[Row] = []
    for index, name in enumerate(wanted):
        progress(f"measuring {name}", index, len(wanted))
        rows.extend(SECTIONS[name](bench))
    progress("measuring", len(wanted), len(wanted))
    return SpeedTable(machine(), {**found, **missing}, rows)


@dataclass(frozen=True)
class _Bench:
    robot: Robot
    peers: tuple[str, ...]
    repeats: int

    def seconds(self, ours: Callable[[], Any], peers: dict[str, Callable[[], Any]]) -> dict[str, float]:
        """Medians by name; ours is "". What a GPU was told to do is waited for."""

        def finished() -> None:
            ours()
            if self.robot.device.type == "cuda":
                torch.cuda.synchronize()

        return median_seconds({"": finished, **peers}, self.repeats)

    def sample(self, count: int) -> Tensor:
        return self.robot.sample(count, torch.Generator().manual_seed(0))


def _kinematics(bench: _Bench) -> Iterator[Row]:
    robot = bench.robot
    for count in (1, 1_000, 10_000, 100_000):
        q = bench.sample(count)
        calls: dict[str, Callable[[], Any]] = {}
        if "pytorch-kinematics" in bench.peers:
            calls["pytorch-kinematics"] = pytorch_kinematics_jacobian(robot, q)
        few = q[:_ONE_BY_ONE]
        if "Pinocchio" in bench.peers:
            calls["Pinocchio"] = pinocchio_jacobian(robot, few)
        seconds = bench.seconds(partial(robot.pose_and_jacobian, q), calls)
        per_one = {name: 1e6 * value / count for name, value in seconds.items()}
        if "Pinocchio" in per_one:
            per_one["Pinocchio"] *= count / len(few)
        yield Row(f"pose + Jacobian, N = {count:,}", "µs a configuration", per_one.pop(""), per_one)


def _projection(bench: _Bench) -> Iterator[Row]:
    robot, count = bench.robot, 10_000
    problem = PoseProblem.sample(robot, count)
    targets, columns = problem.columns()

    def ours() -> Tensor:
        return project_columns(robot, AnyPose(3), targets, columns, check_collision=False)[1]

    calls: dict[str, Callable[[], Any]] = {}
    more = {"valid": float(ours().double().mean())}
    if "Klampt" in bench.peers:
        calls["Klampt"] = klampt_ik(robot, problem.position, problem.rotation, problem.guesses, DEFAULT_TOLERANCES)
        more["valid, Klampt"] = calls["Klampt"]() / count
    if "pytorch-kinematics" in bench.peers:
        calls["pk"] = pytorch_kinematics_jacobian(robot, problem.guesses)
    seconds = bench.seconds(ours, calls)
    if "pk" in seconds:
        more["pytorch-kinematics' jacobian in these turns, µs a configuration"] = 1e6 * seconds.pop("pk") / count
    rates = {name: count / value for name, value in seconds.items()}
    yield Row("projection from ±0.3 rad, N = 10,000", "poses / s", rates.pop(""), rates, more, higher_is_better=True)


def _self_collision(bench: _Bench) -> Iterator[Row]:
    robot, count = bench.robot, 10_000
    columns = robot.columns(bench.sample(count))
    seconds = bench.seconds(
        lambda: robot.columns_in_self_collision(columns),
        {"poses": lambda: in_pieces(lambda part: (robot.tree.frames(part),), columns)},
    )
    whole, poses = (1e6 * seconds[name] / count for name in ("", "poses"))
    more = {"of it the poses of all links": poses}
    yield Row("self-collision, all pairs, N = 10,000", "µs a configuration", whole, {}, more)


def _builds(bench: _Bench) -> Iterator[Row]:
    for name in ("planar_5", "kinova"):
        robot = load_robot(name, device=bench.robot.device)
        for task in ("position", "fixed-rotation"):
            seconds = bench.seconds(partial(build, robot, task, refine=False), {})
            yield Row(f"build, {name} {task}, not refined", "s", seconds[""])


def _processes(bench: _Bench) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "kinova.grr")
        command = ["-P", "-m", "grr_torch.cli.main"]
        seconds = median_process_seconds(
            {
                "build": [*command, "build", "--robot", "kinova", "--out", out, "--device", str(bench.robot.device)],
                "import": ["-c", "import torch, pytorch_kinematics"],
                "help": [*command, "--help"],
                "typer": ["-c", "import typer; typer.run(lambda: None)"],
            },
            bench.repeats,
        )
    imports = {"python -c 'import torch, pytorch_kinematics'": seconds["import"]}
    yield Row("grr-torch build --robot kinova, whole process", "s", seconds["build"], imports)
    yield Row("grr-torch --help, whole process", "s", seconds["help"], {"a bare typer app": seconds["typer"]})


def _growth(bench: _Bench) -> Iterator[Row]:
    for points in GROWTH:
        grown = measure_build("kinova", "position", points, refine=False, device=str(bench.robot.device))
        more = {"s": grown.seconds, "peak MiB of the process": grown.peak_mib}
        each = 1e6 * grown.seconds / grown.vertices
        yield Row(f"build, kinova position, {grown.vertices:,} vertices", "µs a vertex", each, {}, more)


def _use(bench: _Bench) -> Iterator[Row]:
    figures = measure_use(build(bench.robot, "fixed-rotation"), bench.repeats)
    more = {"valid": figures.valid, "one point alone, µs": 1e6 * figures.one_point}
    yield Row("solve, kinova fixed-rotation, N = 100,000", "points / s", figures.points_per_second, {}, more)
    p99 = {"99th percentile": 1e3 * figures.step_p99}
    yield Row("teleoperation, one arm, paths of all kinds", "ms a step", 1e3 * figures.step_median, {}, p99)
    yield Row("teleoperation, 100 arms, random lines", "ms an arm and step", 1e3 * figures.arm_step)


SECTIONS: dict[str, Callable[[_Bench], Iterator[Row]]] = {
    "kinematics": _kinematics,
    "projection": _projection,
    "self-collision": _self_collision,
    "build": _builds,
    "process": _processes,
    "growth": _growth,
    "use": _use,
}
