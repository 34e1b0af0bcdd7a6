"""The arm and the task that a command is asked for: the options that say them, and what they make."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.options import named_numbers, numbers

if TYPE_CHECKING:
    from grr_torch.robots.robot import Robot

TaskKind = Annotated[
    str | None, typer.Option(help="position, fixed-rotation, yaw, axis or pose; the preset's default, or position.")
]
Rotation = Annotated[
    str | None,
    typer.Option(
        help="Fixed-axis roll, pitch, yaw of the tool in radians, for fixed-rotation, and for yaw at yaw 0; 0 0 0 "
        "without a preset.",
        metavar="R P Y",
    ),
]
Axis = Annotated[
    str | None,
    typer.Option(
        help="For yaw, what the tool turns about, in the base frame; for axis, the tool's axis, in its own; 0 0 1.",
        metavar="X Y Z",
    ),
]
Tool = Annotated[str | None, typer.Option(help="Link whose pose is controlled; needed if the URDF has several ends.")]
Base = Annotated[str | None, typer.Option(help="Link in whose frame points are given.")]
PackageDirs = Annotated[list[Path] | None, typer.Option(help="Folder for package:// meshes; repeatable.")]
AllowMissingMeshes = Annotated[
    bool, typer.Option("--allow-missing-meshes", help="Go on where meshes are missing: the arm is shown without them.")
]
Held = Annotated[list[str] | None, typer.Option(help="Hold a joint still; repeatable.", metavar="J=VALUE")]
Spheres = Annotated[Path | None, typer.Option(help="Sphere file for self-collision (grr-torch spheres).")]
Margin = Annotated[float | None, typer.Option(help="Added to every self-collision check, in metres.")]


def load_arm(
    robot: str,
    *,
    tool: str | None,
    base: str | None,
    package_dir: Sequence[Path] | None,
    allow_missing_meshes: bool,
    hold: Sequence[str] | None,
    spheres: Path | None,
    margin: float | None,
    device: str = "cpu",
) -> Robot:
    """The robot that the options say."""
    from grr_torch.robots.load import load_robot

    return load_robot(
        robot,
        tool=tool,
        base=base,
        package_dirs=package_dir or (),
        allow_missing_meshes=allow_missing_meshes,
        held_joints=named_numbers("--hold", hold or (), "JOINT=VALUE, the value in radians or metres"),
        spheres=spheres,
        margin=margin,
        device=device,
    )


def read_turning(rotation: str | None, axis: str | None) -> dict[str, list[float] | None]:
    """What --rotation and --axis say, as `complete_task` takes it."""
    return {
        "rpy": None if rotation is None else numbers("--rotation", rotation, ("roll", "pitch", "yaw")),
        "axis": None if axis is None else numbers("--axis", axis, ("x", "y", "z")),
    }
