"""`grr-torch bench learning`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from grr_torch.cli.figures import FiguresFile, show_machine, write_figures
from grr_torch.cli.show import markdown_table, progress_bar, reports_errors
from grr_torch.cli.show_learning import WARM_HEAD, statistics, warm_rows

from grr_torch.errors import ParameterError

if TYPE_CHECKING:
    from grr_torch.experiments.learning import Outcome
    from grr_torch.learning.options import Epoch


@reports_errors
def learning(
    file: Annotated[
        Path | None,
        typer.Argument(help="A roadmap file; by default the Kinova preset's roadmap is built.", metavar="[FILE.grr]"),
    ] = None,
    labels: Annotated[str, typer.Option(help="Of those below; all by default.")] = (
        "roadmap,independent,none,roadmap-joints,independent-joints"
    ),
    epochs: Annotated[int, typer.Option(help="Times that each sample is seen.")] = 80,
    samples: Annotated[int, typer.Option(help="Points drawn, a tenth each for validation and test.")] = 500_000,
    points: Annotated[int, typer.Option(help="Held-out points that are measured.")] = 20_000,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    json_file: FiguresFile = None,
) -> None:
    """Print what a network learns from a roadmap, beside the same network with other labels, as Markdown tables.

    Labels are the roadmap's configurations (roadmap), those of inverse kinematics from random starts, each point by
    itself (independent), or none: then the loss is that of forward kinematics alone. With roadmap-joints and
    independent-joints it is that in joint space alone. With the defaults, each takes minutes.

    Example: grr-torch bench learning kinova.grr --epochs 10 --samples 100000
    """
    from grr_torch.experiments.learning import LABELS, compare_warm_starts, measure_learning
    from grr_torch.learning.options import TrainingOptions
    from grr_torch.output import check_outputs
    from grr_torch.resolution.build import build
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.load import load_robot

    names = [name.strip() for name in labels.split(",") if name.strip()]
    if not names:
        raise ParameterError("--labels", repr(labels), f"some of {', '.join(LABELS)}")
    options = TrainingOptions(samples=samples, epochs=epochs, seed=seed)
    check_outputs({"--json": json_file}, [file])
    with progress_bar() as progress:
        roadmap = Roadmap.load(file) if file else build(load_robot("kinova"), "fixed-rotation", progress=progress)
        outcomes = measure_learning(
            roadmap, options, labels=names, points=points, on_epoch=_show_epoch, progress=progress
        )
        warm = compare_warm_starts(outcomes[0].ik, roadmap, points=points, seed=seed + 1)
    runs = [outcome.to_dict() for outcome in outcomes]
    write_figures(json_file, {"runs": runs, "warm_start": [row.to_dict() for row in warm]})
    show_machine()
    typer.echo(_errors_table(outcomes) + "\n")
    typer.echo(_continuity_table(outcomes) + "\n")
    typer.echo(f"With labels {names[0]}:\n\n" + markdown_table(WARM_HEAD, warm_rows(warm)))


def _show_epoch(labels: str, epoch: Epoch) -> None:
    typer.echo(
        f"{labels}: epoch {epoch.epoch}/{epoch.epochs}  {epoch.millimetres:.2f} mm  {epoch.seconds:.0f} s", err=True
    )


def _errors_table(outcomes: list[Outcome]) -> str:
    from grr_torch.experiments.learning import LABELS, PUBLISHED

    head = ["labels", "position [mm]: mean, median, 95 %, 99 %, largest", "rotation [°]"]
    head += ["within 0.1 mm and 0.1° after 1, 2 Newton steps", "training [s]"]
    rows = [
        [
            LABELS[outcome.labels],
            statistics(outcome.evaluation.errors[0].millimetres),
            statistics(outcome.evaluation.errors[0].degrees),
            ", ".join(f"{100.0 * errors.exact:.2f} %" for errors in outcome.evaluation.errors[1:]),
            f"{outcome.seconds:.0f}",
        ]
        for outcome in outcomes
    ]
    name, millimetres, degrees = PUBLISHED
    rows.append([f"not like for like: {name}", f"{millimetres}", f"{degrees}", "", ""])
    return markdown_table(head, rows)


def _continuity_table(outcomes: list[Outcome]) -> str:
    from grr_torch.experiments.learning import LABELS

    head = ["labels", "joint step over 1 cm [rad]: 99.9 %, largest", "the roadmap's own", "ratio of the largest"]
    head += ["after closed loops [rad]", "Newton steps round them", "beyond limits", "in self-collision"]
    head += ["from the map [rad], mean", "poses / s", "one pose [ms]"]
    rows = []
    for outcome in outcomes:
        figures = outcome.evaluation
        network, own = figures.continuity, figures.roadmap
        rows.append(
            [
                LABELS[outcome.labels],
                f"{network.p999:.3f}, {network.step:.3f}",
                f"{own.p999:.3f}, {own.step:.3f}",
                f"{network.step / own.step:.2f}",
                f"{network.closure:.2g}",
                f"{figures.newton_closure:.2g}",
                f"{100.0 * figures.beyond_limits:.2f} %",
                f"{100.0 * figures.in_self_collision:.2f} %",
                f"{figures.from_map:.3f}",
                f"{figures.poses_per_second:,.0f}",
                f"{1e3 * figures.one_pose:.3f}",
            ]
        )
    return markdown_table(head, rows)
