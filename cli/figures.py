"""What commands that measure have in common: the file for their figures, and on what they were measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from grr_torch.cli.show import finite

if TYPE_CHECKING:
    from grr_torch.resolution.quality import Quality

# head and cell of what stands beside connectivity, wherever it does
SLOPES = "99 %, largest slope [rad/m]; steep edges"

FiguresFile = Annotated[Path | None, typer.Option("--json", help="Write all figures to this file too.")]


def slopes_cell(quality: Quality) -> str:
    """99th percentile and largest of D_q / D_p [rad/m], and how many edges are above ten times the median."""
    if quality.smoothness_p99 is None or quality.smoothness_max is None:
        return "none"
    return f"{quality.smoothness_p99:.1f}, {quality.smoothness_max:.1f}; {quality.steep_edges:,}"


def share(value: float | None) -> str:
    """A share in percent; empty where there is none."""
    return "" if value is None else f"{100.0 * value:.2f} %"


def write_figures(file: Path | None, figures: Mapping[str, Any]) -> None:
    """Writes figures as JSON, and what they were measured on, by an atomic rename, if a file is asked for."""
    from grr_torch.experiments.timing import machine
    from grr_torch.output import atomic_write

    if file is not None:
        with atomic_write(file) as path:
            text = json.dumps(finite({"machine": machine(), **figures}), indent=2, ensure_ascii=False, allow_nan=False)
            path.write_text(text, encoding="utf-8")


def show_machine() -> None:
    """Prints what figures were measured on."""
    from grr_torch.experiments.timing import machine

    typer.echo(", ".join(f"{name} {value}" for name, value in machine().items()) + "\n")
