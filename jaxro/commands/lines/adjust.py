"""The command line of `jaxro adjust`."""

from pathlib import Path
from typing import Annotated

import typer

from ..ending import end
from . import options as given

File = Annotated[
    Path | None,
    typer.Argument(
        help="CSV table of measurements between points: kind,from,to,value,sigma; kinds "
        "are height, distance, slope, direction, angle (with other), azimuth, zenith and "
        "vector (dX,dY,dZ with deviations and covariances). from,to,difference and sigma "
        "or length_km is a net of levelling. A file .xml or .gkf is input of "
        "GNU Gama. Without it a simulated network.",
        metavar="NETWORK.csv",
        show_default=False,
    ),
]
Points = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of points: point,X,Y,Z, blank where not known, optionally "
        "sX,sY,sZ or sigma, and role: control (held where it has no deviation), check, "
        "approximate. Without known points the network is free.",
        metavar="POINTS.csv",
        show_default=False,
    ),
]
Covariances = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of covariances between coordinates that are known with "
        "deviations: point,other and cXX ... cZZ.",
        metavar="COVARIANCES.csv",
        show_default=False,
    ),
]
Sigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of every measurement that has none, of a kilometre of "
        "levelling with length_km.",
        metavar="SD",
        show_default=False,
    ),
]
Unknown = Annotated[
    bool,
    typer.Option(
        "--unknown-sigma0",
        help="The standard deviations are relative: sigma0 is estimated.",
    ),
]
Level = Annotated[
    float,
    typer.Option(help="Probability that any test rejects where nothing is wrong."),
]
Angles = Annotated[
    str,
    typer.Option(help="Unit of directions and angles: degrees, gon, radians."),
]
Unit = Annotated[
    str, typer.Option(help="Name of the unit of lengths: m, ft.", metavar="NAME")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for points.csv, measurements.csv (residuals, tests, detectable and "
        "identifiable errors) and summary.json.",
        metavar="DIR",
        show_default=False,
    ),
]
Promise = Annotated[
    int | None,
    typer.Option(
        min=100,
        help="Simulate so many networks like this one and judge them, too: how often each "
        "verdict is right, and what the intervals hold. 1000 tells it to 1 %.",
        metavar="N",
        show_default=False,
    ),
]
Wrong = Annotated[
    int | None,
    typer.Option(help="Wrong measurements in each of them, 1 by default.", metavar="K"),
]
Size = Annotated[
    float | None,
    typer.Option(
        help="Their errors, in standard deviations, 6 by default.", metavar="S"
    ),
]


def adjust(
    file: File = None,
    points: Points = None,
    covariances: Covariances = None,
    sigma: Sigma = None,
    sigma0_unknown: Unknown = False,
    level: Level = 0.05,
    angles: Angles = "degrees",
    unit: Unit = "m",
    promise: Promise = None,
    wrong: Wrong = None,
    size: Size = None,
    out: Out = None,
    force: given.Force = False,
    json: given.Json = False,
) -> None:
    """Adjust a network of levelling, distances, directions and vectors.

    Coordinates with standard deviations, and which measurement is wrong: tests with a
    true level for all together, detectable and identifiable errors. Exit code 0: it
    fits; 1: something is wrong or not determined; 2: bad input, nothing written.
    """
    from ..adjust import Options, run

    options = Options(
        file=file,
        points=points,
        covariances=covariances,
        sigma=sigma,
        sigma0_unknown=sigma0_unknown,
        level=level,
        angles=angles,
        unit=unit,
        out=out,
        force=force,
        json=json,
        promise=promise,
        wrong=wrong,
        size=size,
    )
    end(lambda: run(options))
