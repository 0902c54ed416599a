"""What several commands accept on the command line: one annotated type an argument."""

import enum
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ... import __version__
from ...tables.whole import is_parquet


class System(enum.StrEnum):
    """Elements by the names of the command line."""

    relative = "relative"
    dependent = "dependent"
    independent = "independent"


class Residual(enum.StrEnum):
    """Residuals by the names of the command line."""

    rigorous = "rigorous"
    parallax = "parallax"


class Engine(enum.StrEnum):
    """Where tables of any size are worked on, by the names of the command line."""

    local = "local"
    ray = "ray"


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"jaxro {__version__}")
        raise typer.Exit
    return wanted


Version = Annotated[
    bool,
    typer.Option(
        "--version", help="Show the version.", callback=_show_version, is_eager=True
    ),
]


COLUMNS = (
    "CSV table with the columns point,x_left,y_left,x_right,y_right (or "
    "id,xl,yl,xr,yr) and optionally pair, sigma; or one row for each place, "
    "photo,point,x,y; or pairs of other programs: FILE.h5, "
    "Bundler's FILE.out, the folder of a COLMAP text model."
)


def file(otherwise: str) -> typer.models.ArgumentInfo:
    """The table; `otherwise`: what is done without one."""
    return typer.Argument(
        help=f"{COLUMNS} {otherwise}", metavar="FILE.csv", show_default=False
    )


Camera = Annotated[
    Path | None,
    typer.Option(
        help="[camera], or [left] and [right], or [photo.NAME] for pairs named "
        "LEFT-RIGHT or LEFT_RIGHT; "
        "keys focal, principal_point, pixel_size, y_down.",
        metavar="FILE.toml",
        show_default=False,
    ),
]
Focal = Annotated[
    float | None,
    typer.Option(
        help="Focal length in photo units, of both photos.",
        metavar="F",
        show_default=False,
    ),
]
PrincipalPoint = Annotated[
    tuple[float, float] | None,
    typer.Option(
        help="Principal point x y, in the units of the table.  [default: 0 0]",
        metavar="X Y",
        show_default=False,
    ),
]
PixelSize = Annotated[
    float | None,
    typer.Option(
        help="Photo units per unit of the table, e.g. mm per pixel.  [default: 1]",
        metavar="SIZE",
        show_default=False,
    ),
]
YDown = Annotated[
    bool, typer.Option("--y-down", help="y of the table counts downwards.")
]
Sigma = Annotated[
    str | None,
    typer.Option(
        help="Standard deviation of every coordinate before the adjustment, in the "
        "units of the table; "
        "sigma0 is then a ratio to it. auto: that of the residuals of the table, in "
        "spite of wrong points.",
        metavar="SD|auto",
        show_default=False,
    ),
]
Elements = Annotated[
    System | None,
    typer.Option(
        help="System of elements.  [default: relative, which exists for photos in any "
        "position; "
        "dependent for the example]",
        show_default=False,
    ),
]
Base = Annotated[
    float | None,
    typer.Option(
        help="bx of the dependent, b of the independent system: the scale of the "
        "model.  [default: mean x-parallax]",
        metavar="B",
        show_default=False,
    ),
]
Minimised = Annotated[
    Residual,
    typer.Option(
        help="What is minimised: whitened conditions, or strict y-parallaxes."
    ),
]
Confidence = Annotated[
    float | None,
    typer.Option(
        help="Show and write the intervals that hold the elements with this "
        "probability, e.g. 0.95: Student's t, or "
        "normal where sigma is given. Of CSV results.",
        metavar="P",
        show_default=False,
    ),
]
Unit = Annotated[
    str, typer.Option(help="Name of the photo unit in reports: mm, px.", metavar="NAME")
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Overwrite the files in a folder that is not empty; Parquet results "
        "replace those of an earlier run.",
    ),
]
Seed = Annotated[
    int,
    typer.Option(help="Seed of the random numbers.", metavar="S", min=0, max=2**63 - 1),
]

Report = Annotated[
    Path | None,
    typer.Option(
        help="The whole report as one page for a browser (or .pdf), with pictures.",
        metavar="FILE.html",
        show_default=False,
    ),
]
Plots = Annotated[
    Path | None,
    typer.Option(help="Folder for pictures.", metavar="DIR", show_default=False),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json",
        help="For programs: the content of summary.json in place of the report.",
    ),
]

