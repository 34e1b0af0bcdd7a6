"""Tensors that are needed on several devices, and copied to each of them once."""

from __future__ import annotations

import torch
from torch import Tensor


class OnDevices:
    """Constant tensors wherever they are asked for; a device gets its copies the first time.

    They can be differentiated with, also if they were first asked for in inference mode. What is pickled has no copies.
    """

    def __init__(self, *tensors: Tensor):
        with torch.inference_mode(False):
            self._given = tuple(tensor.clone() if tensor.is_inference() else tensor for tensor in tensors)
        self._copies: dict[tuple[torch.device, torch.dtype | None], tuple[Tensor, ...]] = {}

    def __reduce__(self) -> tuple[type[OnDevices], tuple[Tensor, ...]]:
        return OnDevices, self._given

    def at(self, device: torch.device, dtype: torch.dtype | None = None) -> tuple[Tensor, ...]:
        """The tensors on a device, of their own dtype by default."""
        key = device, dtype
        if key not in self._copies:
            with torch.inference_mode(False):
                self._copies[key] = tuple(tensor.to(device=device, dtype=dtype) for tensor in self._given)
        return self._copies[key]

    def like(self, other: Tensor) -> tuple[Tensor, ...]:
        """The tensors where another one is, and of its dtype."""
        return self.at(other.device, other.dtype)
