"""The command line of `jaxro absolute`."""

from pathlib import Path
from typing import Annotated

import typer

from ..ending import end
from . import options as given

Model = Annotated[
    Path | None,
    typer.Argument(
        help="CSV table of the points of one model: point,X,Y,Z, optionally sX,sY,sZ or "
        "sigma; points.csv of jaxro orient or clean is one. Without it a simulated "
        "model.",
        metavar="MODEL.csv",
        show_default=False,
    ),
]
Control = Annotated[
    Path | None,
    typer.Option(
        help="CSV table of points on the ground: point,X,Y,Z, blank where a coordinate "
        "is not known, optionally sX,sY,sZ or sigma, and role: control, check, "
        "approximate.",
        metavar="GROUND.csv",
        show_default=False,
    ),
]
PairName = Annotated[
    str | None,
    typer.Option(
        "--pair",
        help="Which model of a table with several pairs.",
        metavar="NAME",
        show_default=False,
    ),
]
Sigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of every ground coordinate, in the unit of the ground."
        "  [default: unit weights, or without error where the model has deviations]",
        metavar="SD",
        show_default=False,
    ),
]
ModelSigma = Annotated[
    float | None,
    typer.Option(
        help="Standard deviation of every model coordinate, in the unit of the model."
        "  [default: without error]",
        metavar="SD",
        show_default=False,
    ),
]
Second = Annotated[
    bool,
    typer.Option("--second", help="Of two solutions that both fit take the other."),
]
Unit = Annotated[
    str, typer.Option(help="Name of the unit of the ground: m, ft.", metavar="NAME")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for points.csv (on the ground, with deviations), control.csv, "
        "absolute.csv.",
        metavar="DIR",
        show_default=False,
    ),
]


def absolute(
    file: Model = None,
    control: Control = None,
    pair: PairName = None,
    sigma: Sigma = None,
    model_sigma: ModelSigma = None,
    second: Second = False,
    unit: Unit = "m",
    out: Out = None,
    force: given.Force = False,
) -> None:
    """Place one model on the ground by control points.

    Scale, rotation and shift from control in plan, in height or in both, with standard
    deviations of all points; check points apart. Exit code 0: usable; 1: the control is
    not enough, or not suitable; 2: bad input, nothing written.
    """
    from ..absolute import Options, run

    options = Options(
        file=file,
        control=control,
        pair=pair,
        sigma=sigma,
        model_sigma=model_sigma,
        second=second,
        unit=unit,
        out=out,
        force=force,
    )
    end(lambda: run(options))
