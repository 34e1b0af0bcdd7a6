"""What relaxation is made of: hops lower slopes, and blending keeps every edge and most of what was gained."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch.progress import silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances, project
from grr_torch.resolution.auto_seeds import find_seeds
from grr_torch.resolution.blend import blended as blend
from grr_torch.resolution.cells import spreads
from grr_torch.resolution.certify import certify
from grr_torch.resolution.checkpoint import UNKEPT
from grr_torch.resolution.edges import check_edges, continuous_edges
from grr_torch.resolution.hops import _choose, hop
from grr_torch.resolution.relax import Network, gauss_newton_step, relax
from grr_torch.resolution.repair import repair
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.graph import staggered_grid


def network(roadmap: grr_torch.Roadmap) -> Network:
    """Of a roadmap all of whose vertices are resolved."""
    points, edges = roadmap.points, roadmap.edges
    lengths = roadmap.task.distance(points[edges[:, 0]], points[edges[:, 1]])
    return Network(roadmap.robot, roadmap.task, points.T.contiguous(), edges.T.contiguous(), lengths)


@pytest.fixture(scope="module")
def whole(planar_5) -> grr_torch.Roadmap:
    roadmap = grr_torch.build(planar_5, grr_torch.Position(2), points=150, bounds=[(-0.35, 0.35)] * 2, seeds="auto")
    assert bool(roadmap.resolved.all())
    return roadmap


def spoilt(roadmap: grr_torch.Roadmap, share: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Its configurations with a share of them replaced by unrelated valid ones, and which."""
    chosen = torch.rand(len(roadmap.points), generator=generator) < share
    start = roadmap.robot.sample(len(roadmap.points), generator)
    other, valid = project(roadmap.robot, roadmap.task, roadmap.points, start)
    chosen &= valid
    return torch.where(chosen[:, None], other, roadmap.configurations), chosen


def test_hops_lower_slopes_and_stay_on_the_task(whole, generator):
    q, _ = spoilt(whole, 0.1, generator)
    net = network(whole)
    moved = hop(net, q.T.contiguous(), Tolerances())
    assert bool((q != moved.T).any())
    assert float(net.costs(moved)) < float(net.costs(q.T))
    position = whole.robot.forward_kinematics(moved.T)[0][:, :2]
    assert float((position - whole.points).norm(dim=1).max()) <= 1e-4


def test_hops_heal_vertices_that_have_unrelated_configurations(whole, generator):
    q, wrong = spoilt(whole, 0.05, generator)
    net = network(whole)
    healed = q.T.contiguous()
    for _ in range(3):
        healed = hop(net, healed, Tolerances())
    assert float(net.costs(healed)) < 1.02 * float(net.costs(whole.configurations.T))
    far = distance(q, whole.configurations, whole.robot.continuous)[wrong] > 1.0
    assert bool(far.any())
    assert float(distance(healed.T, whole.configurations, whole.robot.continuous)[wrong][far].median()) < 0.5


def test_no_part_of_several_maps_gets_steeper(whole, generator):
    maps = [spoilt(whole, share, generator)[0] for share in (0.0, 0.05, 0.3)]
    net, size = network(whole), len(whole.points)
    edges = torch.cat([net.edges + size * k for k in range(3)], dim=1)
    parts = torch.arange(3).repeat_interleave(size)
    several = Network(net.robot, net.task, net.targets.repeat(1, 3), edges, net.lengths.repeat(3), parts=parts)
    q = torch.cat(maps).T.contiguous()
    before, after = several.costs(q), several.costs(hop(several, q, Tolerances()))
    assert bool((after <= before * (1.0 + 1e-12)).all())
    assert bool((after[1:] < before[1:]).all())


def test_candidates_are_chosen_together_and_as_well_as_can_be_on_a_tree(planar_5, generator):
    # a star with long rays, of which all but the tips choose; on trees belief propagation is exact
    edges = torch.tensor([[0, 1], [1, 2], [0, 3], [3, 4], [0, 5]]).T
    lengths = 0.05 + 0.1 * torch.rand(5, generator=generator, dtype=torch.float64)
    net = Network(planar_5, grr_torch.Position(2), torch.zeros(2, 6, dtype=torch.float64), edges, lengths)
    vertices = torch.tensor([0, 1, 3])
    for _ in range(20):
        q = planar_5.sample(6, generator).T.contiguous()
        candidates = planar_5.sample(12, generator).T.reshape(planar_5.n, 3, 4)
        candidates[:, :, 0] = q[:, vertices]
        chosen = _choose(net, q, vertices, candidates)
        choices = torch.cartesian_prod(*[torch.arange(4)] * 3)
        tried = q.repeat(len(choices), 1, 1)
        tried[:, :, vertices] = candidates[:, torch.arange(3), choices].movedim(0, 1)
        costs = torch.stack([net.costs(one)[0] for one in tried])
        found = q.index_copy(1, vertices, candidates[:, torch.arange(3), chosen])
        assert float(net.costs(found)) == pytest.approx(float(costs.min()))


