"""The model of a pair in plan: error ellipses of its points, and how well heights are
known all over it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..geometry.pairs import Pair
from ..orientation.result import Orientation
from .arrows import ROOM, round_down, side_of
from .ellipses import (
    LARGEST,
    add_ellipse_key,
    confidence_radius,
    draw_ellipses,
    ellipse_axes,
)
from .labels import NAMED, place_labels
from .model_accuracy import model_covariances
from .style import (
    BLACK,
    DEVIATIONS,
    add_colours,
    describe,
    make_plan,
    plan_or_new,
    times,
    two_plans_or_new,
    with_unit,
)


def draw_plan_errors(
    places: Float[np.ndarray, "point 2"],
    covariances: Float[np.ndarray, "point 2 2"],
    *,
    confidence: float = 0.95,
    freedom: int | None = None,
    names: Sequence[str] = (),
    unit: str = "",
    title: str = "Error ellipses in plan",
    axes: Any = None,
) -> Any:
    """Ellipses that hold each place with this probability, enlarged, with a bar of known
    size. `freedom` of the sigma0 in the covariances, None where it is known."""
    axes = plan_or_new(axes, places)
    radius = confidence_radius(confidence, freedom)
    half = radius * np.linalg.norm(ellipse_axes(covariances), axis=1)
    largest = float(np.max(half, initial=0.0))
    side = side_of(places)
    factor = round_down(LARGEST * side / largest) if largest > 0 else 1.0
    draw_ellipses(axes, places, covariances, radius * factor)
    axes.plot(*places.T, ".", color=BLACK, ms=3)
    describe(
        axes,
        f"{title} ({100 * confidence:g} %) {times(factor)}",
        with_unit("X", unit),
        with_unit("Y", unit),
        room=ROOM,
    )
    make_plan(axes)
    add_ellipse_key(axes, largest, factor, unit)
    if len(names) and len(names) <= NAMED:
        place_labels(axes, places, [str(name) for name in names])
    return axes


def draw_height_errors(
    places: Float[np.ndarray, "point 2"],
    deviations: Float[np.ndarray, " point"],
    *,
    unit: str = "",
    title: str = "Standard deviation of the height",
    axes: Any = None,
) -> Any:
    """A map of the standard deviations of heights: colours and lines of equal deviation
    between the points, and the numbers beside these if they are few."""
    axes = plan_or_new(axes, places)
    if spans_a_plane(*places.T) and np.ptp(deviations) > 0:
        how = {"levels": 8}
        drawn = axes.tricontourf(*places.T, deviations, cmap=DEVIATIONS, **how)
        axes.tricontour(*places.T, deviations, colors=BLACK, linewidths=0.5, **how)
        axes.plot(*places.T, ".", color=BLACK, ms=4)
    else:
        drawn = axes.scatter(*places.T, c=deviations, cmap=DEVIATIONS, ec=BLACK)
    add_colours(axes, drawn, with_unit("standard deviation", unit), below=True)
    describe(axes, title, with_unit("X", unit), with_unit("Y", unit), room=ROOM)
    make_plan(axes)
    if len(places) <= NAMED:
        place_labels(axes, places, [f"{s:.2g}" for s in deviations])
    return axes


def draw_model(
    pair: Pair,
    orientation: Orientation,
    *,
    sigma0: float | None = None,
    confidence: float = 0.95,
    names: Sequence[str] = (),
    unit: str = "",
    axes: Any = None,
) -> Any:
    """The model of an oriented pair twice: error ellipses in plan, and the standard
    deviations of its heights. `sigma0`: where it is known before, else the estimated
    one. `axes`: both."""
    used = np.asarray(pair.mask)
    model = np.stack([np.asarray(c) for c in orientation.model], axis=-1)
    return draw_model_errors(
        model[used],
        model_covariances(pair, orientation, sigma0)[used],
        confidence=confidence,
        freedom=None if sigma0 is not None else int(orientation.degrees_of_freedom),
        names=[names[k] for k in np.flatnonzero(used).tolist()] if len(names) else (),
        unit=unit,
        axes=axes,
    )


def draw_model_errors(
    model: Float[np.ndarray, "point 3"],
    covariances: Float[np.ndarray, "point 3 3"],
    *,
    confidence: float = 0.95,
    freedom: int | None = None,
    names: Sequence[str] = (),
    unit: str = "",
    axes: Any = None,
) -> Any:
    """The same of plain arrays; `freedom` of the sigma0 in the covariances, None where
    it is known."""
    left, right = axes = two_plans_or_new(axes, model[:, :2])
    draw_plan_errors(
        model[:, :2],
        covariances[:, :2, :2],
        confidence=confidence,
        freedom=freedom,
        unit=unit,
        title="Ellipses",
        axes=left,
    )
    deviations = np.sqrt(covariances[:, 2, 2])
    draw_height_errors(model[:, :2], deviations, unit=unit, axes=right)
    if len(names) <= NAMED:
        place_labels(left, model[:, :2], [str(name) for name in names])
    return axes


def spans_a_plane(
    x: Float[np.ndarray, " point"], y: Float[np.ndarray, " point"]
) -> bool:
    """Whether there are three points off one line, without which no surface lies
    between them."""
    if len(x) < 3:
        return False
    spread = np.linalg.svd(np.stack([x - np.mean(x), y - np.mean(y)]), compute_uv=False)
    return bool(spread[1] > 1e-6 * spread[0])
