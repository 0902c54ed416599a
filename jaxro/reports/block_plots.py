"""The picture of an adjusted block as PNG; it needs matplotlib (pip install
'jaxro[plots]')."""

from typing import Any

import numpy as np

from ..adjustment import critical_values as critical
from .block_model import Done
from .calibration_plots import make_figure, png
from .control import Compared

LENGTH = 0.06
"""Length of the longest arrow, and of the largest ellipse, over the longer side of the
block."""

NAMED = 40
"""Photos and known points up to which their names are written."""

ROUND = np.linspace(0.0, 2 * np.pi, 41)
"""Angles at which an ellipse is drawn."""


def picture(done: Done) -> bytes:
    """Two maps. Left: photos, points, and known points with the differences adjusted
    minus given as arrows, heights upwards. Right: 95 % ellipses of the points, and the
    standard deviations of their heights as colours."""
    figure = make_figure(15.0, 6.6)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    draw_differences(left, done)
    draw_accuracy(right, done)
    for axes in (left, right):
        axes.set(aspect="equal", xlabel=f"X, {done.unit}", ylabel=f"Y, {done.unit}")
        axes.margins(0.08)
    figure.suptitle(f"Block of {done.title}, sigma0 {done.adjusted.sigma0:.2f}")
    return png(figure)


def draw_differences(axes: Any, done: Done) -> Any:
    """Photos, points, what was left out, and the differences at known points."""
    adjusted = done.adjusted
    points = adjusted.coordinates[done.determined]
    axes.plot(*points[:, :2].T, ".", color="0.7", markersize=3, label="points")
    centres = adjusted.centres
    axes.plot(*centres[:, :2].T, "x", color="tab:gray", label="photos")
    if len(centres) <= NAMED:
        for name, at in zip(adjusted.block.photos, centres, strict=True):
            axes.annotate(name, at[:2], fontsize=6, color="tab:gray")
    wrong = np.unique(adjusted.block.point[done.oriented.wrong.rays])
    shown = adjusted.coordinates[wrong]
    if len(wrong):
        axes.plot(
            *shown[:, :2].T, "o", mfc="none", color="tab:red", label="wrong place"
        )
    both = (("^", "tab:blue", done.control), ("s", "tab:green", done.checks))
    longest = max(
        float(np.max(np.abs(one.differences), initial=0.0)) for *_, one in both
    )
    scale = LENGTH * _side(points) / longest if longest > 0 else 1.0
    for marker, colour, one in both:
        _draw_known(axes, one, marker, colour, scale)
    if longest > 0:
        axes.set_title(
            f"adjusted minus given, the longest arrow {longest:.3g} {done.unit}\n"
            "(full: plan, dashed: height)"
        )
    axes.legend(fontsize=7, loc="best")
    return axes


def _draw_known(
    axes: Any, one: Compared, marker: str, colour: str, scale: float
) -> None:
    """Known points with their differences; those known in height only have no place."""
    in_plan = np.all(one.known[:, :2], axis=1)
    at, apart = one.given[in_plan], one.differences[in_plan]
    if not len(at):
        return
    label = "control" if marker == "^" else "check points"
    axes.plot(*at[:, :2].T, marker, color=colour, markersize=5, label=label)
    for place, off in zip(at[:, :2], apart, strict=True):
        plan = place + scale * off[:2]
        axes.plot([place[0], plan[0]], [place[1], plan[1]], color=colour)
        up = place[1] + scale * off[2]
        axes.plot([place[0]] * 2, [place[1], up], color=colour, linestyle="--", lw=0.8)
    if len(at) <= NAMED:
        names = [one.names[k] for k in np.flatnonzero(in_plan)]
        for name, place in zip(names, at, strict=True):
            axes.annotate(
                name, place[:2], xytext=(3, 3), textcoords="offset points", fontsize=6
            )


def draw_accuracy(axes: Any, done: Done) -> Any:
    """Ellipses of the points in plan, heights as colours."""
    adjusted, there = done.adjusted, done.determined
    points, deviations = adjusted.coordinates[there], adjusted.deviations[there]
    ellipses = ellipses_of(
        adjusted.point_covariances[there][:, :2, :2], adjusted.degrees_of_freedom
    )
    largest = float(np.max(np.abs(ellipses), initial=0.0))
    scale = LENGTH / 2 * _side(points) / largest if largest > 0 else 1.0
    drawn = axes.scatter(*points[:, :2].T, c=deviations[:, 2], s=14, cmap="plasma_r")
    for place, ellipse in zip(points[:, :2], ellipses, strict=True):
        axes.plot(*(place[:, None] + scale * ellipse), color="black", lw=0.5)
    label = f"standard deviation of the height, {done.unit}"
    axes.figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)
    axes.set_title(f"95 % ellipses, the largest half axis {largest:.3g} {done.unit}")
    return axes


def ellipses_of(covariances: np.ndarray, freedom: int) -> np.ndarray:
    """(point, 2, angle): the outline of the region that holds both coordinates with 95
    %."""
    values, vectors = np.linalg.eigh(covariances)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    radius = float(critical.radius(0.95, 2, max(freedom, 1)))
    return radius * axes @ np.stack([np.cos(ROUND), np.sin(ROUND)])


def _side(points: np.ndarray) -> float:
    """The longer side of the block."""
    return float(np.max(np.ptp(points[:, :2], axis=0), initial=0.0)) or 1.0
