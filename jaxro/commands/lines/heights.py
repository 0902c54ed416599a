"""The command lines of `jaxro heights` and `jaxro plan`."""

from pathlib import Path
from typing import Annotated

import typer

from ..ending import end
from . import options as given


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
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for heights.csv, traverses.csv, legs.csv, summary.json, "
            "surface.png.",
            metavar="DIR",
            show_default=False,
        ),
    ] = None,
    report: given.Report = None,
    plots: given.Plots = None,
    json: given.Json = False,
    force: given.Force = False,
) -> None:
    """Heights over a grid of squares from parallaxes.

    With standard deviations, adjusted over the traverses between points, whose
    misclosures are tested. Exit code 0: done; 1: a wrong leg, or a known height that is
    not what is read there; 2: bad input, nothing written.
    """
    from ..documents import Documents
    from ..heights import Options, run

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
                documents=Documents(report, plots, json),
            )
        )
    )


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
    """Accuracy to expect of such heights.

    Of heights, differences, traverses and nodes, and what each source of error adds; or
    what a wanted one needs. Without --base the largest, a quarter of the camera height.
    Exit code 0: done; 2: bad input, or not reachable.
    """
    from ..plan import Options, run

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
