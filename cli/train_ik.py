"""`grr-torch train-ik`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.show import print_json, print_rows, progress_bar, reports_errors

if TYPE_CHECKING:
    from grr_torch.learning.options import Epoch


@reports_errors
def train_ik(
    file: Annotated[Path, typer.Argument(help="A roadmap file.", metavar="FILE.grr")],
    out: Annotated[Path, typer.Option(help="Weights to write.", metavar="FILE.safetensors")],
    epochs: Annotated[int, typer.Option(help="Times that each sample is seen.")] = 80,
    samples: Annotated[int, typer.Option(help="Points drawn and solved, a tenth each for validation and test.")] = (
        500_000
    ),
    learning_rate: Annotated[float, typer.Option(help="The highest; it falls along a cosine.")] = 3e-3,
    batch: Annotated[int, typer.Option(help="Samples of a step.")] = 2048,
    width: Annotated[int, typer.Option(help="Units of a hidden layer.")] = 128,
    depth: Annotated[int, typer.Option(help="Hidden layers.")] = 3,
    patience: Annotated[int, typer.Option(help="Stop after so many epochs without progress.")] = 30,
    block: Annotated[
        float | None, typer.Option(help="Edge of the held-out blocks in metres; by default the map's edges'.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:0, …")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the state kept beside --out.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Train a network to give a roadmap's configurations: neural inverse kinematics.

    The network of the best epoch on the validation blocks is written. After each epoch the state is kept in
    NAME.checkpoint.safetensors; after Ctrl-C, --resume goes on from there, with the same options.

    Example: grr-torch train-ik kinova.grr --out ik.safetensors

    Example: grr-torch train-ik kinova.grr --out ik.safetensors --epochs 10 --samples 100000
    """
    from grr_torch.learning.checkpoint import checkpoint_path
    from grr_torch.learning.network import Architecture
    from grr_torch.learning.options import TrainingOptions
    from grr_torch.learning.split import Split
    from grr_torch.learning.train import check_weights_path
    from grr_torch.learning.train import train_ik as train
    from grr_torch.output import check_outputs
    from grr_torch.resolution.roadmap import Roadmap

    options = TrainingOptions(
        samples=samples,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        patience=patience,
        seed=seed,
        split=Split(block=block, seed=seed),
        architecture=Architecture(width, depth),
    )
    check_outputs({"--out": out, "the state kept beside --out": checkpoint_path(out)}, [file])
    check_weights_path("--out", out)
    roadmap = Roadmap.load(file, device=device)
    try:
        with progress_bar() as progress:

            def show(epoch: Epoch) -> None:
                progress.line = ""  # epochs have lines of their own
                _show_epoch(epoch)

            ik = train(roadmap, options, out=out, resume=resume, on_epoch=show, progress=progress)
    except KeyboardInterrupt:
        if not checkpoint_path(out).exists():
            raise
        typer.echo(f"interrupted: the state is in {checkpoint_path(out)}; --resume goes on from there", err=True)
        raise typer.Exit(130) from None
    record = ik.origin.training
    if as_json:
        print_json({**{name: record[name] for name in record if name != "options"}, "out": str(out)})
        return
    rows = [
        ("best epoch", f"{record['epoch']:.0f} of {epochs}"),
        ("validation blocks", f"{record['millimetres']:.3f} mm, {record['degrees']:.3f}°, mean, without Newton steps"),
        ("written", f"{out} (grr-torch eval-ik {out} {file})"),
    ]
    print_rows(f"{roadmap.robot.name}, {roadmap.task.kind}: neural IK", rows)


def _show_epoch(epoch: Epoch) -> None:
    seconds = f"{epoch.seconds:.0f} s, {epoch.seconds_left:.0f} s left"
    typer.echo(
        f"epoch {epoch.epoch}/{epoch.epochs}  loss {epoch.loss:.3e}  validation {epoch.validation:.3e}  "
        f"{epoch.millimetres:.2f} mm  {epoch.degrees:.3f}°  best {epoch.best}  {seconds}",
        err=True,
    )
