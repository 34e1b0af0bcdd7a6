"""`grr-torch view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.options import check_ending
from grr_torch.cli.show import reports_errors


@reports_errors
def view(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    save: Annotated[Path | None, typer.Option(help="Write the recording here instead.", metavar="FILE.rrd")] = None,
) -> None:
    """Open a roadmap in the rerun viewer, or write its recording.

    Example: grr-torch view kinova.grr
    """
    from grr_torch.output import check_outputs
    from grr_torch.recording.roadmap import record_roadmap, show_roadmap
    from grr_torch.resolution.roadmap import Roadmap

    check_outputs({"--save": save}, [file])
    check_ending("--save", save, ".rrd")
    roadmap = Roadmap.load(file)
    if save is None:
        show_roadmap(roadmap)
    else:
        record_roadmap(roadmap, save)
        typer.echo(f"written: {save}", err=True)
