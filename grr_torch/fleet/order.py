"""An order: one roadmap of a fleet, with all that determines it, and its hash."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.fleet.options import check_option, known_options, of_owner
from grr_torch.resolution.options import check_options
from grr_torch.resolution.problem import complete_task
from grr_torch.resolution.roadmap_file import FORMAT_VERSION
from grr_torch.resolution.seeds import read_seeds
from grr_torch.robots.load import load_robot
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace
from grr_torch.version import __version__

# hexadecimal digits of a hash that name a file
_DIGITS = 16
# of a GPU
_LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class Needs:
    """What a build needs of a machine; Ray places it where that is free.

    Attributes:
        cpus: Cores.
        memory: Memory [GiB].
        gpus: GPUs, or shares of one.
    """

    cpus: float = 1.0
    memory: float = 1.0
    gpus: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = 0.0 if name == "gpus" else 1e-3
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not math.isfinite(value) or value < least:
                raise ParameterError(f"needs: {name}", repr(value), f"a number of {least:g} or more")
        if (self.gpus > 1.0 and self.gpus != int(self.gpus)) or 0.0 < self.gpus < _LEAST_SHARE:
            valid = f"0, a share of one from {_LEAST_SHARE:g} on, or a whole number, as Ray counts them"
            raise ParameterError("needs: gpus", self.gpus, valid)

    @staticmethod
    def of(data: Any) -> Needs:
        """Reads needs from a sweep.

        Raises:
            ParameterError: It is no mapping, or a value is out of its range.
            UnknownNameError: A key is not known.
        """
        known = ("cpus", "memory", "gpus")
        if not isinstance(data, Mapping):
            raise ParameterError("needs", repr(data), f"names with values: {', '.join(known)}")
        for name in data:
            if name not in known:
                raise UnknownNameError("need", str(name), known)
        return Needs(**data)


@dataclass(frozen=True)
class Order:
    """One roadmap of a fleet. Plain data: it travels to other machines.

    Attributes:
        hash: Of all that determines the roadmap; names its file.
        robot: The robot's name.
        task: The kind of its task.
        orientation: What its task says of the tool's orientation.
        options: Options as `known_options` names them, with absolute paths.
        needs: What the build needs.
    """

    hash: str
    robot: str
    task: str
    orientation: str
    options: Mapping[str, Any]
    needs: Needs

    @property
    def label(self) -> str:
        """The order in a few words."""
        return f"{self.hash[:8]} {self.robot} {self.task}"

    def path(self, folder: Path) -> Path:
        """Its roadmap's file."""
        return folder / f"{self.hash}.grr"


class Planner:
    """Makes orders of what a sweep says, relative to the sweep's folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._robots: dict[str, Robot] = {}

    def order(self, entry: Mapping[str, Any], needs: Needs) -> Order:
        """The order that an entry stands for.

        Raises:
            GrrError: An option is not known, has a value that it does not take, or names what does not exist.
        """
        options = {name: check_option(name, value) for name, value in entry.items()}
        if options.get("robot") is None:
            raise ParameterError("robot", "nothing", "a bundled robot or the path of a URDF")
        options = self._with_paths({name: value for name, value in options.items() if value is not None})
        robot = self._robot(options)
        if "seeds" in options:
            options["seeds"] = self._seeds(options["seeds"], robot)
        task = make_order_task(robot, options)
        defaults = {name: option.default for name, option in known_options().items() if option.owner == "build"}
        check_options(robot, task, defaults | of_owner("build", options))
        return Order(_digest(robot, task, options), robot.name, task.kind, _orientation(task), options, needs)

    def _with_paths(self, options: dict[str, Any]) -> dict[str, Any]:
        """Options with absolute paths."""
        for name in ("robot", "spheres"):
            place = self.folder / str(options.get(name, ""))
            if name in options and (place.is_file() or place.suffix):
                options[name] = str(place.resolve())
        if "package_dirs" in options:
            options["package_dirs"] = [str((self.folder / path).resolve()) for path in options["package_dirs"]]
        return options

    def _seeds(self, seeds: Any, robot: Robot) -> Any:
        """Seeds as they are, or in place of their file."""
        if not isinstance(seeds, str) or seeds == "auto":
            return seeds
        if not Path(seeds).suffix:
            raise ParameterError("seeds", repr(seeds), "auto, a .csv, .txt, .npy or .parquet file, or a table")
        return read_seeds(self.folder / seeds, robot.joint_names).tolist()

    def _robot(self, options: Mapping[str, Any]) -> Robot:
        # the device is the worker's affair: this machine may have none such
        said = {name: value for name, value in of_owner("robot", options).items() if name != "device"}
        key = json.dumps(said, sort_keys=True)
        if key not in self._robots:
            self._robots[key] = load_robot(**said)
        return self._robots[key]


def make_order_task(robot: Robot, options: Mapping[str, Any]) -> TaskSpace:
    """The task space of a build, completed as `complete_task` does it.

    Raises:
        ParameterError: No task is given, there is no preset that has one, or what is said of it excludes itself.
        UnknownNameError: No such task.
    """
    sides = options.get("bounds")
    axes = None if sides is None else len(sides)
    return complete_task(robot, options.get("task"), axes, **of_owner("task", options))


def _digest(robot: Robot, task: TaskSpace, options: Mapping[str, Any]) -> str:
    """The hash of what determines a roadmap: the software, the arm, the task, and options that are not the defaults."""
    known = known_options()
    said = {
        name: value
        for name, value in options.items()
        if known[name].owner == "build" and name != "task" and value != known[name].default
    }
    problem = robot.preset.problems.get(task.kind) if robot.preset else None
    what = {
        "software": [__version__, FORMAT_VERSION],
        "arm": {
            "urdf": robot.urdf.text,
            "chain": [robot.base, robot.tool],
            "held": dict(robot.held_joints),
            "spheres": robot.spheres.to_yaml() if robot.spheres else None,
            "margin": robot.margin,
        },
        "preset": None if problem is None else asdict(problem),
        "task": task.to_json(),
        "device": options.get("device", "cpu"),
        "options": said,
    }
    text = json.dumps(what, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def _orientation(task: TaskSpace) -> str:
    """What a task says of the tool's orientation, in words."""
    said = {name: value for name, value in task.to_json().items() if name not in ("kind", "dimension")}
    parts = [f"{name} {' '.join(f'{number:.6g}' for number in value)}" for name, value in sorted(said.items())]
    return ", ".join(parts) or "any"
