"""Memory: what a build will take at its peak, and what is there; asked before it starts."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from grr_torch.errors import ParameterError
from grr_torch.pieces import cores
from grr_torch.projection.project import DEFAULT_TOLERANCES
from grr_torch.resolution.edges import EDGES_AT_ONCE
from grr_torch.resolution.problem import Problem
from grr_torch.resolution.reachability import from_random_starts, within_reach
from grr_torch.robots.robot import Robot

# bytes at the peak: of a vertex and an edge of the graph, and by joint of those that are resolved or connected, with
# and without refinement. Fitted to builds of 30,000 to 1,000,000 vertices
_VERTEX, _EDGE = 60, 80
_RESOLVED = {False: 150, True: 280}
_CONNECTED = {False: 20, True: 40}
# what a fit of the measured peaks leaves over
_MARGIN = 1.2
# whatever the size: pieces that are worked on, in each of the processes that do
_LEAST = 64 << 20
# and on a GPU, of an edge, as long as the pieces are not full: these are larger there. Fitted to 3,000 to 1,000,000
# vertices on one
_EDGE_ON_GPU, _PIECES_ON_GPU = 1536, 7 << 28
# vertices of which it is tried how many can be resolved, and the starts of each
_TRIED, _STARTS = 400, 4


def require_memory(robot: Robot, problem: Problem, refine: bool) -> None:
    """Checks that a build will fit the memory that is free, of the machine and, if it uses one, of the GPU.

    Raises:
        ParameterError: It will not.
    """
    _require(robot, problem, refine, available_memory())
    if robot.device.type == "cuda":
        pieces = min(_EDGE_ON_GPU * len(problem.graph.edges), _PIECES_ON_GPU)
        _require(robot, problem, refine, _gpu_memory(robot.device), pieces, " on the GPU")


def _require(robot: Robot, problem: Problem, refine: bool, free: int | None, pieces: int = 0, where: str = "") -> None:
    """`require_memory` of one memory, where `pieces` are so many bytes larger than on the CPU."""
    if free is None or estimate_memory(robot, problem, refine, 1.0) + pieces <= free:
        return
    share = _resolvable(robot, problem)
    wanted = estimate_memory(robot, problem, refine, share) + pieces
    if wanted <= free:
        return
    vertices = len(problem.graph.points)
    # pieces that are not full grow with the edges, full ones do not
    least = _least(robot, problem)
    growing = wanted - pieces - least
    of_edges = _EDGE_ON_GPU * len(problem.graph.edges) if pieces else 0
    fitting = int(vertices * max((free - least - pieces) / growing, max(free - least, 0) / (growing + of_edges)))
    valid = f"about {fitting:,} vertices"
    if refine and estimate_memory(robot, problem, False, share) + pieces <= free:
        valid += ", or no refinement"
    what = f"{vertices:,} vertices, which would take about {_gibibytes(wanted)}{where}"
    raise ParameterError("points", what, f"{valid}, with the {_gibibytes(free)} that are free")


def estimate_memory(robot: Robot, problem: Problem, refine: bool, share: float) -> int:
    """Bytes that a build takes at its peak, besides what the process holds already.

    Args:
        robot: The robot.
        problem: What is built for.
        refine: Whether the roadmap will be refined.
        share: How many of the vertices within the arm's reach will be resolved.
    """
    graph = problem.graph
    near = within_reach(robot, problem.task, graph.points)
    resolved = share * int(near.sum())
    connected = share * int(near[graph.edges].all(1).sum())
    of_graph = _VERTEX * len(graph.points) + _EDGE * len(graph.edges)
    of_map = robot.n * (_RESOLVED[refine] * resolved + _CONNECTED[refine] * connected)
    return int(_least(robot, problem) + _MARGIN * (of_graph + of_map))


def _least(robot: Robot, problem: Problem) -> int:
    """Bytes of the pieces that are worked on; on the CPU, in as many processes as there are batches of edges."""
    batches = -(-len(problem.graph.edges) // EDGES_AT_ONCE)
    return _LEAST * max(1, min(cores(), batches) if robot.device.type == "cpu" else 1)


def free_memory(device: torch.device) -> int | None:
    """Bytes that this process may still take where tensors of a device lie; None if unknown."""
    return available_memory() if device.type == "cpu" else _gpu_memory(device)


def available_memory() -> int | None:
    """Bytes that this process may still take, by the system and by the limits of its control group; None if unknown."""
    found = [_system_memory(), *_group_memory()]
    known = [value for value in found if value is not None]
    return max(0, min(known)) if known else None


def _resolvable(robot: Robot, problem: Problem) -> float:
    """About which share of the vertices within the arm's reach can be resolved, by random starts at some of them."""
    generator = torch.Generator().manual_seed(0)
    near = within_reach(robot, problem.task, problem.graph.points).nonzero()[:, 0]
    tried = near[torch.randint(len(near), (_TRIED,), generator=generator)]
    points = problem.graph.points[tried]
    reached = from_random_starts(robot, problem.task, points, _STARTS, generator, DEFAULT_TOLERANCES)[1].any(1)
    return min(1.0, float(reached.double().mean()) + 0.05)


def _gpu_memory(device: torch.device) -> int:
    """Bytes that are free on a GPU, and those that torch holds there without need."""
    held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return int(torch.cuda.mem_get_info(device)[0]) + held


def _system_memory() -> int | None:
    for line in _lines(Path("/proc/meminfo")):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _group_memory(root: Path = Path("/sys/fs/cgroup"), process: Path = Path("/proc/self/cgroup")) -> list[int]:
    """What is left of the limits of this process's control group and of those above it, of both versions."""
    left: list[int] = []
    for line in _lines(process):
        number, controllers, group = line.split(":", 2)
        if number == "0":
            top, names = root, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            top = root / "memory"
        else:
            continue
        folder = top / group.strip("/")
        # in a container, the group's own folder may not be seen, but its root is then the group
        for place in (folder, *(parent for parent in folder.parents if parent.is_relative_to(top))):
            limit, used = _number(place / names[0]), _number(place / names[1])
            if limit is not None and used is not None:
                left.append(limit - used + _cached(place / "memory.stat", names[2]))
    return left


def _cached(path: Path, name: str) -> int:
    """Bytes of files that are only remembered: they count as used, but are given back at need."""
    return next((int(line.split()[1]) for line in _lines(path) if line.startswith(f"{name} ")), 0)


def _number(path: Path) -> int | None:
    text = "".join(_lines(path)).strip()
    return int(text) if text.isdigit() else None


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _gibibytes(size: float) -> str:
    return f"{size / 2**30:.1f} GiB"


def forget_peak() -> None:
    """Lets the system measure this process's peak anew, where it can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_memory() -> float:
    """The most memory that this process has held [MiB], since it was last forgotten where that can be done."""
    status = Path("/proc/self/status")
    if status.exists():
        # ru_maxrss may be that of the process that started this one
        line = next((line for line in status.read_text().splitlines() if line.startswith("VmHWM")), None)
        if line is not None:
            return float(line.split()[1]) / 2**10
    import resource  # is not everywhere

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
