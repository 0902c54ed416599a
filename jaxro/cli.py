"""The command line: `jaxro orient`, `clean`, `calibrate`, `absolute`, `block`, `colmap`,
`compare`, `reproduce`, `heights`, `plan`.

Exit code 0: every pair has usable elements; 1: at least one has not; 2: the input could
not be used.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

try:
    import typer
except ModuleNotFoundError:
    raise SystemExit(
        "The command line needs typer and rich: pip install 'jaxro[cli]'"
    ) from None

from .commands import options as given
from .commands.absolute_line import absolute
from .commands.block_line import block
from .commands.calibration_line import calibrate
from .commands.ending import end
from .commands.options import Engine, Residual
from .experiments import REPRODUCTIONS
from .rejection import PROCEDURES

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.callback()
def main(version: given.Version = False) -> None:
    """Photogrammetric relative orientation of measured stereo pairs."""


@app.command()
def orient(
    file: Annotated[
        Path | None, given.file("Without it the embedded example is oriented.")
    ] = None,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    semicolons: given.Semicolons = False,
    sigma: given.Sigma = None,
    elements: given.Elements = None,
    base: given.Base = None,
    residual: given.Minimised = Residual.rigorous,
    unit: given.Unit = "mm",
    out: given.OrientedFiles = None,
    force: given.Force = False,
    confidence: given.Confidence = None,
    tables: given.Tables = None,
    resume: given.Resume = False,
    parquet: given.Parquet = False,
    engine: given.Where = Engine.local,
) -> None:
    """Orient every pair of FILE: elements with standard deviations, y-parallaxes, m_q,
    model points.

    Exit code 0: all usable; 1: some pair failed; 2: bad input, nothing written.
    """
    from .commands.orient import run
    from .commands.request import Options

    options = Options(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        semicolons=semicolons,
        sigma=sigma,
        elements=elements,
        base=base,
        residual=residual,
        unit=unit,
        out=out,
        force=force,
        confidence=confidence,
    )
    if given.large(file, parquet, resume, tables, engine):
        from .commands import large

        end(
            lambda: large.run(
                options, large.Large(tables, resume, engine=_engine(engine))
            )
        )
    else:
        end(lambda: run(options))


@app.command()
def clean(
    file: Annotated[
        Path | None,
        given.file("Without it a simulated example with one wrong point is cleaned."),
    ] = None,
    procedure: Annotated[
        str | None,
        typer.Option(
            help=f"One of {', '.join(PROCEDURES)}.", metavar="NAME", show_default=False
        ),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            help="Another value for a number of the procedure, as often as wanted; an "
            "unknown NAME lists them.",
            metavar="NAME=VALUE",
            show_default=False,
        ),
    ] = None,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    semicolons: given.Semicolons = False,
    sigma: given.Sigma = None,
    elements: given.Elements = None,
    base: given.Base = None,
    residual: given.Minimised = Residual.rigorous,
    unit: given.Unit = "mm",
    out: given.CleanedFiles = None,
    force: given.Force = False,
    tables: given.Tables = None,
    resume: given.Resume = False,
    parquet: given.Parquet = False,
    engine: given.Where = Engine.local,
) -> None:
    """Find the wrong points of every pair of FILE.

    Which, in what order, on what evidence; and the orientation of the points kept. Exit
    code 0: all cleaned and usable; 1: some pair not; 2: bad input, nothing written.
    """
    from .commands.clean import DEFAULT, choose_procedure, run
    from .commands.request import Options

    options = Options(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        semicolons=semicolons,
        sigma=sigma,
        elements=elements,
        base=base,
        residual=residual,
        unit=unit,
        out=out,
        force=force,
    )
    name, changes = DEFAULT if procedure is None else procedure, tolerance or []
    if given.large(file, parquet, resume, tables, engine):
        from .commands import large

        how = large.Large(tables, resume, engine=_engine(engine))
        end(lambda: large.run(options, how, choose_procedure(name, changes)))
    else:
        end(lambda: run(options, name, changes))


app.command()(calibrate)
app.command()(absolute)
app.command()(block)


@app.command()
def colmap(
    database: Annotated[
        Path,
        typer.Argument(
            help="COLMAP database with cameras, keypoints and matches.",
            metavar="DATABASE.db",
            show_default=False,
        ),
    ],
    sigma: given.KeypointSigma = 1.0,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A copy to write to.  [default: the database itself]",
            metavar="NEW.db",
            show_default=False,
        ),
    ] = None,
    assume_calibrated: given.AssumeCalibrated = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Replace geometries that are there, and the file of --out."
        ),
    ] = False,
) -> None:
    """Orient every matched pair of a COLMAP database.

    In spite of wrong matches, photos in any position; writes two_view_geometries, all
    or none. Exit code 0: every pair has a geometry; 1: some pair has none; 2: bad
    input, nothing written.
    """
    from .commands.colmap import Options, run

    end(
        lambda: run(
            Options(
                database=database,
                sigma=sigma,
                out=out,
                force=force,
                assume_calibrated=assume_calibrated,
            )
        )
    )


@app.command()
def compare(
    file: Annotated[
        Path | None,
        given.file(
            "Its first pair is the layout; without it 16 points in eight rows, and 8 "
            "points."
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
    size: given.ErrorSizes = "4,6,8,10,15",
    trials: given.Trials = 1000,
    false_alarms: given.FalseAlarms = 0.05,
    seed: given.Seed = 0,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    semicolons: given.Semicolons = False,
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
    out: Annotated[
        Path | None,
        typer.Option(
            help="The figures in full precision.",
            metavar="FILE.csv",
            show_default=False,
        ),
    ] = None,
    force: given.ForceFile = False,
) -> None:
    """Compare procedures on the layout of FILE.

    By simulation: what each finds of the errors planted, and what it costs in good
    points. Exit code 0: done; 2: bad input, nothing written.
    """
    from .commands.request import Options
    from .commands.simulate import Wanted, run_comparison

    options = Options(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        semicolons=semicolons,
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
        force=force,
    )
    end(lambda: run_comparison(options, wanted))


@app.command()
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
    """Calculate a paper's tables beside the print."""
    from .commands import simulate

    end(lambda: simulate.reproduce(name, trials, seed))