def test_what_is_beyond_the_bound_costs_the_bound_and_does_not_pull(whole, generator):
    q = spoilt(whole, 0.1, generator)[0].T.contiguous()
    net = network(whole)
    bound = 3.0 * float(net.slopes(q).median())
    kept = net.slopes(q) < bound
    assert 0 < int(kept.sum()) < len(kept)
    bounded, without = replace(net, bound=bound), replace(net, edges=net.edges[:, kept], lengths=net.lengths[kept])
    torch.testing.assert_close(bounded.slopes(q), net.slopes(q).clamp(max=bound))
    steps = [gauss_newton_step(one, q, 1e-2) for one in (bounded, without, net)]
    torch.testing.assert_close(steps[0], steps[1], atol=1e-9, rtol=0)
    assert float((steps[0] - steps[2]).abs().max()) > 0.1
    relaxed = relax(bounded, q, Tolerances(), silent)
    assert float(bounded.costs(relaxed)) < float(bounded.costs(q))


def test_some_edges_are_judged_as_all_of_them_are(whole, generator):
    q = spoilt(whole, 0.3, generator)[0]
    torn = replace(whole, configurations=q)
    wanted = torch.rand(len(whole.edges), generator=generator) < 0.1
    found = check_edges(torn, Tolerances(), wanted=wanted)
    assert torch.equal(found, check_edges(torn, Tolerances()) & wanted)
    assert bool(found.any())
    assert not bool(found[wanted].all())


@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_no_edge_is_lost_whatever_the_new_configurations_are(whole, generator, share):
    q, wrong = spoilt(whole, share, generator)
    blended = blend(whole, q, Tolerances(), is_continuous, silent, UNKEPT)
    assert bool((blended.connected | ~whole.connected).all())
    assert torch.equal(check_edges(blended, Tolerances()), blended.connected)
    # what lies far from those that are wrong is as it was asked for
    touched = wrong.clone()
    for _ in range(4):
        touched[whole.edges[touched[whole.edges].any(1)]] = True
    assert torch.equal(blended.configurations[~touched], q[~touched])


