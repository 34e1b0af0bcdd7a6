"""The work of a fleet: one order becomes one roadmap file, in whatever process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from grr_torch.fleet.options import known_options, of_owner
from grr_torch.fleet.order import Order, make_order_task
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.memory import forget_peak, peak_memory
from grr_torch.robots.load import load_robot

# makes an order's roadmap file in a folder
Work = Callable[[Order, Path, Progress], None]


def make_roadmap(order: Order, folder: Path, progress: Progress = silent) -> None:
    """Builds the roadmap of an order and writes its file, which appears when it is complete.

    The file's parameters hold, as "fleet", the order and what it cost.

    Args:
        order: The order.
        folder: Where the file goes.
        progress: Told what is being done and how far it is.

    Raises:
        GrrError: It cannot be built or written.
    """
    begin = time.perf_counter()
    forget_peak()
    robot = load_robot(**of_owner("robot", order.options))
    said = {name: value for name, value in of_owner("build", order.options).items() if name != "task"}
    roadmap = build(robot, make_order_task(robot, order.options), **said, progress=progress)
    told = describe(order)
    roadmap = replace(roadmap, parameters={**roadmap.parameters, "fleet": told})
    roadmap.quality(progress)  # is part of the cost
    told |= {"seconds": time.perf_counter() - begin, "peak_memory_mib": peak_memory()}
    roadmap.save(order.path(folder))


def describe(order: Order) -> dict[str, Any]:
    """An order as files hold it, with every parameter: what was not given as its default."""
    parameters = {name: order.options.get(name, option.default) for name, option in known_options().items()}
    return {
        "hash": order.hash,
        "robot": order.robot,
        "task": order.task,
        "orientation": order.orientation,
        "parameters": {name: list(value) if isinstance(value, tuple) else value for name, value in parameters.items()},
    }
