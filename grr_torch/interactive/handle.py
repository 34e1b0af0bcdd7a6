"""The handle that the target is dragged and turned by."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from trimesh.geometry import align_vectors

from grr_torch.recording.self_motion_view import in_space
from grr_torch.spaces.rotation import matrix_from_quaternion, quaternion_from_matrix
from grr_torch.spaces.task import Axis, TaskSpace

# where it is turned away from the target by as much as this [m], it is turned back
_BESIDE = 1e-6


class Handle:
    """A handle on the page at a point of the task space; it turns where rotation varies.

    Attributes:
        controls: What viser shows.
    """

    def __init__(
        self,
        server: Any,
        task: TaskSpace,
        size: float,
        target: tuple[float, ...],
        dragged: Callable[[list[float]], None],
    ) -> None:
        """Adds it to the page.

        Args:
            server: The page's server.
            task: The task space.
            size: Its size [m].
            target: (width,) where it is.
            dragged: Told the point (width,) to which somebody has dragged it.
        """
        self._task = task
        self.controls = server.scene.add_transform_controls(
            "/target",
            scale=size,
            line_width=3.5,
            # in the plane it would have no ring to turn it by
            active_axes=(True, True, task.dimension == 3 or task.rotations is not None),
            disable_rotations=task.rotations is None,
            depth_test=False,
            position=self._position(target),
            wxyz=self._turned(target),
        )

        async def on_update(_: Any) -> None:
            dragged(self.point())

        self.controls.on_update(on_update)

    def point(self) -> list[float]:
        """(width,) the point that it is at."""
        rotation = matrix_from_quaternion(torch.tensor(self.controls.wxyz, dtype=torch.float64))
        position = torch.tensor(self.controls.position, dtype=torch.float64)
        point: list[float] = self._task.at(position[:, None], rotation[..., None])[:, 0].tolist()
        return point

    def show(self, target: tuple[float, ...]) -> None:
        """Puts it to a target (width,); of what the target leaves open, it keeps its own."""
        # in the plane it can be dragged out of it
        if not np.allclose(self.controls.position, self._position(target), atol=1e-9):
            self.controls.position = self._position(target)
        if self._task.gap_of_few(np.array(self.point()), np.array(target)) > _BESIDE:
            self.controls.wxyz = self._turned(target)

    def _position(self, point: tuple[float, ...]) -> np.ndarray:
        position: np.ndarray = in_space(np.array(point[: self._task.dimension])[None])[0]
        return position

    def _turned(self, point: tuple[float, ...]) -> np.ndarray:
        """(4,) a quaternion at a point, any of those that the point leaves open."""
        if self._task.rotations is None:
            return np.array([1.0, 0.0, 0.0, 0.0])
        rotations = self._task.matrices(torch.tensor(point, dtype=torch.float64)[:, None])
        if rotations is None:
            assert isinstance(self._task, Axis)
            rotations = torch.from_numpy(align_vectors(self._task.unit_axis, point[3:])[:3, :3, None])
        quaternion: np.ndarray = quaternion_from_matrix(rotations[..., 0]).numpy()
        return quaternion
