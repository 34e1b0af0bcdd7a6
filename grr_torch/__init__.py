"""Global redundancy resolution: one smooth, repeatable, checked configuration for every pose of a redundant arm.

The names below are imported when they are first used, so that `import grr_torch` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grr_torch.applications.path import Path
    from grr_torch.applications.self_motion import SelfMotionManifold, self_motion_manifold
    from grr_torch.applications.solve import Solution
    from grr_torch.applications.teleoperate import Command, Teleoperator
    from grr_torch.errors import GrrError, GrrWarning
    from grr_torch.learning.dataset import RoadmapDataset
    from grr_torch.learning.evaluate import evaluate_ik
    from grr_torch.learning.export import export_dataset
    from grr_torch.learning.neural_ik import NeuralIK
    from grr_torch.learning.options import TrainingOptions
    from grr_torch.learning.split import Split
    from grr_torch.learning.train import train_ik
    from grr_torch.projection.continuity import is_continuous
    from grr_torch.projection.project import Tolerances, project
    from grr_torch.resolution.build import build
    from grr_torch.resolution.expand import expand
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.load import load_robot
    from grr_torch.robots.presets import load_preset, robot_names
    from grr_torch.robots.robot import Robot
    from grr_torch.robots.spheres import SphereModel
    from grr_torch.spaces.graph import TaskGraph, random_graph, staggered_grid
    from grr_torch.spaces.product import product_graph
    from grr_torch.spaces.task import FixedRotation, Position, TaskSpace, make_task
    from grr_torch.spaces.turning import Axis, Pose, Yaw
    from grr_torch.version import __version__

_HOMES = {
    "SelfMotionManifold": "applications.self_motion",
    "self_motion_manifold": "applications.self_motion",
    "Path": "applications.path",
    "Solution": "applications.solve",
    "Command": "applications.teleoperate",
    "Teleoperator": "applications.teleoperate",
    "GrrError": "errors",
    "GrrWarning": "errors",
    "RoadmapDataset": "learning.dataset",
    "evaluate_ik": "learning.evaluate",
    "export_dataset": "learning.export",
    "NeuralIK": "learning.neural_ik",
    "TrainingOptions": "learning.options",
    "Split": "learning.split",
    "train_ik": "learning.train",
    "is_continuous": "projection.continuity",
    "Tolerances": "projection.project",
    "project": "projection.project",
    "build": "resolution.build",
    "expand": "resolution.expand",
    "Roadmap": "resolution.roadmap",
    "load_robot": "robots.load",
    "load_preset": "robots.presets",
    "robot_names": "robots.presets",
    "Robot": "robots.robot",
    "SphereModel": "robots.spheres",
    "TaskGraph": "spaces.graph",
    "random_graph": "spaces.graph",
    "staggered_grid": "spaces.graph",
    "product_graph": "spaces.product",
    "FixedRotation": "spaces.task",
    "Position": "spaces.task",
    "TaskSpace": "spaces.task",
    "make_task": "spaces.task",
    "Axis": "spaces.turning",
    "Pose": "spaces.turning",
    "Yaw": "spaces.turning",
    "__version__": "version",
}

__all__ = [
    "Axis",
    "Command",
    "FixedRotation",
    "GrrError",
    "GrrWarning",
    "NeuralIK",
    "Path",
    "Pose",
    "Position",
    "Roadmap",
    "RoadmapDataset",
    "Robot",
    "SelfMotionManifold",
    "Solution",
    "SphereModel",
    "Split",
    "TaskGraph",
    "TaskSpace",
    "Teleoperator",
    "Tolerances",
    "TrainingOptions",
    "Yaw",
    "__version__",
    "build",
    "evaluate_ik",
    "expand",
    "export_dataset",
    "is_continuous",
    "load_preset",
    "load_robot",
    "make_task",
    "product_graph",
    "project",
    "random_graph",
    "robot_names",
    "self_motion_manifold",
    "staggered_grid",
    "train_ik",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'grr_torch' has no attribute '{name}'")
    return getattr(importlib.import_module(f"grr_torch.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
