"""`grr-torch export-ik`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.options import check_ending
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
    from grr_torch.output import atomic_write, check_outputs

    check_outputs({"--onnx": onnx, "--torch": torch_export}, [weights])
    given = [(export, path) for export, path in ((export_onnx, onnx), (export_torch, torch_export)) if path is not None]
    if not given:
        raise ParameterError("--onnx and --torch", "neither", "at least one of them")
    check_ending("--onnx", onnx, ".onnx")
    check_ending("--torch", torch_export, ".pt2")
    network, origin = load_network(weights)
    rows = []
    # both files appear together, or neither does
    with ExitStack() as stack:
        for export, path in given:
            worst = export(network, origin, stack.enter_context(atomic_write(path)))
            rows.append(("written", f"{path}, within {worst:.1e} rad of the network"))
    print_rows(f"{origin.robot}: points ({origin.task.width}) to {', '.join(origin.joint_names)}", rows)
