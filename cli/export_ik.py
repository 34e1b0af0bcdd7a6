"""`grr-torch export-ik`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.show import print_rows, reports_errors

from grr_torch.errors import ParameterError


@reports_errors
def export_ik(
    weights: Annotated[Path, typer.Argument(help="Weights from train-ik.", metavar="FILE.safetensors")],
    onnx: Annotated[Path | None, typer.Option(help="ONNX file to write.", metavar="FILE.onnx")] = None,
    torch_export: Annotated[
        Path | None, typer.Option("--torch", help="torch.export file to write.", metavar="FILE.pt2")
    ] = None,
) -> None:
    """Export a trained network: points (N, d) float32 in metres to configurations (N, n) float32 in radians.

    Scaling and decoding are inside. What is written is run and compared with the network first.

    Example: grr-torch export-ik ik.safetensors --onnx ik.onnx
    """
    from grr_torch.learning.neural_ik import load_network
    from grr_torch.learning.onnx import export_onnx, export_torch
    from grr_torch.output import check_outputs

    check_outputs({"--onnx": onnx, "--torch": torch_export}, [weights])
    given = [(name, path) for name, path in ((".onnx", onnx), (".pt2", torch_export)) if path is not None]
    if not given:
        raise ParameterError("--onnx and --torch", "neither", "at least one of them")
    for suffix, path in given:
        if path.suffix.lower() != suffix:
            raise ParameterError("output", path, f"a file that ends in {suffix}")
    network, origin = load_network(weights)
    rows = []
    for suffix, path in given:
        worst = (export_onnx if suffix == ".onnx" else export_torch)(network, origin, path)
        rows.append(("written", f"{path}, within {worst:.1e} rad of the network"))
    print_rows(f"{origin.robot}: points ({origin.task.width}) to {', '.join(origin.joint_names)}", rows)