@app.command()
def heights(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="CSV table, mm: point,square,parallax, optionally grid (the grid read "
            "at the point), x, y (for the "
            "picture), height (where it is known). Without it a simulated plot.",
            metavar="READINGS.csv",
            show_default=False,
        ),
    ] = None,
    grid: given.GridTable = None,
    traverses: given.TraverseTable = None,
    camera_height: given.CameraHeight = None,
    base: given.HorizontalBase = None,
    sd: given.Deviation = None,
    semicolons: given.Semicolons = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for heights.csv, traverses.csv, legs.csv, summary.json, "
            "surface.png.",
            metavar="DIR",
            show_default=False,
        ),
    ] = None,
    force: given.Force = False,
) -> None:
    """Heights over a grid of squares from parallaxes.

    With standard deviations, adjusted over the traverses between points, whose
    misclosures are tested. Exit code 0: done; 1: a wrong leg, or a known height that is
    not what is read there; 2: bad input, nothing written.
    """
    from .commands.heights import Options, run

    end(
        lambda: run(
            Options(
                file=file,
                grid=grid,
                traverses=traverses,
                camera_height=camera_height,
                base=base,
                deviations=sd or [],
                out=out,
                force=force,
                semicolons=semicolons,
            )
        )
    )


@app.command()
def plan(
    focal: Annotated[float, typer.Option(help="Focal length, mm.", metavar="F")] = 75.0,
    camera_height: Annotated[
        float, typer.Option(help="Of the cameras over the grid, mm.", metavar="H")
    ] = 2100.0,
    base: given.HorizontalBase = None,
    side: Annotated[float, typer.Option(help="Of a square, mm.", metavar="L")] = 100.0,
    depth: Annotated[
        float, typer.Option(help="Of the points below the grid, mm.", metavar="D")
    ] = 200.0,
    step: Annotated[
        float,
        typer.Option(
            help="Difference of height of neighbouring points, mm.", metavar="D"
        ),
    ] = 20.0,
    legs: Annotated[int, typer.Option(help="Of a traverse.", metavar="N")] = 9,
    traverses: Annotated[
        int, typer.Option(help="That meet in a node.", metavar="K")
    ] = 3,
    sd: given.Deviation = None,
    want: Annotated[
        float | None,
        typer.Option(
            help="A standard deviation, mm, that base or camera height should give.",
            metavar="M",
            show_default=False,
        ),
    ] = None,
    of: Annotated[
        str,
        typer.Option(
            help="What is wanted: height, difference, in-square, middle, node, detail.",
            metavar="WHAT",
        ),
    ] = "height",
) -> None:
    """Accuracy to expect of a survey over a grid.

    Of heights, differences, traverses and nodes, and what each source of error adds; or
    what a wanted one needs. Without --base the largest, a quarter of the camera height.
    Exit code 0: done; 2: bad input, or not reachable.
    """
    from .commands.plan import Options, run

    end(
        lambda: run(
            Options(
                focal=focal,
                camera_height=camera_height,
                base=base,
                side=side,
                depth=depth,
                step=step,
                legs=legs,
                traverses=traverses,
                deviations=sd or [],
                want=want,
                of=of,
            )
        )
    )


def _engine(name: Engine) -> Callable:
    from .commands.cluster import on_ray
    from .commands.journal import here

    return {Engine.local: here, Engine.ray: on_ray}[name]
