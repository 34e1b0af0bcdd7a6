"""`grr-torch eval-ik`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.show import print_json, print_rows, progress_bar, reports_errors, show_table
from grr_torch.cli.show_learning import ERROR_HEAD, WARM_HEAD, error_rows, figure_rows, warm_rows


@reports_errors
def eval_ik(
    weights: Annotated[Path, typer.Argument(help="Weights from train-ik.", metavar="FILE.safetensors")],
    file: Annotated[Path, typer.Argument(help="The roadmap that they were trained on.", metavar="FILE.grr")],
    points: Annotated[int, typer.Option(help="Held-out points.")] = 20_000,
    seed: Annotated[int, typer.Option(min=0, help="Of points, lines and loops.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
) -> None:
    """Measure a trained network in the blocks of the task space that were held out of its training.

    Example: grr-torch eval-ik ik.safetensors kinova.grr
    """
    from grr_torch.experiments.learning import compare_warm_starts
    from grr_torch.experiments.timing import machine
    from grr_torch.learning.evaluate import evaluate_ik
    from grr_torch.learning.neural_ik import NeuralIK
    from grr_torch.resolution.roadmap import Roadmap

    roadmap = Roadmap.load(file)
    ik = NeuralIK.load(weights, roadmap)
    with progress_bar() as progress:
        progress("measuring the network", 0, 2)
        evaluation = evaluate_ik(ik, roadmap, points=points, seed=seed)
        progress("comparing warm starts", 1, 2)
        warm = compare_warm_starts(ik, roadmap, points=points, seed=seed)
        progress("comparing warm starts", 2, 2)
    if as_json:
        rows = [row.to_dict() for row in warm]
        print_json({"machine": machine(), **evaluation.to_dict(), "warm_start": rows})
        return
    print_rows(f"{roadmap.robot.name}, {roadmap.task.kind}: {points:,} held-out points", figure_rows(evaluation))
    typer.echo()
    show_table(ERROR_HEAD, error_rows(evaluation))
    typer.echo()
    show_table(WARM_HEAD, warm_rows(warm))
