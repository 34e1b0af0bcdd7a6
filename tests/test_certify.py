"""Certification: cells whose corners lead to configurations a little too far apart are drawn together."""

from __future__ import annotations

import pytest
import torch

import grr_torch
from grr_torch.progress import silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution import certify as certification
from grr_torch.resolution.cells import spreads
from grr_torch.resolution.certify import certify
from grr_torch.resolution.problem import pose_problem
from grr_torch.resolution.refine import _network, refine


@pytest.mark.parametrize("every_cell_each_round", [False, True])
def test_certification_certifies_more_cells(planar_5, monkeypatch, every_cell_each_round):
    if every_cell_each_round:
        monkeypatch.setattr(certification, "_leeway", lambda spread, *_: torch.zeros_like(spread))
    plain = grr_torch.build(planar_5, "fixed-rotation", points=400, refine=False)
    vertices = plain.resolved.nonzero()[:, 0]
    rank = torch.full_like(plain.resolved, -1, dtype=torch.long).index_put_((vertices,), torch.arange(len(vertices)))
    net = _network(plain, vertices, rank[plain.edges[plain.connected]], {})
    cells = rank[plain.graph.triangles(plain.connected)]

    def uncertified(q):
        return int((spreads(planar_5, plain.task, net.targets.T, q, cells, Tolerances()) > 1.0).sum())

    q = plain.configurations[vertices]
    moved = certify(net, cells, q.T.contiguous(), Tolerances(), silent).T
    assert uncertified(moved) <= 0.8 * uncertified(q)
    position = planar_5.forward_kinematics(moved)[0][:, :2]
    assert float((position - net.targets.T).norm(dim=1).max()) <= 1e-4


@pytest.mark.parametrize(("name", "limits"), [("kinova", [1.4, 1.4, 1.1]), ("planar_5", [1.4, 1.4, 1.7])])
def test_a_second_attempt_leaves_fewer_cells_uncertified(monkeypatch, name, limits):
    attempt, given_up_from, left = certification._drawn_together, [], []

    def noted(*given):
        given_up_from.append(given[5])
        return attempt(*given)

    monkeypatch.setattr(certification, "_drawn_together", noted)
    for most in (0, 10**9):
        monkeypatch.setattr(certification, "_MOST_TWICE", most)
        quality = grr_torch.build(grr_torch.load_robot(name), "position").quality()
        left.append(quality.triangles_spread + quality.triangles_wound)
    assert given_up_from == limits
    assert left[1] < left[0]


@pytest.mark.parametrize("draw", [1, 5])
def test_what_is_certified_does_not_hang_on_the_last_digits(draw):
    kinova = grr_torch.load_robot("kinova")
    seeds = torch.as_tensor(pose_problem(kinova, "position", None, None, None, None).seeds, dtype=torch.float64)
    noise = 1e-9 * torch.randn(seeds.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(draw))
    quality = grr_torch.build(kinova, "position", seeds=seeds + noise).quality()
    assert quality.triangles_certified >= 0.99
    assert quality.connected_edges >= 0.998 * 6105


def test_what_may_have_to_be_drawn_together_is_measured_again():
    spread = torch.tensor([0.5, 0.93, 1.2, 1.4, 2.0, torch.inf])
    torch.testing.assert_close(certification._leeway(spread, 0.93, 1.4), torch.tensor([0.43, 0.0, 0.0, 0.0, 0.6, 0.0]))


def test_cells_that_are_not_measured_after_certification_are_certified(planar_5, monkeypatch):
    plain, measured = grr_torch.build(planar_5, "pose", points=200, refine=False), []
    whole = certification.spreads

    def noted(*arguments):
        measured.append((arguments, whole(*arguments)))
        return measured[-1][1]

    monkeypatch.setattr(certification, "spreads", noted)
    monkeypatch.setattr(certification, "_MOST_TWICE", 0)
    refine(plain)
    (before, spread), (after, again) = measured
    assert 0 < len(again) < 0.3 * len(spread)
    assert int((again > 1.0).sum()) == int((whole(*after[:4], before[4], *after[5:]) > 1.0).sum())
    # some that were certified are not any more
    assert len(again) > int((spread > 1.0).sum())
