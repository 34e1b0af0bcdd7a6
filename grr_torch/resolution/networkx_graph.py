"""A roadmap as a networkx graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from grr_torch.spaces.configuration import distance

if TYPE_CHECKING:
    import networkx

    from grr_torch.resolution.roadmap import Roadmap


def to_networkx(roadmap: Roadmap) -> networkx.Graph[int]:
    """The graph that `Roadmap.to_networkx` describes."""
    import networkx

    graph: networkx.Graph[int] = networkx.Graph()
    points, q = roadmap.points, roadmap.configurations
    for vertex in roadmap.resolved.nonzero()[:, 0].tolist():
        graph.add_node(vertex, point=points[vertex].numpy(), configuration=q[vertex].numpy())
    first, second = roadmap.edges[roadmap.connected].T
    d_p = roadmap.task.distance(points[first], points[second]).tolist()
    d_q = distance(q[first], q[second], roadmap.robot.continuous.cpu()).tolist()
    for a, b, p, c in zip(first.tolist(), second.tolist(), d_p, d_q, strict=True):
        graph.add_edge(a, b, point_distance=p, configuration_distance=c)
    return graph
