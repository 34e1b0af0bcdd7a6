"""What a projection is made of, and what would be left of it if only its arithmetic cost time."""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from grr_torch.pieces import FEW, one_thread, slices
from grr_torch.projection.project import project_columns
from grr_torch.projection.step import Equations, free_step, stop_at_limits
from grr_torch.robots.kinematics import KinematicTree
from grr_torch.robots.robot import Robot
from grr_torch.spaces.rotation import rotation_error
from grr_torch.spaces.task import Position

# how far from a solution the projection starts, in every joint [rad]
_PERTURBATION = 0.3
# columns of the narrow calls by which the overhead of calls is told; fewer are computed in another way
_NARROW = FEW + 1
# operators that only make memory, or give its shape
_NO_ARITHMETIC = ("empty", "new_empty", "empty_like", "detach", "_local_scalar_dense")


class AnyPose(Position):
    """Poses as columns of position and rotation matrix."""

    @property
    def width(self) -> int:
        """Three coordinates and nine entries."""
        return 12

    @property
    def constraints(self) -> int:
        """All six."""
        return 6

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (3, N) [rad]."""
        return rotation_error(targets[3:].view(3, 3, -1), rotation)


@dataclass(frozen=True)
class PoseProblem:
    """Poses of random configurations, to be projected to from configurations nearby.

    Attributes:
        robot: The robot.
        position: (N, 3).
        rotation: (N, 3, 3).
        guesses: (N, n).
    """

    robot: Robot
    position: Tensor
    rotation: Tensor
    guesses: Tensor

    @classmethod
    def sample(cls, robot: Robot, count: int) -> PoseProblem:
        """Starts are up to 0.3 rad from the configurations that the poses are of, in every joint."""
        q = robot.sample(count, torch.Generator().manual_seed(0))
        noise = torch.rand(count, robot.n, dtype=q.dtype, generator=torch.Generator().manual_seed(1)).to(q)
        guesses = (q + _PERTURBATION * (2.0 * noise - 1.0)).clamp(robot.lower, robot.upper)
        return cls(robot, *robot.forward_kinematics(q), guesses)

    def columns(self) -> tuple[Tensor, Tensor]:
        """Targets (12, N) of `AnyPose` and guesses (n, N)."""
        targets = torch.cat([self.position, self.rotation.reshape(-1, 9)], dim=1).T.contiguous()
        return targets, self.robot.columns(self.guesses)


@dataclass(frozen=True)
class Part:
    """One kernel's share of a projection.

    Attributes:
        name: What it does.
        columns: How often it is done a pose.
        calls: How often it is called, for all poses together.
        seconds: Time a pose.
        waiting: Of it, what would be left if the calls had next to no columns: the cost of torch calls.
        operators: Torch operators a call.
        products: Floating-point operations a column in products of matrices.
        pointwise: And in all other operators.
    """

    name: str
    columns: float
    calls: float
    seconds: float
    waiting: float = math.nan
    operators: int = 0
    products: float = 0.0
    pointwise: float = 0.0


@dataclass(frozen=True)
class ProjectionCost:
    """What a projection is made of.

    Attributes:
        seconds: CPU time a pose [s].
        parts: Its shares; those of kernels are of their calls done again, with operands in the cache.
        functions: Time a pose of sines and cosines alone, which is in the first part.
        product_rate: Floating-point operations a second of torch.mm, of the size that poses need.
        pointwise_rate: And of torch.addcmul on operands in the cache.
    """

    seconds: float
    parts: list[Part]
    functions: float
    product_rate: float
    pointwise_rate: float

    def without_calls(self) -> float:
        """Time a pose of the iterations' kernels if a torch call cost nothing."""
        return sum(part.seconds - part.waiting for part in self.parts if part.operators)

    def floor(self) -> float:
        """Time a pose of those kernels' arithmetic at these rates, and of the sines and cosines."""
        products = sum(part.columns * part.products for part in self.parts) / self.product_rate
        pointwise = sum(part.columns * part.pointwise for part in self.parts) / self.pointwise_rate
        return products + pointwise + self.functions


# each kernel, and the argument whose last axis counts its columns
_KERNELS: dict[str, tuple[Callable[..., Any], str]] = {
    "poses of the frames": (KinematicTree.frames, "q"),
    "errors": (AnyPose.error, "targets"),
    "Jacobians": (KinematicTree.jacobian, "frames"),
    "steps: damped least squares": (free_step, "equations"),
    "steps again, at limits": (stop_at_limits, "moved"),
}


