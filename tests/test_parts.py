"""The connected parts of a roadmap, between which no path leads."""

from __future__ import annotations

import json
from dataclasses import replace

import networkx
import pytest
import torch

from grr_torch.applications.routes import part_sizes


@pytest.fixture(scope="module")
def pieces(planar_roadmap):
    """A roadmap whose edges from one half of the plane to the other and those of seven vertices are not connected."""
    across = (planar_roadmap.points[planar_roadmap.edges][..., 0] > 0.07).sum(1) == 1
    alone = planar_roadmap.resolved.nonzero()[::30, 0]
    cut = across | torch.isin(planar_roadmap.edges, alone).any(1)
    return replace(planar_roadmap, connected=planar_roadmap.connected & ~cut)


def test_parts_are_those_of_resolved_vertices(planar_roadmap, pieces):
    assert part_sizes(planar_roadmap) == [int(planar_roadmap.resolved.sum())]
    graph = networkx.Graph(pieces.edges[pieces.connected].tolist())
    graph.add_nodes_from(pieces.resolved.nonzero()[:, 0].tolist())
    expected = sorted(map(len, networkx.connected_components(graph)), reverse=True)
    assert part_sizes(pieces) == expected
    assert len(expected) > 6
    assert expected[1] > 20
    nothing = torch.zeros_like(pieces.connected), torch.zeros_like(pieces.resolved)
    assert part_sizes(replace(pieces, connected=nothing[0], resolved=nothing[1])) == []


def test_info_says_of_how_many_parts_a_map_consists(run_cli, tmp_path, planar_roadmap, pieces):
    planar_roadmap.save(tmp_path / "whole.grr")
    pieces.save(tmp_path / "pieces.grr")
    sizes = part_sizes(pieces)
    assert f"1: all {int(planar_roadmap.resolved.sum())} vertices\n" in run_cli("info", "whole.grr")[1]
    shown = run_cli("info", "pieces.grr")[1]
    rest = f"and {len(sizes) - 5} more of {sum(sizes[5:])} in all"
    assert f"  {len(sizes)}: {', '.join(map(str, sizes[:5]))} vertices, {rest}; no path leads" in shown
    assert json.loads(run_cli("info", "pieces.grr", "--json")[1])["parts"] == sizes
