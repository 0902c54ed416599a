"""The command line: `jaxro orient [FILE.csv]`.

Exit code 0: every pair has usable elements; 1: at least one has not; 2: the input could not be used.
"""

import enum
from pathlib import Path
from typing import Annotated

try:
    import typer
except ModuleNotFoundError:
    raise SystemExit("The command line needs typer and rich: pip install 'jaxro[cli]'") from None

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True, rich_markup_mode=None)


class System(enum.StrEnum):
    """Elements by the names of the command line."""

    relative = "relative"
    dependent = "dependent"
    independent = "independent"


class Residual(enum.StrEnum):
    """Residuals by the names of the command line."""

    rigorous = "rigorous"
    parallax = "parallax"


@app.callback()
def main() -> None:
    """Photogrammetric relative orientation of measured stereo pairs."""


@app.command()
def orient(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="CSV table with the columns point,x_left,y_left,x_right,y_right (or id,xl,yl,xr,yr) and optionally "
            "pair, sigma. Without it the embedded example is oriented.",
            metavar="FILE.csv",
            show_default=False,
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="[camera], or [left] and [right], or [photo.NAME] for pairs named LEFT-RIGHT or LEFT_RIGHT; "
            "keys focal, principal_point, pixel_size, y_down.",
            metavar="FILE.toml",
            show_default=False,
        ),
    ] = None,
    focal: Annotated[
        float | None, typer.Option(help="Focal length in photo units, of both photos.", metavar="F", show_default=False)
    ] = None,
    principal_point: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Principal point x y, in the units of the table.  [default: 0 0]", metavar="X Y", show_default=False
        ),
    ] = None,
    pixel_size: Annotated[
        float | None,
        typer.Option(
            help="Photo units per unit of the table, e.g. mm per pixel.  [default: 1]",
            metavar="SIZE",
            show_default=False,
        ),
    ] = None,
    y_down: Annotated[bool, typer.Option("--y-down", help="y of the table counts downwards.")] = False,
    sigma: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of every coordinate before the adjustment, in the units of the table; "
            "sigma0 is then a ratio to it.",
            metavar="SD",
            show_default=False,
        ),
    ] = None,
    elements: Annotated[
        System | None,
        typer.Option(
            help="System of elements.  [default: relative, which exists for photos in any position; "
            "dependent for the example]",
            show_default=False,
        ),
    ] = None,
    base: Annotated[
        float | None,
        typer.Option(
            help="bx of the dependent, b of the independent system: the scale of the model.  "
            "[default: mean x-parallax]",
            metavar="B",
            show_default=False,
        ),
    ] = None,
    residual: Annotated[
        Residual, typer.Option(help="What is minimised: whitened conditions, or strict y-parallaxes.")
    ] = Residual.rigorous,
    unit: Annotated[str, typer.Option(help="Name of the photo unit in reports: mm, px.", metavar="NAME")] = "mm",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for elements.csv, residuals.csv, points.csv, summary.json.", metavar="DIR", show_default=False
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the files in a folder that is not empty.")] = False,
) -> None:
    """Orient every pair of FILE: elements with standard deviations, y-parallaxes, m_q, model points.

    Exit code 0: all usable; 1: some pair failed; 2: bad input, nothing written.
    """
    from . import program_store
    from .io.job import Options, run
    from .io.tables import TableError

    program_store.use(program_store.default_folder())

    options = Options(
        file, camera, focal, principal_point, pixel_size, y_down, sigma, elements, base, residual, unit, out, force
    )
    try:
        all_usable = run(options)
    except TableError as error:
        typer.secho(f"Error: {error}", err=True, fg="red")
        raise typer.Exit(2) from None
    raise typer.Exit(0 if all_usable else 1)
