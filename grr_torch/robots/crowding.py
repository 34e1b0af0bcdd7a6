"""Sphere models by which nearly every configuration is in self-collision: no arm can be used with one."""

from __future__ import annotations

import torch

from grr_torch.robots.robot import Robot

# a model by which more than this share of random configurations is in self-collision is seldom meant
CROWDED = 0.9
_SAMPLES = 1000
# pairs of links that are named
_NAMED = 3


def crowding(robot: Robot, share: float = CROWDED) -> str:
    """Says how many random configurations are in self-collision, and between which links, if many are.

    Args:
        robot: The robot.
        share: Up to which nothing is said.

    Returns:
        A clause such as "97.1 % of random configurations are in self-collision, mostly a – b (96.0 %)"; empty if fewer
        are.
    """
    q = robot.sample(_SAMPLES, torch.Generator().manual_seed(0))
    found = float(robot.in_self_collision(q).double().mean())
    if found <= share:
        return ""
    pairs = sorted(robot.collision_shares(q).items(), key=lambda pair: -pair[1])[:_NAMED]
    named = ", ".join(f"{first} – {second} ({100.0 * part:.1f} %)" for (first, second), part in pairs if part > 0.0)
    return f"{100.0 * found:.1f} % of random configurations are in self-collision, mostly {named}"
