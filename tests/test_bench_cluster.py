"""`grr-torch bench cluster`: what clusters are compared with. Real clusters are in test_fleet_ray.py."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch

from grr_torch import processes
from grr_torch.experiments import cluster


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_what_clusters_are_compared_with_runs_on_one_thread_of_one_process(monkeypatch, two_threads):
    forks, threads, seen = [], [], []
    fork, check, timed = processes._fork, cluster.is_continuous, cluster._timed

    def noted_fork(*arguments):
        forks.append(arguments)
        return fork(*arguments)

    def noted_check(*edges, **options):
        threads.append(torch.get_num_threads())
        return check(*edges, **options)

    def noted_timed(*arguments):
        del forks[:], threads[:]
        seconds = timed(*arguments)
        seen.append((len(forks), set(threads)))
        return seconds

    monkeypatch.setattr("grr_torch.resolution.edges.EDGES_AT_ONCE", 200)
    monkeypatch.setattr(processes, "_fork", noted_fork)
    monkeypatch.setattr(cluster, "_timed", noted_timed)
    monkeypatch.setattr(cluster, "cluster", lambda cpus: nullcontext())
    monkeypatch.setattr(cluster, "SpreadCheck", lambda ray: check)
    monkeypatch.setattr("grr_torch.experiments.cluster.is_continuous", noted_check)
    cost = cluster.measure_cluster("planar_3", points=900, workers=1, repeats=1)
    alone, *spread = seen
    assert alone == (0, {1})
    # else nothing would have been found out
    assert all(count > 0 for count, _ in spread)
    assert cost.check_seconds > 0.0