OrientedFiles = Annotated[
    Path | None,
    typer.Option(
        help="Folder for elements.csv, residuals.csv, points.csv, reliability.csv, "
        "summary.json.",
        metavar="DIR",
        show_default=False,
    ),
]
CleanedFiles = Annotated[
    Path | None,
    typer.Option(
        help="Folder for cleaned.csv (every row with its verdict), decisions.csv "
        "and decisions.json (how it came "
        "about), and of the points kept the files of `jaxro orient`.",
        metavar="DIR",
        show_default=False,
    ),
]
WrongPoints = Annotated[
    str, typer.Option(help="Numbers of wrong points.", metavar="N,N,...")
]
ErrorSizes = Annotated[
    str, typer.Option(help="Sizes of their errors, in sigma.", metavar="K,K,...")
]
Trials = Annotated[
    int, typer.Option(help="Simulated pairs in every setting.", metavar="T")
]
FalseAlarms = Annotated[
    float,
    typer.Option(
        help="Share of pairs without errors that lose a point in the comparison at "
        "equal terms; 0: without it.",
        metavar="P",
    ),
]

ForceFile = Annotated[
    bool, typer.Option("--force", help="Overwrite the files of --out and --plot.")
]

GridTable = Annotated[
    Path | None,
    typer.Option(
        help="The squares: square,side,photo_side (mm; on the right photo), optionally "
        "parallax (the grid read there), "
        "height.",
        metavar="GRID.csv",
        show_default=False,
    ),
]
TraverseTable = Annotated[
    Path | None,
    typer.Option(
        help="Legs in order, each read anew: traverse,from,to,back,fore; a square's "
        "name is its corner.",
        metavar="FILE.csv",
        show_default=False,
    ),
]
CameraHeight = Annotated[
    float | None,
    typer.Option(
        help="Of both cameras over the zero of heights (the grid), mm.",
        metavar="H",
        show_default=False,
    ),
]
HorizontalBase = Annotated[
    float | None,
    typer.Option(
        help="Horizontal distance of the cameras, mm.", metavar="B", show_default=False
    ),
]
Deviation = Annotated[
    list[str] | None,
    typer.Option(
        "--sd",
        help="A standard deviation in mm, as often as wanted; an unknown NAME lists "
        "them with their defaults.",
        metavar="NAME=VALUE",
        show_default=False,
    ),
]
KeypointSigma = Annotated[
    float,
    typer.Option(
        help="Standard deviation of a keypoint coordinate in pixels.", metavar="SD"
    ),
]
AssumeCalibrated = Annotated[
    bool,
    typer.Option(
        "--assume-calibrated",
        help="Take focal lengths as known that the database marks as guessed.",
    ),
]
Tables = Annotated[
    str | None,
    typer.Option(
        help="Of Parquet results: some of elements,residuals,points,reliability.  "
        "[default: the first three]",
        metavar="NAME,...",
        show_default=False,
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume", help="Go on with a run of Parquet results that was stopped."
    ),
]
Parquet = Annotated[
    bool,
    typer.Option(
        "--parquet",
        help="Results as Parquet tables, part by part: any number of pairs, bounded "
        "memory. Always for FILE.parquet.",
    ),
]
Where = Annotated[
    Engine,
    typer.Option(
        help="Where Parquet results are worked on: here, or on a Ray cluster."
    ),
]


def large(
    file: Path | None,
    parquet: bool,
    resume: bool,
    tables: str | None,
    engine: Engine,
    together: bool,
) -> bool:
    """Whether the results are Parquet tables, part by part; nothing that only these
    know may be asked of others. `together`: whether all pairs are looked at together,
    for a report, say: then a Parquet table is one as any other."""
    from_parquet = file is not None and is_parquet(file) and not together
    wanted = parquet or resume or from_parquet
    for name, given in (
        ("--tables", tables is not None),
        ("--engine", engine is not Engine.local),
    ):
        if given and not wanted:
            raise typer.BadParameter(
                "it is for Parquet results: add --parquet", param_hint=name
            )
    return wanted


def engine_of(name: Engine) -> Callable:
    """What works on the parts of a large table."""
    from ..cluster import on_ray
    from ..journal import here

    return {Engine.local: here, Engine.ray: on_ray}[name]
