"""`grr-torch export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.show import print_json, print_rows, progress_bar, reports_errors


@reports_errors
def export(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    out: Annotated[Path, typer.Option(help="File to write.", metavar="FILE.parquet|.safetensors|.npz")],
    samples: Annotated[int, typer.Option(help="Rows: points drawn in the certified cells.")] = 100_000,
    jacobians: Annotated[
        bool, typer.Option("--jacobians", help="Also write the Jacobians, six rows each, linear first.")
    ] = False,
    split: Annotated[
        str, typer.Option(help="Part samples by region, whole blocks at a time, or at random.", metavar="region|random")
    ] = "region",
    block: Annotated[
        float | None, typer.Option(help="Edge of a block in metres; by default as long as the map's edges.")
    ] = None,
    validation: Annotated[float, typer.Option(help="Share for validation.")] = 0.1,
    test: Annotated[float, typer.Option(help="Share for the test.")] = 0.1,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Export a roadmap as a data set: points, configurations, validity, split.

    Column names, units and the roadmap's hash stand in the file's metadata. A point that the map does not solve keeps
    its row, with valid false and NaN joints.

    Example: grr-torch export kinova.grr --samples 1000000 --out kinova.parquet

    Example: grr-torch export kinova.grr --samples 100000 --jacobians --out kinova.safetensors
    """
    from grr_torch.learning.export import check_dataset_path, export_dataset
    from grr_torch.learning.split import Split
    from grr_torch.output import check_outputs
    from grr_torch.resolution.roadmap import Roadmap

    parts = Split(split, validation, test, block, seed)
    check_outputs({"--out": out}, [file])
    check_dataset_path("--out", out)
    roadmap = Roadmap.load(file, device=device)
    with progress_bar() as progress:
        counts = export_dataset(roadmap, out, samples, split=parts, jacobians=jacobians, seed=seed, progress=progress)
    if as_json:
        print_json({"samples": samples, "counts": counts, "out": str(out)})
        return
    rows = [(name, f"{number:,} ({100.0 * number / samples:.2f} %)") for name, number in counts.items()]
    print_rows(f"{samples:,} samples", [*rows, ("written", f"{out}, {out.stat().st_size / 2**20:,.1f} MiB")])
