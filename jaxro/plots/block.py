"""A block on the ground: photos, points, differences at known points, error ellipses, and
the residuals of all photos in one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..block.adjust import BlockAdjustment
from .arrows import (
    ROOM,
    add_key,
    draw_arrows,
    enlargement,
    round_down,
    side_of,
)
from .ellipses import (
    LARGEST,
    add_ellipse_key,
    confidence_radius,
    draw_ellipses,
    ellipse_axes,
)
from .labels import NAMED, place_labels
from .residuals import draw_residuals
from .style import (
    BLACK,
    BLUE,
    DEVIATIONS,
    GREEN,
    GREY,
    RED,
    SKY,
    add_colours,
    add_legend,
    describe,
    make_plan,
    plan_or_new,
    times,
    two_plans_or_new,
    with_unit,
)

SYMBOLS = (("^", BLUE), ("s", GREEN), ("D", BLACK))
"""Symbols and colours of kinds of known points."""


class KnownPoints(NamedTuple):
    """Known points of one `kind` (control, check points): names, given coordinates (NaN
    where one is not known), and the differences adjusted minus given."""

    kind: str
    names: Sequence[str]
    given: Float[np.ndarray, "point 3"]
    differences: Float[np.ndarray, "point 3"]


def draw_differences(
    adjusted: BlockAdjustment,
    known: Sequence[KnownPoints] = (),
    *,
    wrong: Bool[np.ndarray, " ray"] | None = None,
    unit: str = "m",
    title: str = "Adjusted minus given",
    axes: Any = None,
) -> Any:
    """A plan of the photos and points, with the differences at known points, enlarged:
    arrows in plan, dashed lines upwards or downwards for heights. Points with a `wrong`
    ray, which was left out, have a ring."""
    at = adjusted.coordinates
    points = _determined(adjusted)
    axes = plan_or_new(axes, points[:, :2])
    centres = adjusted.centres
    axes.plot(*points[:, :2].T, ".", color=SKY, ms=3, label="points")
    axes.plot(*centres[:, :2].T, "+", color=GREY, ms=7, label="photos")
    if wrong is not None and np.any(wrong):
        where = at[np.unique(adjusted.block.point[wrong])]
        style = {"mfc": "none", "mec": RED, "mew": 1.4, "ms": 9}
        axes.plot(*where[:, :2].T, "o", label="wrong place left out", **style)
    sizes = [np.nan_to_num(one.differences) for one in known]
    longest = max((float(np.max(np.abs(d), initial=0.0)) for d in sizes), default=0.0)
    factor = enlargement(side_of(points), longest)
    for one, (symbol, colour) in zip(known, SYMBOLS, strict=False):
        _draw_known(axes, one, symbol, colour, factor)
    told = f"{title} {times(factor)}" if longest > 0 else "Block"
    describe(axes, told, with_unit("X", unit), with_unit("Y", unit), room=ROOM)
    make_plan(axes)
    if longest > 0:
        axes.plot([], [], "--", color=BLACK, lw=1.0, label="difference in height")
        drawn = draw_arrows(axes, points[:1, :2], np.zeros((1, 2)), factor)
        add_key(axes, drawn, longest, unit)
    add_legend(axes, columns=3)
    _name_all(axes, adjusted, known)
    return axes


def draw_accuracy(
    adjusted: BlockAdjustment,
    *,
    confidence: float = 0.95,
    unit: str = "m",
    title: str = "Ellipses",
    axes: Any = None,
) -> Any:
    """Error ellipses of the points in plan, enlarged, and the standard deviations of
    their heights as colours."""
    at = adjusted.coordinates
    there = np.all(np.isfinite(at), axis=1)
    axes = plan_or_new(axes, at[there, :2])
    points, deviations = at[there, :2], adjusted.deviations[there]
    covariances = adjusted.point_covariances[there][:, :2, :2]
    radius = confidence_radius(confidence, adjusted.degrees_of_freedom)
    half = radius * np.linalg.norm(ellipse_axes(covariances), axis=1)
    largest = float(np.max(half, initial=0.0))
    factor = round_down(LARGEST * side_of(points) / largest) if largest > 0 else 1.0
    drawn = axes.scatter(*points.T, c=deviations[:, 2], s=12, cmap=DEVIATIONS, zorder=2)
    draw_ellipses(axes, points, covariances, radius * factor, colour=BLACK)
    add_colours(
        axes, drawn, with_unit("standard deviation of the height", unit), below=True
    )
    told = f"{title} ({100 * confidence:g} %) {times(factor)}"
    describe(axes, told, with_unit("X", unit), with_unit("Y", unit), room=ROOM)
    make_plan(axes)
    add_ellipse_key(axes, largest, factor, unit, colour=BLACK)
    return axes


def draw_block(
    adjusted: BlockAdjustment,
    known: Sequence[KnownPoints] = (),
    *,
    wrong: Bool[np.ndarray, " ray"] | None = None,
    unit: str = "m",
    axes: Any = None,
) -> Any:
    """Both plans, differences and accuracy: side by side, or one below the other of a
    block that is wider than high. `axes`: both."""
    axes = two_plans_or_new(axes, _determined(adjusted)[:, :2])
    first, second = axes
    draw_differences(adjusted, known, wrong=wrong, unit=unit, axes=first)
    draw_accuracy(adjusted, unit=unit, axes=second)
    return axes


def draw_block_residuals(
    adjusted: BlockAdjustment,
    *,
    unit: str = "mm",
    title: str = "Residuals of all photos",
    axes: Any = None,
) -> Any:
    """The residuals of the rays of all photos at their places on the photo: a pattern
    in them is an error that all photos share, such as a distortion."""
    block = adjusted.block
    places = np.stack([block.x, block.y], axis=-1)
    used = np.all(np.isfinite(adjusted.residuals), axis=1)
    return draw_residuals(
        places[used], adjusted.residuals[used], unit=unit, title=title, axes=axes
    )


def _determined(adjusted: BlockAdjustment) -> Float[np.ndarray, "point 3"]:
    """The points that have coordinates."""
    at = adjusted.coordinates
    return at[np.all(np.isfinite(at), axis=1)]


def _draw_known(
    axes: Any, one: KnownPoints, symbol: str, colour: str, factor: float
) -> None:
    """Known points with their differences; those known in height only have no place."""
    in_plan = np.all(np.isfinite(one.given[:, :2]), axis=1)
    at, apart = one.given[in_plan, :2], np.nan_to_num(one.differences[in_plan])
    if not len(at):
        return
    axes.plot(*at.T, symbol, color=colour, ms=5, label=one.kind, zorder=4)
    draw_arrows(axes, at, apart[:, :2], factor, colours=colour)
    for (x, y), up in zip(at, apart[:, 2], strict=True):
        axes.plot([x, x], [y, y + factor * up], "--", color=colour, lw=1.0)


def _name_all(
    axes: Any, adjusted: BlockAdjustment, known: Sequence[KnownPoints]
) -> None:
    """Names of known points, then of photos, each if they are few."""
    for one in known:
        in_plan = np.all(np.isfinite(one.given[:, :2]), axis=1)
        if np.sum(in_plan) <= NAMED:
            some = [str(one.names[k]) for k in np.flatnonzero(in_plan).tolist()]
            place_labels(axes, one.given[in_plan, :2], some)
    if len(adjusted.centres) <= NAMED:
        centres = adjusted.centres[:, :2]
        place_labels(axes, centres, list(adjusted.block.photos), colour=GREY)
