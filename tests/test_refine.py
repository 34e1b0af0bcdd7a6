"""Refinement keeps what there was and makes it smoother."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch.projection.columns import null_space_projector
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.refine import refine
from grr_torch.resolution.report import summary

PROBLEMS = [("planar_5", "position", 400), ("planar_5", "fixed-rotation", 400), ("kinova", "fixed-rotation", 1500)]


@pytest.mark.parametrize(("name", "task", "points"), PROBLEMS)
def test_nothing_is_lost_and_the_map_is_smoother(name, task, points):
    plain = grr_torch.build(grr_torch.load_robot(name), task, points=points, refine=False)
    refined = refine(plain)
    assert bool((refined.resolved | ~plain.resolved).all())
    assert bool((refined.connected | ~plain.connected).all())
    before, after = plain.quality(), refined.quality()
    assert after.smoothness < before.smoothness
    assert after.joint_limit_violations == 0
    assert after.self_collisions in (None, 0)
    assert after.max_position_error <= 1e-4 * (1.0 + 1e-6)
    assert torch.equal(check_edges(refined, Tolerances()), refined.connected)
    assert f"{before.smoothness:.3f} → {after.smoothness:.3f}" in summary(refined, after)
    assert f"99 % of slopes below {before.smoothness_p99:.1f} → {after.smoothness_p99:.1f}" in summary(refined, after)
    assert f"steep edges {before.steep_edges} → {after.steep_edges}" in summary(refined, after)
    # of the cells that there are in the end, those that had a broken edge before were not certified
    told, fewer = summary(refined, after), 0
    for name, then, now in zip(("triangles", "squares"), plain.cells(), refined.cells(), strict=True):
        certified = [int(cells.certified.sum()) for cells in (then, now)]
        total = len(now.corners)
        assert (total == 0) == (name not in told)
        assert total == 0 or f"of {total:,} {name} {total - certified[0]:,} → {total - certified[1]:,}" in told
        fewer += certified[1] - certified[0]
    assert fewer > 0
    assert summary(plain, before) == ""


@pytest.mark.parametrize(("name", "task", "points"), PROBLEMS)
def test_nothing_is_lost_of_a_large_map_either(monkeypatch, name, task, points):
    plain = grr_torch.build(grr_torch.load_robot(name), task, points=points, refine=False)
    monkeypatch.setattr("grr_torch.resolution.losses._MOST_CHECKED", 100)
    # what cannot be told is as it was, as long as its ends are where they were
    broken = plain.connected.clone()
    broken[plain.connected.nonzero()[::50, 0]] = False
    refined = refine(replace(plain, connected=broken))
    assert bool((refined.connected | ~broken).all())
    assert refined.quality().smoothness < replace(plain, connected=broken).quality().smoothness
    checked = check_edges(refined, Tolerances())
    assert int((checked != refined.connected).sum()) <= 0.005 * int(checked.sum())


def test_refining_again_changes_little(planar_5):
    once = grr_torch.build(planar_5, "position", points=400)
    twice = refine(once)
    assert twice.quality().smoothness == pytest.approx(once.quality().smoothness, rel=0.01)


def test_the_same_map_is_refined_to_the_same_bytes(kinova):
    plain = grr_torch.build(kinova, "position", points=500, refine=False)
    first, second = refine(plain, seed=3), refine(plain, seed=3)
    for name in ("configurations", "resolved", "connected"):
        assert getattr(first, name).numpy().tobytes() == getattr(second, name).numpy().tobytes()


@pytest.mark.parametrize("every", [25, 3])
def test_what_was_taken_away_is_repaired(planar_5, every):
    """Neighbours too."""
    whole = grr_torch.build(planar_5, "position", points=400, refine=False)
    inner = (whole.points.norm(dim=1) < 0.35).nonzero()[:, 0]
    taken = inner[::every]
    assert bool(torch.isin(whole.edges, taken).all(1).any()) == (every == 3)
    configurations, resolved = whole.configurations.clone(), whole.resolved.clone()
    configurations[taken], resolved[taken] = math.nan, False
    connected = whole.connected & ~torch.isin(whole.edges, taken).any(1)
    damaged = replace(whole, configurations=configurations, resolved=resolved, connected=connected)
    mended = refine(damaged)
    assert bool(mended.resolved[taken].all())
    assert int(mended.connected.sum()) >= int(whole.connected.sum())


def test_a_roadmap_from_a_file_is_repaired_in_single_precision(tmp_path):
    robot = grr_torch.load_robot("planar_5", dtype=torch.float32)
    grr_torch.build(robot, "fixed-rotation", points=200, refine=False).save(tmp_path / "f.grr")
    plain = grr_torch.Roadmap.load(tmp_path / "f.grr")
    assert plain.configurations.dtype == torch.float64
    mended = refine(plain)
    assert int(mended.connected.sum()) > int(plain.connected.sum())


def test_the_null_space_projector_keeps_what_leaves_the_task_alone(generator):
    jacobian = torch.randn(3, 7, 20, dtype=torch.float64, generator=generator)
    projector = null_space_projector(jacobian, 1e-12)
    for k in range(20):
        p, j = projector[:, :, k], jacobian[:, :, k]
        torch.testing.assert_close(p @ p, p, atol=1e-9, rtol=0)
        torch.testing.assert_close(p, p.T, atol=1e-9, rtol=0)
        assert float((j @ p).abs().max()) < 1e-9
        assert float(p.trace()) == pytest.approx(4.0, abs=1e-8)


def test_random_seeds_lose_no_edge_and_a_wrong_flag_is_put_right(planar_5):
    for seed in (1, 2):
        seeds = planar_5.sample(4, torch.Generator().manual_seed(seed))
        plain = grr_torch.build(planar_5, "fixed-rotation", points=150, refine=False, seeds=seeds)
        refined = refine(plain)
        assert bool((refined.connected | ~plain.connected).all())
        wrong = replace(plain, connected=plain.resolved[plain.edges].all(1))
        assert not torch.equal(wrong.connected, check_edges(wrong, Tolerances()))
        mended = refine(wrong)
        assert torch.equal(mended.connected, check_edges(mended, Tolerances()))


def test_a_map_in_single_precision_is_refined_too():
    robot = grr_torch.load_robot("planar_5", dtype=torch.float32)
    plain = grr_torch.build(robot, "position", points=200, refine=False)
    refined = refine(plain)
    assert refined.quality().smoothness < plain.quality().smoothness


def test_progress_counts_what_is_done(kinova):
    told: dict[str, list[tuple[int, int]]] = {}
    plain = grr_torch.build(kinova, "position", points=500, refine=False)
    refine(plain, progress=lambda stage, done, total: told.setdefault(stage, []).append((done, total)))
    assert set(told) == {"repairing", "refining", "certifying", "checking edges", "checking again", "measuring cells"}
    assert all(0 <= done <= total for calls in told.values() for done, total in calls)
    assert all(calls[-1][0] == calls[-1][1] for calls in told.values())
    assert (len(plain.triangles().corners),) * 2 in told["measuring cells"]
