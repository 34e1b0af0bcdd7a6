"""Relaxed IK: a weighted sum of goals, minimised at each step from the last configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.baselines.follower import Follower
from grr_torch.errors import ParameterError
from grr_torch.projection.columns import solve_spd
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# c and r of the groove loss, as published for every goal that is at its best at zero
_WIDTH = 0.2
_STEEPNESS = 5.0
# distance [m] in which the nearness of two links falls to 1/e
_NEAR = 0.01
# nearness of which the gradient is not worth computing
_FAR = 1e-4
# share of a joint's half range at which it begins to be near its limit, and the power that makes it so
_POWER = 20
# configurations drawn for the largest manipulability
_SAMPLES = 1024
# most evaluations of the objective in a step
_ITERATIONS = 12
# a step this short ends it [rad or m]
_SHORTEST_STEP = 1e-5
