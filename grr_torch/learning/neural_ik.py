"""A trained network as inverse kinematics, and its file."""

from __future__ import annotations

import copy
import hashlib
import json
import os
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import FileFormatError, GrrError, ParameterError
from grr_torch.learning.network import Architecture, IkNetwork
from grr_torch.learning.refine import newton_steps
from grr_torch.pieces import one_thread, together
from grr_torch.projection.project import Tolerances, point_columns
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.roadmap_file import roadmap_hash
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace, task_from_json
from grr_torch.tensor_file import read_tensor_file, tensors_hash, write_tensors
from grr_torch.version import __version__

FORMAT = "grr-torch neural IK"
FORMAT_VERSION = 1
# points that go through the network together
_AT_ONCE = 2048


@dataclass(frozen=True)
class Origin:
    """What a network was made for and from.

    Attributes:
        robot: The robot's name.
        robot_hash: SHA-256 of its kinematics: URDF, base, tool, held joints.
        joint_names: The joints of its output.
        continuous: Which of them are continuous.
        task: The task space.
        tolerances: When a configuration counts as being at a point.
        roadmap_hash: SHA-256 of the roadmap's tensors.
        training: How it was trained, and how well it did.
    """

    robot: str
    robot_hash: str
    joint_names: tuple[str, ...]
    continuous: tuple[bool, ...]
    task: TaskSpace
    tolerances: Tolerances
    roadmap_hash: str
    training: dict[str, Any]

    @staticmethod
    def of(roadmap: Roadmap, training: dict[str, Any]) -> Origin:
        """That of a network which learns a roadmap."""
        robot = roadmap.robot
        return Origin(
            robot.name,
            robot_hash(robot),
            robot.joint_names,
            tuple(robot.continuous.tolist()),
            roadmap.task,
            Tolerances(**roadmap.parameters["tolerances"]),
            roadmap_hash(roadmap),
            training,
        )

    def to_dict(self) -> dict[str, Any]:
        """For metadata."""
        return {
            **self.__dict__,
            "task": self.task.to_json(),
            "tolerances": dict(self.tolerances.__dict__),
            "units": {"points": "m", "configurations": "rad (prismatic joints: m)"},
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Origin:
        """Reads what `to_dict` gave."""
        return Origin(
            str(data["robot"]),
            str(data["robot_hash"]),
            tuple(map(str, data["joint_names"])),
            tuple(map(bool, data["continuous"])),
            task_from_json(data["task"]),
            Tolerances(**data["tolerances"]),
            str(data["roadmap_hash"]),
            dict(data["training"]),
        )


class NeuralIK:
    """A network that has learned a roadmap: from points straight to configurations.

    Attributes:
        network: The network, float32, on the robot's device: points (N, d) [m] to configurations (N, n) [rad or m];
            encoding inside.
        robot: The robot.
        task: The task space.
        origin: What it was made for and from.
    """

    def __init__(self, network: IkNetwork, robot: Robot, origin: Origin) -> None:
        """Puts a network and a robot together.

        Raises:
            ParameterError: The network was made for another robot.
        """
        if robot_hash(robot) != origin.robot_hash:
            given = f"weights for {origin.robot} with joints {', '.join(origin.joint_names)}"
            raise ParameterError("weights", given, f"weights for this {robot.name} with its base, tool and held joints")
        elsewhere = network.encoding.scale.device != robot.device
        self.network = (copy.deepcopy(network).to(robot.device) if elsewhere else network).eval()
        self.robot = robot
        self.task, self.origin = origin.task, origin

    def __call__(self, points: Tensor) -> Tensor:
        """What the network makes of points (*batch, d) [m]: configurations (*batch, n) [rad or m], unchecked.

        The tool is near the points, millimetres away, as long as they lie in the roadmap's certified cells; elsewhere
        anything may come out. `refine` brings the tool there, and says where it succeeded.

        Raises:
            ParameterError: The width is not the task's, or a value is not finite.
        """
        rows = point_columns(self.robot, self.task, points).T
        q = rows.new_empty(len(rows), self.robot.n)
        at_once = together(_AT_ONCE, rows.device)
        with torch.no_grad(), one_thread():
            # what is a piece here is read, computed and written while it is in the cache
            for start in range(0, len(rows), at_once):
                part = slice(start, start + at_once)
                q[part] = self.network(rows[part].to(torch.float32, memory_format=torch.contiguous_format))
        return q.reshape(*points.shape[:-1], self.robot.n)

    def refine(self, points: Tensor, steps: int = 2) -> tuple[Tensor, Tensor]:
        """The network's configurations after a few Newton steps towards the points.

        Args:
            points: (*batch, d) points [m].
            steps: How many.

        Returns:
            Configurations (*batch, n), NaN where not valid, and valid (*batch,): the tool is at the point within the
            tolerances of the roadmap, all joints within limits, and the arm free of self-collision.

        Raises:
            ParameterError: The width is not the task's, a value is not finite, or `steps` is negative.
        """
        q, valid = newton_steps(self.robot, self.task, points, self(points), steps, self.origin.tolerances)
        return torch.where(valid[..., None], q, torch.nan), valid

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes weights and origin to one safetensors file, by an atomic rename.

        Raises:
            OutputError: It cannot be written.
        """
        save_network(path, self.network, self.origin)

    @staticmethod
    def load(path: str | os.PathLike[str], robot: Robot | Roadmap) -> NeuralIK:
        """Reads a file of weights.

        Args:
            path: The file.
            robot: The robot that they are for, or a roadmap of it.

        Raises:
            FileFormatError: It is missing, truncated, of another version, no such file, or not consistent.
            ParameterError: The weights are for another robot.
        """
        network, origin = load_network(path)
        return NeuralIK(network, robot if isinstance(robot, Robot) else robot.robot, origin)


def save_network(path: str | os.PathLike[str], network: IkNetwork, origin: Origin) -> None:
    """Writes a network and where it comes from; see `NeuralIK.save`."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    metadata = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        "architecture": network.architecture.to_dict(),
        "origin": origin.to_dict(),
        "tensors_sha256": tensors_hash(tensors),
    }
    write_tensors(path, tensors, {key: json.dumps(value) for key, value in metadata.items()})


def load_network(path: str | os.PathLike[str]) -> tuple[IkNetwork, Origin]:
    """Reads what `save_network` wrote, without the robot.

    Raises:
        FileFormatError: It is missing, truncated, of another version, no such file, or not consistent.
    """
    metadata, tensors = read_tensor_file(path, FORMAT, FORMAT_VERSION, "a file of neural IK weights")
    try:
        origin = Origin.from_dict(metadata["origin"])
        network = IkNetwork(origin.continuous, origin.task.width, Architecture(**metadata["architecture"]))
        stored = metadata["tensors_sha256"]
    except (KeyError, TypeError, ValueError, AttributeError, GrrError) as error:
        raise FileFormatError(path, f"has metadata that cannot be used: {error}") from error
    if tensors_hash(tensors) != stored:
        raise FileFormatError(path, "has weights that are not those that were written")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise FileFormatError(path, f"has weights that do not fit its architecture: {error}") from error
    return network, origin


def robot_hash(robot: Robot) -> str:
    """SHA-256 of what decides where a robot's tool is: URDF, base, tool and held joints."""
    held = sorted(robot.held_joints.items())
    text = json.dumps([robot.urdf.text, robot.base, robot.tool, list(robot.joint_names), held])
    return hashlib.sha256(text.encode()).hexdigest()
