"""Where to measure: a layout of points before and after its design."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from ..assessment.layout_design import Design, Overlap
from .arrows import side_of
from .style import (
    BLACK,
    BLUE,
    GREY,
    RED,
    add_legend,
    describe,
    make_plan,
    plan_or_new,
    with_unit,
)

STILL = 0.01
"""Part of the overlap's side by which a point has not moved."""


def draw_layout(
    overlap: Overlap,
    design: Design,
    start: tuple[ArrayLike, ArrayLike],
    *,
    kept: int = 0,
    unit: str = "mm",
    of: str = "criterion",
    before: float | None = None,
    axes: Any = None,
) -> Any:
    """The positions of `start` (x, y), where the design began, and those that it found,
    in the overlap. Lines lead from each point to where it went, if the best layout came
    from this start and not from a random one. `kept`: how many points
    at the end of the design stayed where they are. `of`: what the criterion is, with its
    unit, for the title; `before`: its value at the start."""
    corners = np.array(
        [[float(np.asarray(a)) for a in s] for s in (overlap.x, overlap.y)]
    )
    axes = plan_or_new(axes, corners.T)
    was = np.stack([np.asarray(a, float) for a in start], axis=-1)
    now = np.stack([np.asarray(design.x), np.asarray(design.y)], axis=-1)
    new, held = now[: len(now) - kept], now[len(now) - kept :]
    _draw_overlap(axes, overlap)
    from_start = int(np.argmin(np.asarray(design.after))) == 0
    for a, b in zip(was, new, strict=True) if from_start else ():
        if np.hypot(*(b - a)) > STILL * side_of(now):
            how = {"arrowstyle": "->", "color": GREY, "lw": 0.9, "shrinkB": 4}
            axes.annotate("", b, a, arrowprops=how | {"shrinkA": 3})
    axes.plot(*was.T, "o", mfc="white", mec=RED, ms=7, label="before")
    axes.plot(*new.T, "s", color=BLUE, ms=5, label="after")
    if kept:
        axes.plot(*held.T, "^", color=BLACK, ms=6, label="kept")
    change = f"{float(design.value):.4g}"
    if before is not None:
        change = f"{before:.4g} → {change}"
    x, y = (with_unit(name, unit) for name in "xy")
    describe(axes, f"Layout of {len(now)} points\n{of} {change}", x, y)
    make_plan(axes)
    add_legend(axes)
    return axes


def _draw_overlap(axes: Any, overlap: Overlap) -> None:
    """The box in which points can be measured."""
    from matplotlib.patches import Rectangle

    (x0, x1), (y0, y1) = (
        [float(np.asarray(end)) for end in side] for side in (overlap.x, overlap.y)
    )
    box = Rectangle(
        (x0, y0),
        x1 - x0,
        y1 - y0,
        fill=False,
        edgecolor=BLACK,
        linestyle="--",
        linewidth=0.9,
        label="overlap",
    )
    axes.add_patch(box)
