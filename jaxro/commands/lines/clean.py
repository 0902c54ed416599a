"""The command line of `jaxro clean`."""

from pathlib import Path
from typing import Annotated

import typer

from ...rejection import PROCEDURES
from ..ending import end
from . import options as given
from .options import Engine, Residual


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
    promise: Annotated[
        int | None,
        typer.Option(
            min=100,
            help="Simulate so many pairs like each one and clean them, too: how often "
            "the intervals then hold the truth. 1000 tells it to 1 %.",
            metavar="N",
            show_default=False,
        ),
    ] = None,
    camera: given.Camera = None,
    focal: given.Focal = None,
    principal_point: given.PrincipalPoint = None,
    pixel_size: given.PixelSize = None,
    y_down: given.YDown = False,
    sigma: given.Sigma = None,
    elements: given.Elements = None,
    base: given.Base = None,
    residual: given.Minimised = Residual.rigorous,
    unit: given.Unit = "mm",
    out: given.CleanedFiles = None,
    report: given.Report = None,
    plots: given.Plots = None,
    json: given.Json = False,
    force: given.Force = False,
    tables: given.Tables = None,
    resume: given.Resume = False,
    parquet: given.Parquet = False,
    engine: given.Where = Engine.local,
) -> None:
    """Find wrong points, and orient the others.

    Which, in what order, on what evidence; and the orientation of the points kept. Exit
    code 0: all cleaned and usable; 1: some pair not; 2: bad input, nothing written.
    """
    from ..clean import DEFAULT, choose_procedure, run
    from ..documents import Documents
    from ..request import Options

    options = Options(
        file=file,
        camera=camera,
        focal=focal,
        principal_point=principal_point,
        pixel_size=pixel_size,
        y_down=y_down,
        sigma=sigma,
        elements=elements,
        base=base,
        residual=residual,
        unit=unit,
        out=out,
        force=force,
        documents=Documents(report, plots, json),
    )
    name, changes = DEFAULT if procedure is None else procedure, tolerance or []
    together = bool(options.documents) or json or promise is not None
    if given.large(file, parquet, resume, tables, engine, together):
        from .. import large

        if promise is not None:
            raise typer.BadParameter(
                "a table that is worked on in parts has no --promise: give it a smaller "
                "one, of some of its pairs"
            )
        how = large.Large(tables, resume, engine=given.engine_of(engine))
        end(lambda: large.run(options, how, choose_procedure(name, changes)))
    else:
        end(lambda: run(options, name, changes, promise))
