"""Samples of self-motion manifolds of two or more dimensions, and what of them hangs together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from grr_torch.progress import Progress
from grr_torch.projection.columns import null_space_projector
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# a sample is joined to so many of its nearest, and across components to so many
_NEIGHBOURS, _ACROSS = 8, 3
# samples of a component that are tried to join it to others, and how often all are tried
_TRIED, _ROUNDS = 40, 6
_STEP_ROUNDS = 8
# of the continuity check: largest deviation as a share of the distance, and what is short [rad]
_C, _EPSILON = 0.8, 0.05


@dataclass(frozen=True)
class Sampler:
    """Samples the manifold of one point.

    Attributes:
        robot: The robot.
        task: The task space.
        target: (width, 1) the point.
        step: Length of random steps [rad].
        tolerances: Of the projections.
        generator: Of the random steps.
    """

    robot: Robot
    task: TaskSpace
    target: Tensor
    step: float
    tolerances: Tolerances
    generator: torch.Generator

    def components(self, starts: Tensor, count: int, progress: Progress) -> tuple[Tensor, Tensor, Tensor]:
        """Samples grown from starts (n, K), and what hangs together.

        Returns:
            Samples (n, S), S ≤ count; the component of each (S,); edges (E, 2) that were checked.
        """
        q, edges = self._grow(starts, count, progress)
        edges = torch.cat([edges, self._checked(q, self._nearest_pairs(q, _NEIGHBOURS, progress))])
        labels = _labels(q.shape[1], edges)
        for done in range(_ROUNDS):
            progress("joining components", done, _ROUNDS)
            more = self._checked(q, self._pairs_across(q, labels))
            edges = torch.cat([edges, more])
            labels = _labels(q.shape[1], edges)
            if len(more) == 0:
                break
        progress("joining components", _ROUNDS, _ROUNDS)
        return q, labels, edges.sort(1).values.unique(dim=0)

    def _grow(self, q: Tensor, count: int, progress: Progress) -> tuple[Tensor, Tensor]:
        """Samples (n, S) and edges (E, 2): from random samples random steps lead to new ones, up to a count."""
        edges = [torch.empty(0, 2, dtype=torch.long, device=q.device)]
        q = q[:, :count]
        for _ in range(_STEP_ROUNDS):
            progress("sampling the manifold", q.shape[1], count)
            wanted = min(count - q.shape[1], q.shape[1])
            if wanted == 0:
                break
            parents = torch.randperm(q.shape[1], generator=self.generator)[:wanted].to(q.device)
            moved, valid = self._random_steps(q[:, parents])
            both = torch.stack([parents, q.shape[1] + torch.arange(wanted, device=q.device)], 1)
            all_of_them = torch.cat([q, moved.nan_to_num()], 1)
            valid &= self._continuous(all_of_them, both)
            kept = valid.nonzero()[:, 0]
            fresh = q.shape[1] + torch.arange(len(kept), device=q.device)
            edges.append(torch.stack([parents[kept], fresh], 1))
            q = torch.cat([q, moved[:, kept]], 1)
        progress("sampling the manifold", count, count)
        return q, torch.cat(edges)

    def _random_steps(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """From each q (n, N) a step in a random direction along the manifold, projected (n, N), and valid (N,)."""
        jacobian = self.task.jacobian(self.robot.tree.jacobian(self.robot.tree.frames(q)), self.target)
        projector = null_space_projector(jacobian, 1e3 * torch.finfo(q.dtype).eps)
        noise = torch.randn(*q.shape, dtype=q.dtype, generator=self.generator).to(q.device)
        motion = (projector * noise).sum(1)
        motion = self.step * motion / motion.norm(dim=0).clamp_min(1e-12)
        targets = self.target.expand(-1, q.shape[1]).contiguous()
        return project_columns(self.robot, self.task, targets, q + motion, self.tolerances, check_collision=False)

    def _nearest_pairs(self, q: Tensor, k: int, progress: Progress) -> Tensor:
        """Each sample of q (n, S) with its k nearest: (P, 2), each pair once."""
        count = q.shape[1]
        progress("joining components", 0, _ROUNDS)
        wraps = self.robot.continuous
        nearest = search_tree(q, wraps).query(in_box(q, wraps), k=range(1, min(k + 1, count) + 1))[1]
        first = np.repeat(np.arange(count), nearest.shape[1])
        return _pairs(first, nearest.ravel()).to(q.device)

    def _pairs_across(self, q: Tensor, labels: Tensor) -> Tensor:
        """Samples of each component but the largest with the nearest ones of all others: (P, 2)."""
        found = [np.empty((0, 2), dtype=np.int64)]
        sizes = labels.bincount()
        wraps = self.robot.continuous
        rows, of = in_box(q, wraps), labels.cpu().numpy()
        for label in sizes.argsort(descending=True)[1:].tolist():
            inside, outside = np.flatnonzero(of == label), np.flatnonzero(of != label)
            tree = search_tree(q[:, torch.from_numpy(outside).to(q.device)], wraps)
            ranks = range(1, min(_ACROSS, len(outside)) + 1)
            gaps, nearest = tree.query(rows[inside], k=ranks)
            close = gaps[:, 0].argsort(kind="stable")[:_TRIED]
            pairs = np.stack([np.repeat(inside[close], nearest.shape[1]), outside[nearest[close]].ravel()], 1)
            found.append(pairs)
        pairs = np.concatenate(found)
        return _pairs(pairs[:, 0], pairs[:, 1]).to(q.device)

    def _checked(self, q: Tensor, pairs: Tensor) -> Tensor:
        """Those of the pairs (P, 2) that a self-motion joins."""
        return pairs[self._continuous(q, pairs)]

    def _continuous(self, q: Tensor, pairs: Tensor) -> Tensor:
        """Which pairs (P, 2) of samples pass the continuity check at the one point: (P,)."""
        first, second = q.T[pairs[:, 0]], q.T[pairs[:, 1]]
        points = self.target.T.expand(len(pairs), -1)
        return is_continuous(
            self.robot,
            self.task,
            points,
            points,
            first,
            second,
            c=_C,
            epsilon=_EPSILON,
            tolerances=self.tolerances,
        )


def search_tree(q: Tensor, continuous: Tensor) -> cKDTree:
    """A search tree of configurations (n, S) by D_q, to be asked for what `in_box` gives."""
    return cKDTree(in_box(q, continuous), boxsize=np.where(continuous.cpu().numpy(), 2.0 * math.pi, 0.0))


def in_box(q: Tensor, continuous: Tensor) -> np.ndarray:
    """Configurations (n, S) as rows (S, n), continuous joints in [0, 2π)."""
    rows: np.ndarray = q.T.cpu().numpy().astype(np.float64)
    box = np.mod(rows, 2.0 * math.pi)
    return np.where(continuous.cpu().numpy(), np.where(box >= 2.0 * math.pi, 0.0, box), rows)


def _pairs(first: np.ndarray, second: np.ndarray) -> Tensor:
    """Pairs (P, 2) of different samples, smaller number first, each once."""
    pairs = np.sort(np.stack([first, second], 1), axis=1)
    return torch.from_numpy(np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0).astype(np.int64))


def _labels(count: int, edges: Tensor) -> Tensor:
    """The component (S,) of each sample, by the edges (E, 2)."""
    first, second = edges.cpu().numpy().T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    return torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64)).to(edges.device)
