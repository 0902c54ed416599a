"""The command line of `jaxro calibrate`."""

from pathlib import Path
from typing import Annotated

import typer

from ..calibration_models import MODELS, ZONES
from ..calibration_request import Options
from ..ending import end
from . import options as given

Places = Annotated[
    Path | None,
    typer.Argument(
        help="CSV table of measured places: point,x,y, optionally image (several in "
        "one table), sigma, camera (which one took the image). Without it a simulated "
        "photo.",
        metavar="IMAGE.csv",
        show_default=False,
    ),
]
ObjectPoints = Annotated[
    Path | None,
    typer.Option(
        "--object",
        help="CSV table of the object: point,X,Y,Z, optionally sX,sY,sZ or sigma. Empty "
        "coordinates: an unknown point, of several images.",
        metavar="POINTS.csv",
        show_default=False,
    ),
]
ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        help=f"One of {', '.join(MODELS)}.  [default: what the evidence chooses of all]",
        metavar="NAME",
        show_default=False,
    ),
]
Zones = Annotated[
    str | None,
    typer.Option(
        help=f"Zones with a focal length each: {ZONES}.",
        metavar="KIND:N",
        show_default=False,
    ),
]
ZonesAlongY = Annotated[
    str | None,
    typer.Option(
        "--zones-y",
        help="Zones of another focal length along y; --zones is then that along x.",
        metavar="KIND:N",
        show_default=False,
    ),
]
Fisheye = Annotated[
    bool,
    typer.Option("--fisheye", help="Stereographic rays, for lenses beyond some 100°."),
]
PrincipalPoint = Annotated[
    tuple[float, float] | None,
    typer.Option(
        help="What is known of the principal place, in the measuring system; of every "
        "camera.",
        metavar="X Y",
        show_default=False,
    ),
]
PrincipalSigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of --principal-point.  [default: 0]",
        metavar="SD",
        show_default=False,
    ),
]
Focal = Annotated[
    float | None,
    typer.Option(
        help="What is known of the focal length, in the unit of the image; of every "
        "camera.",
        metavar="F",
        show_default=False,
    ),
]
FocalSigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of --focal.  [default: 0]",
        metavar="SD",
        show_default=False,
    ),
]
Sigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of a measured coordinate, in the unit of the image; "
        "sigma0 is then a ratio to it, and tested.",
        metavar="SD",
        show_default=False,
    ),
]
YDown = Annotated[
    bool | None,
    typer.Option(
        "--y-down/--y-up",
        help="Whether y counts downwards when x counts to the right.  [default: what "
        "the points tell]",
        show_default=False,
    ),
]
ByDistances = Annotated[
    bool,
    typer.Option(
        "--distances",
        help="By distances between the points, as in the paper, beside coordinates.",
    ),
]
OwnCameras = Annotated[
    bool,
    typer.Option(
        "--own-cameras",
        help="Several images together, each with a camera of its own.",
    ),
]
Separately = Annotated[
    bool,
    typer.Option(
        "--separately",
        help="Each image alone, by the model that it needs; all points are known.",
    ),
]
Differences = Annotated[
    list[str] | None,
    typer.Option(
        "--difference",
        help="Two images, as often as wanted: whether their distortion is the same, "
        "in one measuring system of one camera. With --separately.",
        metavar="LEFT,RIGHT",
        show_default=False,
    ),
]
Refocused = Annotated[
    bool,
    typer.Option(
        "--refocused",
        help="With --difference: the focal length may have changed.",
    ),
]
Correct = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of places to be corrected: image,point,x,y; written as "
        "corrected.csv.",
        metavar="FILE.csv",
        show_default=False,
    ),
]
Pairs = Annotated[
    list[str] | None,
    typer.Option(
        "--pair",
        help="Two images, as often as wanted: their corrected places become pairs.csv "
        "and cameras.toml, for jaxro orient and clean.",
        metavar="LEFT,RIGHT",
        show_default=False,
    ),
]
Unit = Annotated[
    str, typer.Option(help="Name of the unit of the image: px, mm.", metavar="NAME")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for cameras.csv, stations.csv, zones.csv, corrections.csv, "
        "residuals.csv, points.csv, variants.csv, difference.csv, opencv.json and pictures.",
        metavar="DIR",
        show_default=False,
    ),
]


def calibrate(
    file: Places = None,
    object_points: ObjectPoints = None,
    model: ModelName = None,
    zones: Zones = None,
    zones_y: ZonesAlongY = None,
    fisheye: Fisheye = False,
    principal_point: PrincipalPoint = None,
    principal_sigma: PrincipalSigma = None,
    focal: Focal = None,
    focal_sigma: FocalSigma = None,
    sigma: Sigma = None,
    y_down: YDown = None,
    distances: ByDistances = False,
    own_cameras: OwnCameras = False,
    separately: Separately = False,
    difference: Differences = None,
    refocused: Refocused = False,
    correct: Correct = None,
    pair: Pairs = None,
    unit: Unit = "px",
    out: Out = None,
    report: given.Report = None,
    plots: given.Plots = None,
    json: given.Json = False,
    force: given.Force = False,
) -> None:
    """Find camera and distortion of photos of known points.

    Station, tilts, and distortion by zones, a lens or a displacement field, chosen by
    the evidence; several images together, with unknown points. Exit code 0: all usable;
    1: some image not; 2: bad input, nothing written.
    """
    from ..calibrate import run
    from ..documents import Documents

    options = Options(
        file=file,
        object=object_points,
        model=model,
        zones=zones,
        zones_y=zones_y,
        fisheye=fisheye,
        principal_point=principal_point,
        principal_sigma=principal_sigma,
        focal=focal,
        focal_sigma=focal_sigma,
        sigma=sigma,
        y_down=y_down,
        distances=distances,
        own_cameras=own_cameras,
        separately=separately,
        differences=tuple(difference or ()),
        refocused=refocused,
        correct=correct,
        pairs=tuple(pair or ()),
        unit=unit,
        out=out,
        force=force,
        documents=Documents(report, plots, json),
    )
    end(lambda: run(options))
