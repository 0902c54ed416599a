"""The command line of `jaxro block`."""

from pathlib import Path
from typing import Annotated

import typer

from ...tables.whole import is_parquet
from ..ending import end
from . import options as given

Control = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of points on the ground: point,X,Y,Z, blank where a coordinate "
        "is not known, sX,sY,sZ or sigma, and optionally role: control, check, station "
        "(of the photo of this name). Without it the block is a free network.",
        metavar="GROUND.csv",
        show_default=False,
    ),
]
ControlSigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of every ground coordinate, where the table has none.",
        metavar="SD",
        show_default=False,
    ),
]
Rays = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of further places, such as control points on one photo: "
        "photo,point,x,y, optionally sigma.",
        metavar="RAYS.csv",
        show_default=False,
    ),
]
Sigma = Annotated[
    str | None,
    typer.Option(
        help="Standard deviation of every image coordinate, in the units of the table."
        "  [default: auto, that of the residuals of the pairs]",
        metavar="SD|auto",
        show_default=False,
    ),
]
BarTable = Annotated[
    Path | None,
    typer.Option(
        "--bars",
        help="CSV table of known distances between points: from,to,length, and sigma or "
        "--control-sigma.",
        metavar="BARS.csv",
        show_default=False,
    ),
]
InnerNames = Annotated[
    str | None,
    typer.Option(
        "--inner",
        help="Inner parameters of the cameras that are unknown, too: some of "
        "focal,principal,k1,k2,k3,tangential,affinity,field, the last a displacement "
        "field of any smooth form.",
        metavar="NAME,...",
        show_default=False,
    ),
]
Datum = Annotated[
    str | None,
    typer.Option(
        help="What the deviations of a free network refer to: photos, points (all of "
        "them), or some points by their names.  [default: photos]",
        metavar="photos|points|NAME,...",
        show_default=False,
    ),
]
Components = Annotated[
    bool,
    typer.Option(
        "--components",
        help="Adjust with the standard deviations of places, control and stations as "
        "their residuals tell them (variance components).",
    ),
]
Conditions = Annotated[
    bool,
    typer.Option(
        "--conditions",
        help="Adjust a small block by the conditions of the 1982 fragment as well, and "
        "tell how far both solutions are apart.",
    ),
]
Classical = Annotated[
    bool,
    typer.Option(
        "--classical",
        help="Show beside it what the classical adjustment of independent models claims, "
        "and how accurate it truly is.",
    ),
]
Level = Annotated[
    float,
    typer.Option(
        help="Probability that anything is called wrong if nothing is.", metavar="P"
    ),
]
Unit = Annotated[
    str, typer.Option(help="Name of the unit of the ground: m, ft.", metavar="NAME")
]
PhotoUnit = Annotated[
    str, typer.Option(help="Name of the unit of the photos: mm, px.", metavar="NAME")
]
Strips = Annotated[
    int | None,
    typer.Option(
        help="Of the simulated block: its strips.  [default: 1]",
        metavar="S",
        min=1,
        max=200,
        show_default=False,
    ),
]
Models = Annotated[
    int | None,
    typer.Option(
        help="Of the simulated block: models of each strip.  [default: 6]",
        metavar="M",
        min=2,
        max=10_000,
        show_default=False,
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(
        help="Of the simulated block: seed of its random numbers.  [default: 1]",
        metavar="N",
        min=0,
        show_default=False,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for photos, points, control, residuals, covariances as CSV "
        "(Parquet for a Parquet table), summary.json, block.png; of the simulated block "
        "pairs.csv and ground.csv as well.",
        metavar="DIR",
        show_default=False,
    ),
]
Parquet = Annotated[bool, typer.Option("--parquet", help="Results as Parquet tables.")]


def block(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="Table of pairs as of jaxro orient, CSV or Parquet, with the columns "
            "left and right (the names of the photos) or pairs named LEFT-RIGHT; or of "
            "places, one row for each: photo,point,x,y, optionally sigma and camera; or "
            "Bundler's FILE.out, or the folder of a COLMAP text model. Without it a "
            "simulated block.",
            metavar="PAIRS.csv",
            show_default=False,
        ),
    ] = None,
    control: Control = None,
    control_sigma: ControlSigma = None,
    rays: Rays = None,
    bars: BarTable = None,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    sigma: Sigma = None,
    inner: InnerNames = None,
    datum: Datum = None,
    components: Components = False,
    conditions: Conditions = False,
    classical: Classical = False,
    level: Level = 0.05,
    unit: Unit = "m",
    photo_unit: PhotoUnit = "mm",
    strips: Strips = None,
    models: Models = None,
    seed: Seed = None,
    out: Out = None,
    report: given.Report = None,
    plots: given.Plots = None,
    json: given.Json = False,
    force: given.Force = False,
    parquet: Parquet = False,
) -> None:
    """Join the pairs of a strip or block on the ground.

    Photos, points and control with standard deviations from the image measurements;
    wrong places and wrong control named. Exit code 0: usable; 1: too much is wrong; 2:
    bad input, nothing written.
    """
    from ..block import Options, run
    from ..documents import Documents
    from ..request import Options as Measured

    measured = Measured(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        sigma=sigma,
        unit=photo_unit,
        out=out,
        force=force,
        documents=Documents(report, plots, json),
    )
    options = Options(
        measured=measured,
        control=control,
        control_sigma=control_sigma,
        rays=rays,
        bars=bars,
        inner=inner,
        datum=datum,
        components=components,
        conditions=conditions,
        classical=classical,
        level=level,
        unit=unit,
        parquet=parquet or (file is not None and is_parquet(file)),
        strips=strips,
        models=models,
        seed=seed,
    )
    end(lambda: run(options))
