"""The continuity checks of one build, spread over the tasks of a Ray cluster.

An edge needs its two points, its two configurations and the robot, and no other edge; but beside other edges sums are
rounded otherwise, and an edge that barely passes may fail. So what is cut are whole batches, as they are checked here.
What a roadmap that is too large for one machine would be cut at besides is said in `grr_torch.experiments.cluster`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import GrrError
from grr_torch.fleet.cluster import cluster
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances
from grr_torch.resolution.edges import EDGES_AT_ONCE
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# edges that a worker checks together
_BATCH = EDGES_AT_ONCE
# how often a worker that is lost is replaced
_RETRIES = 3


class SpreadCheck:
    """`is_continuous` by the workers of a cluster. A piece whose worker is lost is checked again.

    Attributes:
        at_once: How many edges it is best asked for together: each time, the slowest worker is waited for.
    """

    at_once = 8 * EDGES_AT_ONCE

    def __init__(self, ray: Any) -> None:
        """A check, with a worker for each core of the cluster that is free.

        Args:
            ray: Ray, connected, as `cluster` gives it.
        """
        self._ray = ray
        self._count = max(1, int(ray.available_resources().get("CPU", 1)))
        self._robot: Robot | None = None
        self._sent: Any = None
        self._workers: list[Any] = []

    def __call__(
        self,
        robot: Robot,
        task: TaskSpace,
        *ends: Tensor,
        tolerances: Tolerances = DEFAULT_TOLERANCES,
    ) -> Tensor:
        """Which edges are continuous: (N,) bool.

        Args:
            robot: The robot, on the CPU.
            task: The task space.
            ends: Points (N, width) and configurations (N, n), as `is_continuous` takes them.
            tolerances: Of the projections.

        Raises:
            GrrError: Workers were lost again and again.
        """
        count = len(ends[0])
        batches = -(-count // _BATCH)
        if batches == 1:
            return is_continuous(robot, task, *ends, tolerances=tolerances)
        if robot is not self._robot:
            worker = self._ray.remote(num_cpus=1, max_restarts=_RETRIES, max_task_retries=_RETRIES)(_Worker)
            self._robot, self._workers = robot, []  # those of another robot end, and free their cores
            # kept: a worker that takes the place of a lost one is made of it too
            self._sent = self._ray.put(robot)
            self._workers = [worker.remote(self._sent) for _ in range(self._count)]
        share = _BATCH * -(-batches // self._count)
        parts = zip(*(end.split(share) for end in ends), strict=True)
        waiting = [
            worker.check.remote(task, [part.numpy() for part in piece], tolerances, _BATCH)
            for worker, piece in zip(self._workers, parts, strict=False)
        ]
        try:
            found = self._ray.get(waiting)
        except self._ray.exceptions.RayError as error:
            raise GrrError(f"edges could not be checked on the cluster: {type(error).__name__}") from error
        return torch.cat([torch.as_tensor(part.copy()) for part in found])


@contextmanager
def spread_check(address: str | None = None) -> Iterator[SpreadCheck]:
    """Gives a check on a cluster: one that runs at `address`, or one of its own; see `cluster`."""
    with cluster(address) as ray:
        yield SpreadCheck(ray)


class _Worker:
    """Keeps the robot, whose tables are made when it is first used."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def check(self, task: TaskSpace, ends: list[Any], tolerances: Tolerances, batch: int) -> Any:
        """Some batches."""
        batches = zip(*(torch.as_tensor(end.copy()).split(batch) for end in ends), strict=True)
        return torch.cat([is_continuous(self.robot, task, *part, tolerances=tolerances) for part in batches]).numpy()
