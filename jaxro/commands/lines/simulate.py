"""The command lines of `jaxro compare` and `jaxro reproduce`."""

from pathlib import Path
from typing import Annotated

import typer

from ...experiments import REPRODUCTIONS
from ..ending import end
from . import options as given


def compare(
    file: Annotated[
        Path | None,
        given.file(
            "Its first pair is the layout; without it 16 points in eight rows, and 8 "
            "points. Or a network of `jaxro adjust`."
        ),
    ] = None,
    procedure: Annotated[
        list[str] | None,
        typer.Option(
            help="As often as wanted.  [default: every procedure]",
            metavar="NAME",
            show_default=False,
        ),
    ] = None,
    errors: given.WrongPoints = "0,1,2,3",
    size: given.ErrorSizes = "4,6,10",
    trials: given.Trials = 200,
    false_alarms: given.FalseAlarms = 0.05,
    seed: given.Seed = 0,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    sigma: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the simulated coordinates, in the units of the "
            "table.  "
            "[default: the column sigma, or sigma0 of the pair; 0.01 mm without FILE]",
            metavar="SD",
            show_default=False,
        ),
    ] = None,
    unit: given.Unit = "mm",
    points: Annotated[
        Path | None,
        typer.Option(
            help="Points of a network.", metavar="POINTS.csv", show_default=False
        ),
    ] = None,
    angles: Annotated[
        str, typer.Option(help="Unit of the angles of a network.", metavar="UNIT")
    ] = "degrees",
    out: Annotated[
        Path | None,
        typer.Option(
            help="The figures in full precision.",
            metavar="FILE.csv",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            help="A picture of what each procedure finds over the size of the error: "
            ".png, .svg or .pdf.",
            metavar="FILE.png",
            show_default=False,
        ),
    ] = None,
    force: given.ForceFile = False,
) -> None:
    """Compare procedures for wrong points, or wrong measurements, by simulation.

    On the layout of FILE: what each finds of the errors planted, and what it costs in
    good points. Of a network: false alarms, what is noticed, named, found exactly.
    Exit code 0: done; 2: bad input, nothing written.
    """
    from ..network_input import is_network
    from ..request import Options
    from ..simulate import Wanted, run_comparison

    options = Options(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        sigma=sigma,
        unit=unit,
    )
    wanted = Wanted(
        procedures=procedure or [],
        errors=errors,
        sizes=size,
        trials=trials,
        seed=seed,
        false_alarms=false_alarms,
        out=out,
        plot=plot,
        force=force,
    )
    if not is_network(file):
        if points is not None:
            raise typer.BadParameter(
                "--points belongs to a network: from,to,value,sigma"
            )
        end(lambda: run_comparison(options, wanted))
        return
    from ..adjust import Options as OfNetwork
    from ..compare_network import run_network

    of_photos = (camera, focal, principal_point, pixel_size, y_down or None)
    if any(value is not None for value in of_photos):
        raise typer.BadParameter("a network has no camera: leave out its options")
    of_network = OfNetwork(
        file=file, points=points, angles=angles, sigma=sigma, level=false_alarms
    )
    end(lambda: run_network(of_network, wanted))


def reproduce(
    name: Annotated[
        str, typer.Argument(help=f"One of {', '.join(REPRODUCTIONS)}.", metavar="NAME")
    ],
    trials: Annotated[
        int | None,
        typer.Option(
            help="Simulated pairs.  [default: as many as the paper]",
            metavar="T",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the random numbers.  [default: 0]",
            metavar="S",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Compute the tables of a published paper beside the print."""
    from .. import simulate

    end(lambda: simulate.reproduce(name, trials, seed))
