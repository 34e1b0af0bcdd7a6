"""What a build does, stage by stage, and about how long each takes beside the others.

The weights are percentages of a build of 100,000 vertices of the Kinova arm: gripper down, and where rotation varies,
of its `pose`, where more edges are hard to follow.
"""

from __future__ import annotations

from grr_torch.progress import Plan
from grr_torch.spaces.task import TaskSpace


def build_stages(
    task: TaskSpace,
    *,
    method: str = "expansion",
    found_seeds: bool = False,
    refine: bool = True,
    objectives: bool = False,
    reachability: bool = False,
) -> Plan:
    """The stages of a build, and of measuring the quality of its roadmap and writing it.

    Args:
        task: The task space.
        method: As of `build`.
        found_seeds: Whether seeds are looked for.
        refine: Whether the roadmap is refined.
        objectives: Whether refinement serves objectives.
        reachability: Whether reachability is measured.
    """
    turning = task.rotations is not None
    edges, cells = (16.0, 2.0) if turning else (4.0, 14.0)
    squares = 2.0 if turning else 5.0
    plan = [("choosing seeds", 15.0)] if found_seeds and method == "expansion" else []
    if method == "random":
        plan += [("sampling", 100.0), ("testing pairs", 600.0), ("solving constraints", 300.0)]
    else:
        plan += [("expanding", 2.0)]
    plan += [("checking edges", edges)]
    if refine:
        relaxing, certifying, spreads, doubtful = (6.0, 37.0, 4.0, 2.5) if turning else (10.0, 12.0, 14.0, 1.0)
        relaxed = [
            ("refining", relaxing),
            ("measuring cells", spreads),
            ("certifying", certifying),
            ("measuring cells", doubtful),
            ("checking edges", 1.5 * edges),
            ("checking again", 0.7 * edges),
        ]
        plan += [("measuring cells", cells), ("measuring cells", squares)]
        plan += [("repairing", 3.0 + edges), *relaxed, *(relaxed if objectives else [])]
    if reachability:
        plan.append(("measuring reachability", 50.0))
    return [*plan, ("measuring cells", cells), ("measuring cells", squares), ("writing", 1.0)]
