"""Heights over a grid: the surface through the points, and how well they are known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .labels import place_labels, show_name
from .model import spans_a_plane
from .style import (
    BLACK,
    DEVIATIONS,
    SIZES,
    add_colours,
    add_legend,
    describe,
    make_plan,
    plan_or_new,
    two_plans_or_new,
    with_unit,
)

SIZE = 45.0
"""Area of the symbol of the mean standard deviation, points²."""

LINES = {"colors": BLACK, "linestyles": "solid", "linewidths": 0.4, "alpha": 0.5}


def draw_surface(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    height: Float[np.ndarray, " point"],
    *,
    legs: Int[np.ndarray, "2 leg"] | None = None,
    names: Sequence[str] = (),
    unit: str = "mm",
    title: str = "Heights",
    axes: Any = None,
) -> Any:
    """The surface through the points as colours with contours, and the `legs` of
    traverses, from point to point, as dashed lines."""
    axes = plan_or_new(axes, np.stack([x, y], axis=-1))
    if spans_a_plane(x, y) and np.ptp(height) > 0:
        drawn = axes.tricontourf(x, y, height, levels=12, cmap=SIZES)
        axes.tricontour(x, y, height, levels=12, **LINES)
        axes.plot(x, y, ".k", ms=4, label="points")
    else:
        drawn = axes.scatter(x, y, c=height, cmap=SIZES)
    add_colours(axes, drawn, with_unit("height", unit), below=True)
    return _finish(axes, x, y, legs, unit, title, _told(names, height, 0))


def draw_deviations(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    height: Float[np.ndarray, " point"],
    deviation: Float[np.ndarray, " point"],
    *,
    legs: Int[np.ndarray, "2 leg"] | None = None,
    names: Sequence[str] = (),
    unit: str = "mm",
    title: str = "Standard deviations of the heights",
    axes: Any = None,
) -> Any:
    """The standard deviations of the heights as circles, whose radius and colour tell
    them, above the contours; triangles where the height is given (deviation 0)."""
    axes = plan_or_new(axes, np.stack([x, y], axis=-1))
    if spans_a_plane(x, y) and np.ptp(height) > 0:
        axes.tricontour(x, y, height, levels=12, **LINES)
    free = deviation > 0
    mean = np.mean(deviation[free]) if np.any(free) else 1.0
    drawn = axes.scatter(
        x[free],
        y[free],
        s=SIZE * np.square(deviation[free] / mean),
        c=deviation[free],
        cmap=DEVIATIONS,
        edgecolors=BLACK,
        lw=0.5,
        label="computed",
        zorder=3,
    )
    axes.plot(x[~free], y[~free], "^k", label="given", zorder=3)
    add_colours(axes, drawn, with_unit("standard deviation", unit), below=True)
    return _finish(axes, x, y, legs, unit, title, _told(names, deviation, 2))


def draw_heights(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    height: Float[np.ndarray, " point"],
    deviation: Float[np.ndarray, " point"],
    *,
    legs: Int[np.ndarray, "2 leg"] | None = None,
    names: Sequence[str] = (),
    unit: str = "mm",
    axes: Any = None,
) -> Any:
    """Both pictures with names and numbers of the points where there is
    room. `axes`: both."""
    left, right = axes = two_plans_or_new(axes, np.stack([x, y], axis=-1))
    common = {"legs": legs, "unit": unit}
    draw_surface(x, y, height, axes=left, **common)
    draw_deviations(
        x, y, height, deviation, title="Standard deviations", axes=right, **common
    )
    places = np.stack([x, y], axis=-1)
    for one, values, digits in ((left, height, 0), (right, deviation, 2)):
        place_labels(one, places, _told(names, values, digits), size=5.5)
    return axes


def _finish(axes, x, y, legs, unit, title, told) -> Any:
    if legs is not None and legs.size:
        axes.plot(x[legs], y[legs], "--", color=BLACK, lw=0.8, alpha=0.6)
        axes.plot([], [], "--k", lw=0.8, label="legs of traverses")
    describe(axes, title, with_unit("x", unit), with_unit("y", unit))
    make_plan(axes)
    add_legend(axes)
    return place_labels(axes, np.stack([x, y], axis=-1), told) if told else axes


def _told(names: Sequence[str], values: np.ndarray, digits: int) -> list[str]:
    return [
        f"{show_name(n)}  {v:.{digits}f}" for n, v in zip(names, values, strict=False)
    ]
