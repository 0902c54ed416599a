"""The command line of `jaxro colmap`."""

from pathlib import Path
from typing import Annotated

import typer

from ..ending import end
from . import options as given


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
    """Orient the matched pairs of a COLMAP database.

    In spite of wrong matches, photos in any position; writes two_view_geometries, all
    or none. Exit code 0: every pair has a geometry; 1: some pair has none; 2: bad
    input, nothing written.
    """
    from ..colmap import Options, run

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
