"""`grr-torch spheres`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from grr_torch.cli.show import print_json, progress_bar, reports_errors


@reports_errors
def spheres(
    urdf: Annotated[Path, typer.Argument(help="A URDF with collision geometry.")],
    out: Annotated[Path, typer.Option(help="Sphere file to write (YAML, in cuRobo's shape).")],
    count: Annotated[
        int | None, typer.Option("--spheres", help="At most so many spheres a link; 16 if no --tolerance.")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="As few spheres as keep within this distance of the geometry, in metres.")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Random configurations, to tell which links can touch.")] = 50_000,
    starts: Annotated[
        int, typer.Option(help="With --spheres: descents from different starts, the best is kept; 0 is quick.")
    ] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of all random draws.")] = 0,
    package_dir: Annotated[list[Path] | None, typer.Option(help="Folder for package:// meshes; repeatable.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Fit spheres to a URDF's collision geometry, and find the pairs of links that need no check.

    Every point of the geometry is inside a sphere of its link. Ignored are links that a joint joins, that touch in
    nearly all random configurations, or in none. Pairs whose spheres touch far more often are warned of.

    Example: grr-torch spheres arm.urdf --out arm_spheres.yaml --spheres 20
    """
    from grr_torch.output import check_outputs
    from grr_torch.robots.contact_pairs import find_pairs
    from grr_torch.robots.fit_spheres import DEFAULT_COUNT, fit_spheres
    from grr_torch.robots.read_urdf import read_urdf
    from grr_torch.robots.spheres import SphereModel

    check_outputs({"--out": out}, [urdf])
    robot = read_urdf(urdf, package_dir or ())
    with progress_bar() as progress:
        fits = fit_spheres(robot, count=count, tolerance=tolerance, starts=starts, seed=seed, progress=progress)
        by_link = {link: fit.spheres for link, fit in fits.items()}
        contacts = find_pairs(robot, by_link, samples=samples, seed=seed, progress=progress)
    model = SphereModel(by_link, frozenset(pair.links for pair in contacts.pairs if pair.ignored))
    size = (
        f"--tolerance {tolerance}" if tolerance is not None else f"--spheres {count or DEFAULT_COUNT} --starts {starts}"
    )
    model.save(out, comment=f"Made by: grr-torch spheres {urdf.name} {size} --samples {samples} --seed {seed}")
    if as_json:
        print_json(
            {
                "out": str(out),
                "links": {
                    link: {
                        "spheres": len(fit.spheres),
                        "mean_excess": fit.mean_excess,
                        "max_excess": fit.max_excess,
                        "uncovered": fit.uncovered,
                    }
                    for link, fit in fits.items()
                },
                "pairs": [asdict(pair) for pair in contacts.pairs],
                "free": contacts.free,
            }
        )
        return
    typer.echo("link: spheres, excess over the geometry (mean, largest), left outside [mm]")
    for link, fit in fits.items():
        figures = f"{1e3 * fit.mean_excess:.1f}, {1e3 * fit.max_excess:.1f}), {1e3 * fit.uncovered:.2f}"
        typer.echo(f"  {link}: {len(fit.spheres)} ({figures}")
    typer.echo("pairs of links that can touch (share of random configurations in which they do, and their spheres)")
    for pair in contacts.pairs:
        if not pair.ignored:
            shares = f"{100.0 * pair.contacts:.2f} %, {100.0 * pair.overlaps:.2f} %"
            typer.echo(f"  {pair.links[0]} – {pair.links[1]}: {shares}")
    typer.echo(f"free of self-collision by the spheres: {100.0 * contacts.free:.2f} % of random configurations")
    typer.echo(f"written: {out}")
