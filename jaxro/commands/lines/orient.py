"""The command line of `jaxro orient`."""

from pathlib import Path
from typing import Annotated

import typer

from ..ending import end
from . import options as given
from .options import Engine, Residual


def orient(
    file: Annotated[
        Path | None, given.file("Without it the embedded example is oriented.")
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
    out: given.OrientedFiles = None,
    report: given.Report = None,
    plots: given.Plots = None,
    json: given.Json = False,
    force: given.Force = False,
    g2o: Annotated[
        Path | None,
        typer.Option(
            help="The pairs as a pose graph with information matrices, for g2o and "
            "GTSAM. Of pairs that name their photos.",
            metavar="FILE.g2o",
            show_default=False,
        ),
    ] = None,
    confidence: given.Confidence = None,
    tables: given.Tables = None,
    resume: given.Resume = False,
    parquet: given.Parquet = False,
    engine: given.Where = Engine.local,
) -> None:
    """Relative orientation of every pair of a table.

    Elements with standard deviations, y-parallaxes, m_q, model points. Exit code 0: all
    usable; 1: some pair failed; 2: bad input, nothing written.
    """
    from ..documents import Documents
    from ..orient import run
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
        confidence=confidence,
        g2o=g2o,
    )
    together = bool(options.documents) or json or g2o is not None
    if given.large(file, parquet, resume, tables, engine, together):
        from .. import large

        end(
            lambda: large.run(
                options, large.Large(tables, resume, engine=given.engine_of(engine))
            )
        )
    else:
        end(lambda: run(options))
