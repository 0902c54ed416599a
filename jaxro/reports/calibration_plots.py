"""Pictures of a calibration as PNG; they need matplotlib (pip install
'jaxro[plots]')."""

import io
from typing import Any

import numpy as np

from .calibration_model import NODES, Done, Map, Photo, Variant, describe
from .calibration_tests import Compared

COLOURS = "viridis"
MOST = 6
"""Cameras, and twice as many images, that a picture shows."""

ARROW = 0.06
"""Length of the longest arrow over the longer side of the area."""

TRIED = 15
"""Variants that a picture shows."""


def pictures(done: Done) -> dict[str, bytes]:
    """The pictures by their names: corrections with their standard deviations,
    residuals, variants, differences of two images."""
    found = {}
    if any(one.found is not None for one in done.differences):
        found["difference.png"] = draw_differences(done)
    if done.maps:
        found["corrections.png"] = draw_corrections(done)
        found["residuals.png"] = draw_residuals(done)
    if len(done.variants) == 1:
        (rows,) = done.variants.values()
        if len(rows) > 1:
            found["variants.png"] = draw_variants(done, rows)
    return found


def draw_corrections(done: Done) -> bytes:
    """A row for each camera: the corrections as arrows, and their standard deviations
    as colours; both only among the places that were measured."""
    maps = done.maps[:MOST]
    figure = make_figure(11.0, 4.8 * len(maps))
    down = {one.camera: bool(one.figures.y_down) for one in done.cameras}
    for row, one in zip(
        figure.subplots(len(maps), 2, squeeze=False), maps, strict=True
    ):
        left, right = row
        inside = one.inside
        places, shifts = one.places[inside], one.corrections[inside]
        _arrows(left, places, shifts, done.unit, f"{one.camera}: corrections")
        drawn = right.imshow(
            np.where(inside, _size(one), np.nan).reshape(NODES, NODES),
            extent=_extent(one),
            origin="lower",
            cmap=COLOURS,
        )
        right.set_title(f"{one.camera}: standard deviation of the distortion")
        figure.colorbar(drawn, ax=right, label=done.unit, shrink=0.8)
        for axes in row:
            _set_axes(axes, done.unit, down[one.camera])
    return png(figure)


def draw_residuals(done: Done) -> bytes:
    """The residuals of each image as arrows."""
    photos = [one for one in done.photos if one.usable][: 2 * MOST]
    columns = min(3, len(photos))
    lines = -(-len(photos) // columns)
    figure = make_figure(5.2 * columns, 4.6 * lines)
    every = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in every[len(photos) :]:
        axes.set_axis_off()
    for axes, one in zip(every, photos, strict=False):
        _arrows(axes, one.places, one.residuals, done.unit, f"{one.name}: residuals")
        _mark_worst(axes, done, one)
        _set_axes(axes, done.unit, bool(one.figures.y_down))
    return png(figure)


def draw_differences(done: Done) -> bytes:
    """The difference of both distortions of each pair as arrows among the places that
    both have measured; their colour is the difference in standard deviations."""
    pairs = [one for one in done.differences if one.found is not None][:MOST]
    figure = make_figure(7.0, 5.2 * len(pairs))
    down = {one.name: bool(one.figures.y_down) for one in done.photos}
    every = figure.subplots(len(pairs), 1, squeeze=False).ravel()
    for axes, one in zip(every, pairs, strict=True):
        _draw_difference(axes, done, one)
        _set_axes(axes, done.unit, down[one.first])
    return png(figure)


def _draw_difference(axes: Any, done: Done, one: Compared) -> None:
    found = one.found
    assert found is not None
    shown = one.counts
    title = f"{one.second} minus {one.first}"
    drawn = _arrows(
        axes,
        found.places[shown],
        found.difference[shown],
        done.unit,
        title,
        one.in_deviations[shown],
    )
    label = "length in standard deviations"
    axes.figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)


def draw_variants(done: Done, rows: list[Variant]) -> bytes:
    """The score of each model behind the best one, and the error of coordinates left
    out."""
    shown = [row for row in rows if np.isfinite(row.behind)][:TRIED]
    figure = make_figure(10.0, 1.2 + 0.32 * len(shown))
    left, right = figure.subplots(1, 2, sharey=True)
    names, at = [describe(row.model) for row in shown], np.arange(len(shown))
    left.barh(at, [row.behind for row in shown])
    left.set_yticks(at, names)
    left.invert_yaxis()
    left.set_xlabel("-2 log evidence behind the best")
    right.barh(at, [row.left_out for row in shown], color="tab:orange")
    right.set_xlabel(f"error of coordinates left out, {done.unit}")
    right.locator_params(axis="x", nbins=4)
    return png(figure)


def make_figure(width: float, height: float) -> Any:
    """An empty figure that nothing shows on a screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Any) -> bytes:
    """A figure as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()


def _arrows(
    axes: Any,
    places: np.ndarray,
    shifts: np.ndarray,
    unit: str,
    title: str,
    colours: np.ndarray | None = None,
) -> Any:
    """Arrows at places, enlarged so that the longest one is seen; the title says how
    long it is."""
    longest = float(np.max(np.hypot(*shifts.T), initial=0.0))
    side = float(np.max(np.ptp(places, axis=0), initial=0.0)) or 1.0
    scale = longest / (ARROW * side) if longest > 0 else 1.0
    how = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.004}
    if colours is None:
        drawn = axes.quiver(*places.T, *shifts.T, **how)
        axes.plot(*places.T, ".", color="tab:blue", markersize=3)
    else:
        drawn = axes.quiver(*places.T, *shifts.T, colours, cmap=COLOURS, **how)
    axes.set_title(f"{title}, the longest {longest:.3g} {unit}")
    return drawn


def _mark_worst(axes: Any, done: Done, one: Photo) -> None:
    """The names of points beyond the limit."""
    sizes = np.max(np.abs(done.w(one)), axis=1)
    for k in np.flatnonzero(sizes > done.limit(one)):
        axes.annotate(one.names[k], one.places[k], color="tab:red", fontsize=8)


def _set_axes(axes: Any, unit: str, y_down: bool) -> None:
    axes.set(aspect="equal", xlabel=f"x, {unit}", ylabel=f"y, {unit}")
    axes.margins(0.1)
    if y_down:
        axes.invert_yaxis()


def _size(one: Map) -> np.ndarray:
    """The standard deviation of a coordinate, as the mean of both."""
    return np.sqrt(np.mean(one.deviations**2, axis=1))


def _extent(one: Map) -> tuple[float, float, float, float]:
    """The outer borders of the nodes' cells: left, right, bottom, top."""
    least, most = np.min(one.places, axis=0), np.max(one.places, axis=0)
    half = (most - least) / (NODES - 1) / 2
    (left, bottom), (right, top) = least - half, most + half
    return float(left), float(right), float(bottom), float(top)
