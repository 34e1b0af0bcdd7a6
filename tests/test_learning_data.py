"""What is drawn from a roadmap to learn from: points, parts and encoded configurations."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

import grr_torch
from grr_torch import RoadmapDataset, Split
from grr_torch.learning.encoding import Encoding
from grr_torch.learning.region import Region, certified_region
from grr_torch.learning.split import SPLITS
from grr_torch.spaces.configuration import distance


@pytest.fixture(scope="module")
def kinova_roadmap(kinova) -> grr_torch.Roadmap:
    return grr_torch.build(kinova, "fixed-rotation", refine=False)


@pytest.fixture(scope="module")
def random_roadmap(planar_5) -> grr_torch.Roadmap:
    """Over a random graph instead of a grid."""
    generator = torch.Generator().manual_seed(0)
    graph = grr_torch.random_graph([(-0.5, 0.5), (-0.5, 0.5)], 300, k=8, generator=generator)
    return grr_torch.build(planar_5, "position", points=graph)


# encoding


@given(
    continuous=st.lists(st.booleans(), min_size=1, max_size=8),
    batch=st.sampled_from([(), (1,), (3, 1, 2)]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=50)
def test_decoding_gives_back_what_was_encoded(continuous, batch, seed):
    generator = torch.Generator().manual_seed(seed)
    n = len(continuous)
    encoding = Encoding(continuous, 3).double()
    limits = torch.rand(n, dtype=torch.float64, generator=generator) + 0.1
    encoding.reach.copy_(torch.where(torch.tensor(continuous), 1.0, limits))
    q = (2.0 * torch.rand(*batch, n, dtype=torch.float64, generator=generator) - 1.0) * math.pi
    encoded = encoding.encode(q)
    assert encoded.shape == (*batch, encoding.width)
    assert torch.allclose(encoding.decode(encoded), q, atol=1e-12)
    turned = q + 2.0 * math.pi * torch.tensor(continuous).double()
    assert torch.allclose(encoding.encode(turned), encoded, atol=1e-12)
    pairs = torch.tensor(continuous)
    assert torch.allclose(encoded[..., :n][..., pairs].square() + encoded[..., n:].square(), torch.tensor(1.0).double())


def test_limits_are_encoded_as_one(kinova_roadmap, kinova):
    encoding = Encoding.of(kinova_roadmap)
    limited = ~kinova.continuous
    upper = torch.where(kinova.continuous, 0.0, kinova.upper)
    assert torch.allclose(encoding.encode(upper)[:7][limited], torch.ones(1, dtype=torch.float64))
    assert float(encoding.normalise(kinova_roadmap.points[kinova_roadmap.resolved]).abs().max()) <= 1.0 + 1e-12


# points and parts


@pytest.mark.parametrize("which", ["planar_roadmap", "kinova_roadmap", "random_roadmap"])
def test_points_are_drawn_in_certified_cells_and_solved_there(which, request, generator):
    roadmap = request.getfixturevalue(which)
    region = certified_region(roadmap)
    points = region.draw(3000, generator)
    assert bool(region.contains(points).all())
    assert not bool(region.contains(points + 10.0).any())
    solution = roadmap.solve(points)
    assert float(solution.valid.double().mean()) > 0.99
    if roadmap.graph.lattice is not None:
        assert set(solution.status[solution.valid.numpy()]) == {"solved"}


def test_points_are_uniform_over_the_region(planar_roadmap, generator):
    region = certified_region(planar_roadmap)
    points = region.draw(200_000, generator)
    left = region.corners[:, :, 0].amax(1) <= 0.0
    expected = float(region.volumes[left].sum() / region.volumes.sum())
    inside = grr_torch.learning.region.Region(region.corners[left], region.volumes[left]).contains(points)
    assert abs(float(inside.double().mean()) - expected) < 0.01


def test_points_are_drawn_by_volume():
    corners = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[5.0, 5.0], [8.0, 5.0], [5.0, 6.0]]])
    region = Region(corners.double(), torch.tensor([0.5, 1.5], dtype=torch.float64))
    points = region.draw(20_000, torch.Generator().manual_seed(0))
    second = points[:, 0] > 3.0
    assert abs(float(second.double().mean()) - 0.75) < 0.01
    torch.testing.assert_close(points[second].mean(0), corners[1].double().mean(0), atol=0.03, rtol=0.0)


@pytest.mark.parametrize("samples", [None, 5000])
def test_parts_by_region_share_no_block(planar_roadmap, samples):
    split = Split(validation=0.2, test=0.2, block=0.07, seed=3)
    dataset = RoadmapDataset(planar_roadmap, samples, split=split)
    assert len(dataset) == sum(len(dataset.indices(part)) for part in SPLITS)
    low = planar_roadmap.points.amin(0)
    blocks = [
        set(map(tuple, ((dataset.points[dataset.indices(part)] - low) / 0.07).floor().long().tolist()))
        for part in SPLITS
    ]
    assert all(blocks)
    assert not blocks[0] & blocks[1]
    assert not blocks[0] & blocks[2]
    assert not blocks[1] & blocks[2]


def test_parts_at_random_have_their_shares(planar_roadmap):
    dataset = RoadmapDataset(planar_roadmap, 4000, split=Split("random", 0.1, 0.3))
    assert [len(dataset.indices(part)) for part in SPLITS] == [2400, 400, 1200]


def test_the_same_seed_gives_the_same_samples(planar_roadmap):
    first, second = (RoadmapDataset(planar_roadmap, 2000, seed=5) for _ in range(2))
    assert torch.equal(first.points, second.points)
    assert torch.equal(first.configurations, second.configurations)
    assert torch.equal(first.split, second.split)
    assert not torch.equal(first.points, RoadmapDataset(planar_roadmap, 2000, seed=6).points)


def test_items_are_what_the_map_says(kinova_roadmap):
    dataset = RoadmapDataset(kinova_roadmap, 500)
    inputs, targets = next(iter(DataLoader(dataset, batch_size=len(dataset))))
    assert inputs.dtype == targets.dtype == torch.float32
    points = inputs.double() * dataset.encoding.scale + dataset.encoding.centre
    assert torch.allclose(points, dataset.points, atol=1e-6)
    wraps = kinova_roadmap.robot.continuous
    assert float(distance(dataset.decode(targets.double()), dataset.configurations, wraps).max()) < 1e-5
    position, _ = kinova_roadmap.robot.forward_kinematics(dataset.configurations)
    assert float((position - dataset.points).norm(dim=1).max()) <= 1e-4
