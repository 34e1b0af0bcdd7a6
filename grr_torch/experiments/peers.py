"""Other libraries at the same work: pytorch-kinematics, Pinocchio and Klampt, where they are installed."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lxml import etree
from torch import Tensor

from grr_torch.errors import UnknownNameError
from grr_torch.projection.project import Tolerances
from grr_torch.robots.robot import Robot

# the module and the package of each
PEERS = {
    "pytorch-kinematics": ("pytorch_kinematics", "pytorch-kinematics"),
    "Pinocchio": ("pinocchio", "pin"),
    "Klampt": ("klampt", "klampt"),
}


def installed_peers(names: tuple[str, ...] | None = None) -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the peers that are installed, and of the others how to install them.

    Args:
        names: Those that are wanted, in any case; all by default.

    Raises:
        UnknownNameError: No such peer.
    """
    by_name = {name.lower(): name for name in PEERS}
    for name in names or ():
        if name.lower() not in by_name:
            raise UnknownNameError("peer", name, tuple(PEERS))
    wanted = [by_name[name.lower()] for name in names] if names is not None else list(PEERS)
    found: dict[str, str] = {}
    missing: dict[str, str] = {}
    for name in wanted:
        module, package = PEERS[name]
        if importlib.util.find_spec(module) is None:
            missing[name] = "not installed: pip install 'grr-torch[bench]'"
        else:
            try:
                found[name] = version(package)
            except PackageNotFoundError:
                found[name] = "of unknown version"
    return found, missing


def pytorch_kinematics_jacobian(robot: Robot, q: Tensor) -> Callable[[], Any]:
    """Poses and Jacobians of all configurations q (N, n) in one call."""
    return lambda: robot.chain.jacobian(q, ret_eef_pose=True)


def pinocchio_jacobian(robot: Robot, q: Tensor) -> Callable[[], Any]:
    """The Jacobians of configurations q (N, n), one call each, into one array."""
    import numpy as np
    import pinocchio

    with _bare_urdf(robot) as path:
        # without continuous joints: an entry of a configuration a joint
        model = pinocchio.buildModelFromUrdf(str(path))
    data, frame = model.createData(), model.getFrameId(robot.tool)
    world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    rows = []
    for values in q.tolist():
        row = pinocchio.neutral(model)
        for name, value in zip(robot.joint_names, values, strict=True):
            row[model.joints[model.getJointId(name)].idx_q] = value
        rows.append(row)
    out = np.empty((len(rows), 6, model.nv))

    def run() -> None:
        for index, row in enumerate(rows):
            out[index] = pinocchio.computeFrameJacobian(model, data, row, frame, world)

    return run


def klampt_ik(
    robot: Robot, position: Tensor, rotation: Tensor, guesses: Tensor, tolerances: Tolerances
) -> Callable[[], int]:
    """Solves for poses (N, 3) and (N, 3, 3) from guesses (N, n), one call each, and counts those it solved."""
    from klampt import WorldModel
    from klampt.model import ik

    world = WorldModel()
    with _bare_urdf(robot) as path, _quiet():
        world.loadRobot(str(path))
    arm = world.robot(0)
    names = [arm.link(index).getName() for index in range(arm.numLinks())]
    moving = [names.index(robot.urdf.joints[name].child) for name in robot.joint_names]
    tool = arm.link(names.index(robot.tool)) if robot.tool in names else arm.link(arm.numLinks() - 1)
    starts = []
    for guess in guesses.tolist():
        start = [0.0] * arm.numLinks()
        for index, value in zip(moving, guess, strict=True):
            start[index] = value
        starts.append(start)
    # its rotations are lists of columns
    columns = rotation.transpose(1, 2).reshape(-1, 9).tolist()
    poses = list(zip(position.tolist(), columns, strict=True))
    solver = ik.IKSolver(arm)
    solver.setMaxIters(tolerances.iterations)
    solver.setTolerance(tolerances.position)
    solver.setActiveDofs(moving)

    def run() -> int:
        arm = world.robot(0)  # the world must outlive its robot
        found = []
        for start, (place, turn) in zip(starts, poses, strict=True):
            arm.setConfig(start)
            solver.clear()
            solver.add(ik.objective(tool, R=turn, t=place))
            if solver.solve():
                found.append(arm.getConfig())
        return len(found)

    return run


@contextmanager
def _bare_urdf(robot: Robot) -> Iterator[Path]:
    """The robot's URDF for readers that know neither its shapes nor joints without limits."""
    root = etree.fromstring(robot.urdf.text.encode())
    for shape in [*root.iter("visual"), *root.iter("collision")]:
        shape.getparent().remove(shape)
    for joint in root.iter("joint"):
        limit = joint.find("limit")
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            limit = etree.SubElement(joint, "limit") if limit is None else limit
            limit.attrib.update({"lower": "-100", "upper": "100"})
        if limit is not None:
            limit.attrib.update({"effort": "1", "velocity": "1"})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bare.urdf"
        path.write_bytes(etree.tostring(root))
        yield path


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what a C++ library prints to standard output and error."""
    saved = [os.dup(1), os.dup(2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        os.dup2(null, 2)
        yield
    finally:
        for descriptor, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(null)
