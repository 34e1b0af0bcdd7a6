"""What `smm` prints and writes of self-motion manifolds."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from grr_torch.cli.show import NOT_CHECKED, markdown_table

if TYPE_CHECKING:
    from torch import Tensor

    from grr_torch.applications.self_motion import SelfMotionManifold
    from grr_torch.resolution.roadmap import Roadmap


def figures_of(manifold: SelfMotionManifold, choice: Tensor | None) -> dict[str, Any]:
    """What is told of a manifold."""
    counts = manifold.component.bincount(minlength=manifold.components).tolist()
    names, ranges = manifold.robot.joint_names, manifold.ranges().tolist()
    checked = manifold.robot.spheres is not None
    return {
        "point": manifold.point.tolist(),
        "dimension": manifold.dimension,
        "components": [
            {
                "samples": counts[c],
                "closed": bool(manifold.closed[c]) if manifold.dimension == 1 else None,
                "free": float(manifold.free[manifold.component == c].double().mean()) if checked else None,
                "ranges": dict(zip(names, ranges[c], strict=True)),
            }
            for c in range(manifold.components)
        ],
        "roadmap": None if choice is None else choice.tolist(),
        "roadmap_component": None if choice is None else manifold.component_of(choice),
    }


def print_manifold(manifold: SelfMotionManifold, choice: Tensor | None) -> None:
    """A row for each component, and which of them the roadmap's choice lies on."""
    figures = figures_of(manifold, choice)
    place = ", ".join(f"{value:g}" for value in figures["point"])
    typer.secho(
        f"\n{manifold.robot.name}, {manifold.task.kind}, tool at ({place}): dimension {manifold.dimension}", bold=True
    )
    rows = [
        [
            f"{number + 1}{' *' if number == figures['roadmap_component'] else ''}",
            f"{part['samples']:,}",
            {True: "closed", False: "open", None: "no curve"}[part["closed"]],
            NOT_CHECKED if part["free"] is None else f"{100.0 * part['free']:.1f} %",
            *(f"{low:.2f} … {high:.2f}" for low, high in part["ranges"].values()),
        ]
        for number, part in enumerate(figures["components"])
    ]
    head = ["component", "samples", "curve", "free of self-collision", *manifold.robot.joint_names]
    typer.echo(markdown_table(head, rows))
    if choice is not None:
        values = ", ".join(f"{value:.3f}" for value in figures["roadmap"])
        on = "on no component found" if figures["roadmap_component"] is None else "on the component marked *"
        typer.echo(f"the roadmap's choice, {on}: {values}")


def write_manifolds(
    manifolds: list[SelfMotionManifold],
    choices: list[Tensor | None],
    graph: Roadmap | None,
    record: Path | None,
    out: Path | None,
) -> None:
    """Writes a recording and all samples, as far as they are asked for: both files appear together, or neither."""
    from grr_torch.output import atomic_write
    from grr_torch.recording.self_motion import record_self_motion

    with ExitStack() as stack:
        if record is not None:
            record_self_motion(manifolds, stack.enter_context(atomic_write(record)), choices, graph)
        if out is not None:
            _save(stack.enter_context(atomic_write(out)), manifolds, choices)


def _save(path: Path, manifolds: list[SelfMotionManifold], choices: list[Tensor | None]) -> None:
    """All samples as arrays: each with its point, its component (numbered over all points) and whether it is free."""
    import numpy as np
    import torch

    firsts = np.cumsum([0, *(manifold.components for manifold in manifolds)])
    rows = np.cumsum([0, *(len(manifold.configurations) for manifold in manifolds)])
    nothing = torch.full((manifolds[0].robot.n,), torch.nan)
    joined = zip(manifolds, firsts, rows, strict=False)
    parts = [(m.component.numpy() + first, m.edges.numpy() + row) for m, first, row in joined]
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            joint_names=np.array(manifolds[0].robot.joint_names),
            points=torch.stack([manifold.point for manifold in manifolds]).numpy(),
            configurations=torch.cat([manifold.configurations for manifold in manifolds]).numpy(),
            free=torch.cat([manifold.free for manifold in manifolds]).numpy(),
            component=np.concatenate([component for component, _ in parts]),
            edges=np.concatenate([edges for _, edges in parts]),
            closed=torch.cat([manifold.closed for manifold in manifolds]).numpy(),
            component_point=np.repeat(np.arange(len(manifolds)), np.diff(firsts)),
            roadmap=torch.stack([nothing if choice is None else choice for choice in choices]).numpy(),
        )
