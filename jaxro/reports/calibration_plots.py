"""Figures of a calibration."""

from typing import Any

import numpy as np

from .. import plots
from ..plots.style import WIDTH
from .calibration_model import Done, Photo, Variant, describe
from .calibration_tests import Compared

MOST = 6
"""Cameras, and twice as many images, that a figure shows."""

TRIED = 15
"""Models that a figure shows."""


def figures(done: Done) -> dict[str, Any]:
    """The figures by name: differences of two images, corrections with their standard
    deviations, residuals, models."""
    found = {}
    if any(one.found is not None for one in done.differences):
        found["difference"] = draw_differences(done)
    if done.cameras:
        found["corrections"] = draw_corrections(done)
        found["residuals"] = draw_residuals(done)
    if len(done.variants) == 1:
        (rows,) = done.variants.values()
        if len(rows) > 1:
            found["variants"] = draw_variants(done, rows)
    return found


def draw_corrections(done: Done) -> Any:
    """A row for each camera: its corrections, and how well they are known, both among
    the places that were measured."""
    cameras = done.cameras[:MOST]
    figure = plots.new_figure(3.9 * len(cameras))
    rows = figure.subplots(len(cameras), 2, squeeze=False)
    for axes, one in zip(rows, cameras, strict=True):
        of = done.maps.get(one.camera) or plots.map_corrections(one.found)
        plots.draw_corrections(
            of, one.found, unit=done.unit, title=one.camera, axes=axes
        )
    return figure


def draw_residuals(done: Done) -> Any:
    """The residuals of each image; points beyond the limit have their names."""
    photos = [one for one in done.photos if one.usable][: 2 * MOST]
    columns = min(2, len(photos))
    lines = -(-len(photos) // columns)
    side = WIDTH / columns if columns > 1 else 4.6
    figure = plots.new_figure(1.05 * side * lines, side * columns)
    every = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in every[len(photos) :]:
        axes.set_axis_off()
    for axes, one in zip(every, photos, strict=False):
        plots.draw_residuals(
            one.places,
            one.residuals,
            unit=done.unit,
            title=f"{one.name}: residuals",
            y_down=bool(one.figures.y_down),
            axes=axes,
        )
    for axes, one in zip(every, photos, strict=False):  # when all have their places
        names = [
            name if far else ""
            for name, far in zip(one.names, _far(done, one), strict=True)
        ]
        plots.place_labels(axes, one.places, names, colour=plots.RED)
    return figure


def _far(done: Done, one: Photo) -> np.ndarray:
    """The points beyond the limit."""
    return np.max(np.abs(done.w(one)), axis=1) > done.limit(one)


def draw_differences(done: Done) -> Any:
    """The difference of both distortions of each pair of images among the places that
    both have measured; its colour is the difference in standard deviations."""
    pairs = [one for one in done.differences if one.found is not None][:MOST]
    figure = plots.new_figure(4.4 * len(pairs), 5.2)
    down = {one.name: bool(one.figures.y_down) for one in done.photos}
    every = figure.subplots(len(pairs), 1, squeeze=False).ravel()
    for axes, one in zip(every, pairs, strict=True):
        _draw_difference(axes, done, one, down[one.first])
    return figure


def _draw_difference(axes: Any, done: Done, one: Compared, y_down: bool) -> None:
    found = one.found
    assert found is not None
    shown = one.counts
    plots.draw_vectors(
        found.places[shown],
        found.difference[shown],
        in_deviations=one.in_deviations[shown],
        unit=done.unit,
        title=f"{one.second} minus {one.first}",
        y_down=y_down,
        axes=axes,
    )


def draw_variants(done: Done, rows: list[Variant]) -> Any:
    """The evidence for each model, and the error of coordinates left out."""
    shown = [row for row in rows if np.isfinite(row.behind)][:TRIED]
    axes = plots.draw_variants(
        [describe(row.model) for row in shown],
        [row.behind for row in shown],
        [row.left_out for row in shown],
        unit=done.unit,
    )
    return plots.figure_of(axes)
