"""Figures of an adjusted block."""

from typing import Any

import numpy as np

from .. import plots
from .block_model import Done
from .control import Compared

MOST = 6
"""Cameras that a figure shows."""


def figures(done: Done) -> dict[str, Any]:
    """The figures by name: the block on the ground, and the residuals of all photos in
    one. None of a block whose numbers may not be used."""
    if not done.usable:
        return {}
    drawn = {"block": draw(done), "block_residuals": draw_residuals(done)}
    found = {name: plots.figure_of(axes) for name, axes in drawn.items()}
    if done.adjusted.fields:
        found["fields"] = draw_fields(done)
    return found


def draw(done: Done) -> Any:
    """Photos, points, differences at control and check points; error ellipses of the
    points and the standard deviations of their heights."""
    known = [
        _known("control", done.control),
        _known("check points", done.checks),
    ]
    wrong = done.oriented.wrong.rays
    axes = plots.draw_block(done.adjusted, known, wrong=wrong, unit=done.unit)
    told = f"Block of {done.title}, sigma0 {done.adjusted.sigma0:.2f}"
    plots.figure_of(axes).suptitle(plots.plain(told), fontsize=plots.TITLE)
    return axes


def draw_residuals(done: Done) -> Any:
    """The residuals of all photos in one."""
    return plots.draw_block_residuals(done.adjusted, unit=done.photo_unit)


def draw_fields(done: Done) -> Any:
    """The displacement field of each camera, of many the first."""
    shown = done.adjusted.fields[:MOST]
    figure = plots.new_figure(4.4 * len(shown), 5.2)
    every = figure.subplots(len(shown), 1, squeeze=False).ravel()
    for axes, one in zip(every, shown, strict=True):
        spread = np.hypot(*one.deviations.T)
        plots.draw_vectors(
            one.places,
            one.displacements,
            in_deviations=np.hypot(*one.displacements.T) / spread,
            unit=done.photo_unit,
            title=f"Displacement field of camera {one.camera}",
            axes=axes,
        )
    return figure


def _known(kind: str, one: Compared) -> plots.KnownPoints:
    there = np.where(one.known, one.given, np.nan)
    return plots.KnownPoints(kind, one.names, there, one.differences)