def test_what_would_lose_an_edge_goes_part_of_the_way(whole, generator):
    # one edge is said to be broken at the new configurations until its ends are nearer to where they were
    edge = int(whole.connected.nonzero()[len(whole.connected) // 3])
    ends = whole.edges[edge]
    shifted = whole.configurations + 0.05 * torch.randn(whole.configurations.shape, generator=generator).to(
        torch.float64
    )
    q, valid = project(whole.robot, whole.task, whole.points, shifted)
    q = torch.where(valid[:, None], q, whole.configurations)
    apart = distance(q, whole.configurations, whole.robot.continuous)

    def check(robot, task, points_a, points_b, q_a, q_b, *, tolerances):
        result = is_continuous(robot, task, points_a, points_b, q_a, q_b, tolerances=tolerances)
        mine = (points_a == whole.points[ends[0]]).all(1) & (points_b == whole.points[ends[1]]).all(1)
        strayed = distance(q_a, whole.configurations[ends[0]], robot.continuous) > 0.7 * apart[ends[0]]
        return result & ~(mine & strayed)

    blended = blend(whole, q, Tolerances(), check, silent, UNKEPT)
    moved = distance(blended.configurations, whole.configurations, whole.robot.continuous)
    assert bool(blended.connected[edge])
    assert 0.0 < float(moved[ends[0]]) <= 0.7 * float(apart[ends[0]])


def nudged(roadmap, generator, still=()):
    """Configurations a little away from a roadmap's, but for some vertices."""
    noise = 0.05 * torch.randn(roadmap.configurations.shape, generator=generator, dtype=torch.float64)
    q, valid = project(roadmap.robot, roadmap.task, roadmap.points, roadmap.configurations + noise)
    valid[list(still)] = False
    return torch.where(valid[:, None], q, roadmap.configurations)


def fails_beside_all_others(roadmap, edge, fails):
    """`is_continuous`, but for an edge that is broken among all of a roadmap, if `fails(points, configurations)`."""
    count = int(roadmap.resolved[roadmap.edges].all(1).sum())
    ends = roadmap.points[roadmap.edges[edge]]

    def check(robot, task, points_a, points_b, q_a, q_b, *, tolerances):
        result = is_continuous(robot, task, points_a, points_b, q_a, q_b, tolerances=tolerances)
        mine = (points_a == ends[0]).all(1) & (points_b == ends[1]).all(1)
        return (
            result & ~mine
            if len(q_a) >= count and fails(torch.cat([points_a, points_b]), torch.cat([q_a, q_b]))
            else result
        )

    return check


def flags(roadmap, check):
    parts = roadmap.points, roadmap.configurations, roadmap.resolved, roadmap.edges
    return continuous_edges(roadmap.robot, roadmap.task, *parts, Tolerances(), silent, check=check)


@pytest.mark.parametrize("unmoved", [False, True])
def test_an_edge_that_fails_beside_others_alone_is_not_lost_and_not_claimed(whole, generator, unmoved):
    edge = int(whole.connected.nonzero()[len(whole.connected) // 3])
    ends = whole.edges[edge].tolist()
    q = nudged(whole, generator, still=ends if unmoved else ())
    # it fails as long as a vertex, an end of it or one near to it, has gone more than a third of its way
    other = ends[0]
    if unmoved:
        around = whole.edges[(whole.edges == ends[0]).any(1)].unique().tolist()
        other = next(
            vertex for vertex in around if vertex not in ends and bool((q != whole.configurations)[vertex].any())
        )
    apart = distance(q[other], whole.configurations[other], whole.robot.continuous)

    def fails(points, configurations):
        at = (points == whole.points[other]).all(1).nonzero()[0]
        strayed = distance(configurations[at[0]], whole.configurations[other], whole.robot.continuous)
        return bool(strayed > 0.33 * apart)

    check = fails_beside_all_others(whole, edge, fails)
    kept = blend(whole, q, Tolerances(), check, silent, UNKEPT)
    assert bool(kept.connected[edge])
    assert torch.equal(flags(kept, check), kept.connected)
    assert bool((kept.connected | ~whole.connected).all())
    assert not torch.equal(kept.configurations, whole.configurations)


def test_a_repair_loses_no_edge_that_fails_beside_what_it_adds(whole):
    taken = (whole.points.norm(dim=1) < 0.3).nonzero()[::25, 0]
    configurations, resolved, wave = whole.configurations.clone(), whole.resolved.clone(), whole.wave.clone()
    configurations[taken], resolved[taken], wave[taken] = torch.nan, False, -1
    connected = whole.connected & ~torch.isin(whole.edges, taken).any(1)
    damaged = replace(whole, configurations=configurations, resolved=resolved, connected=connected, wave=wave)
    edge = int(connected.nonzero()[len(connected) // 3])
    before = int(resolved[damaged.edges].all(1).sum())
    check = fails_beside_all_others(damaged, edge, lambda points, q: len(q) > 2 * before)
    mended = repair(damaged, Tolerances(), 0)
    assert bool(mended.resolved[taken].all())
    assert not bool(flags(mended, check)[edge])
    kept = repair(damaged, Tolerances(), 0, check)
    assert bool((kept.connected | ~connected).all())
    assert torch.equal(flags(kept, check), kept.connected)


def test_a_relaxed_map_seeds_all_its_vertices(planar_5):
    task, graph = grr_torch.Position(2), staggered_grid([(-0.35, 0.35)] * 2, 150)
    seeds = find_seeds(planar_5, task, graph, candidates=12, tolerances=Tolerances())
    tools = planar_5.forward_kinematics(seeds)[0][:, :2]
    assert len(seeds) == len(graph.points)
    torch.testing.assert_close(tools, graph.points, atol=2e-4, rtol=0)
    roadmap = grr_torch.build(planar_5, task, points=graph, seeds=seeds, refine=False)
    kept = distance(roadmap.configurations, seeds, planar_5.continuous)
    assert float(kept.max()) < 1e-3
    assert int(roadmap.wave.max()) == 0


def test_cells_that_are_far_apart_are_left_alone(whole, generator):
    net, cells = network(whole), whole.graph.triangles(whole.connected)
    q = spoilt(whole, 0.2, generator)[0]
    apart = cells[spreads(whole.robot, whole.task, whole.points, q, cells, Tolerances()) > 1.5]
    assert len(apart)
    assert torch.equal(certify(net, apart, q.T.contiguous(), Tolerances(), silent), q.T)
