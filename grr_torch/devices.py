"""Tensors that are needed on several devices, and copied to each of them once."""

from __future__ import annotations

import torch
from torch import Tensor


class OnDevices:
    """Constant tensors wherever they are asked for; a device gets its copies the first time."""

    def __init__(self, *tensors: Tensor):
        self._copies = {tensors[0].device: tensors}

    def at(self, device: torch.device) -> tuple[Tensor, ...]:
        """The tensors on a device."""
        if device not in self._copies:
            given = next(iter(self._copies.values()))
            self._copies[device] = tuple(tensor.to(device) for tensor in given)
        return self._copies[device]

    def like(self, other: Tensor) -> tuple[Tensor, ...]:
        """The tensors where another one is, and of its dtype."""
        return tuple(tensor.to(other.dtype) for tensor in self.at(other.device))