def projection_cost(robot: Robot, count: int = 10_000, repeats: int = 7) -> ProjectionCost:
    """Runs a projection of random poses, and every call of its kernels once more by itself.

    Args:
        robot: The robot, on the CPU.
        count: How many poses; more than are computed as a few.
        repeats: Medians are taken over so many runs.
    """
    targets, q = PoseProblem.sample(robot, count).columns()
    task = AnyPose(3)

    def run() -> None:
        project_columns(robot, task, targets, q, check_collision=False)

    whole = _cpu_seconds(run, repeats) / count
    calls = _record(run)
    with torch.no_grad(), one_thread():
        width = slices(count, q.device)[0].stop
        wide, narrow = (_calls(robot, task, targets[:, :size], q[:, :size]) for size in (width, _NARROW))
        one, two = torch.ones(2, 6, width, dtype=q.dtype)
        left, right, out = (torch.ones(size, dtype=q.dtype) for size in ((5, 4), (4, 3 * width), (5, 3 * width)))
        parts = []
        for name in _KERNELS:
            seconds = sum(_cpu_seconds(call, repeats) for _, call in calls[name])
            part = Part(name, sum(size for size, _ in calls[name]) / count, len(calls[name]), seconds / count)
            if name in wide:
                counter = count_operators(wide[name])
                pair = [_cpu_seconds(call[name], repeats) for call in (wide, narrow)]
                waiting = max(0.0, (pair[1] * width - pair[0] * _NARROW) / (width - _NARROW))
                part = replace(
                    part,
                    waiting=part.calls * waiting / count,
                    operators=counter.operators,
                    products=counter.products / width,
                    pointwise=counter.pointwise / width,
                )
            parts.append(part)
        functions = _cpu_seconds(lambda: (q[:, :width].cos(), q[:, :width].sin()), repeats)
        product = _cpu_seconds(lambda: torch.mm(left, right, out=out), repeats)
        pointwise = _cpu_seconds(lambda: one.addcmul_(two, two), repeats)
    rest = Part(
        "the rest: checks, bookkeeping, operands no longer in the cache",
        1.0,
        1,
        whole - sum(part.seconds for part in parts),
    )
    return ProjectionCost(
        seconds=whole,
        parts=[*parts, rest],
        functions=parts[0].columns * functions / width,
        product_rate=2.0 * 4 * out.numel() / product,
        pointwise_rate=2.0 * one.numel() / pointwise,
    )


def _record(run: Callable[[], None]) -> dict[str, list[tuple[int, Callable[[], Any]]]]:
    """Every call of each kernel in a run: how many columns it had, and how to do it again."""
    kernels = {function.__code__: (name, function, argument) for name, (function, argument) in _KERNELS.items()}
    calls: dict[str, list[tuple[int, Callable[[], Any]]]] = {name: [] for name in _KERNELS}

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code in kernels:
            name, function, argument = kernels[code]
            values = [_copy(frame.f_locals[variable]) for variable in code.co_varnames[: code.co_argcount]]
            value = frame.f_locals[argument]
            width = (value.q if isinstance(value, Equations) else value).shape[-1]
            calls[name].append((width, partial(function, *values)))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(before)
    return calls


def _copy(value: Any) -> Any:
    """An argument as it is now: what a kernel is given may be overwritten."""
    if isinstance(value, Equations):
        return Equations(*(tensor.clone() for tensor in value))
    return value.clone() if isinstance(value, Tensor) else value


def _cpu_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median CPU time of a call [s], after one that fills the cache."""
    call()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return statistics.median(times)


def _calls(robot: Robot, task: AnyPose, targets: Tensor, q: Tensor) -> dict[str, Callable[[], Any]]:
    """The kernels of one iteration by themselves, on the columns that are given."""
    tree, workspace = robot.tree, robot.tree.workspace(q, q.shape[1])
    frames = tree.frames(q, workspace)
    pose, jacobian = tree.tool_pose(frames), tree.jacobian(frames)
    error = task.error(targets, *pose)
    every = torch.arange(q.shape[1])
    equations = Equations(every, q, task.jacobian(jacobian), error, torch.full_like(q[0], 1e-3))
    return {
        "poses of the frames": lambda: tree.frames(q, workspace),
        "errors": lambda: task.error(targets, *pose),
        "Jacobians": lambda: tree.jacobian(frames),
        "steps: damped least squares": lambda: free_step(equations),
    }


class OperatorCounter(TorchDispatchMode):
    """Counts torch operators that compute, and their floating-point operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.operators = 0
        self.products = 0
        self.pointwise = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__.rstrip("_")
        if func.is_view or name in _NO_ARITHMETIC:
            return result
        self.operators += 1
        if name == "mm":
            self.products += 2 * args[0].shape[0] * args[1].numel()
        elif name in ("sum", "amax"):
            self.pointwise += args[0].numel()
        elif name not in ("copy", "stack", "cat"):
            self.pointwise += (2 if name == "addcmul" else 1) * result.numel()
        return result


def count_operators(call: Callable[[], Any]) -> OperatorCounter:
    """Runs a call and counts."""
    with OperatorCounter() as counter:
        call()
    return counter
