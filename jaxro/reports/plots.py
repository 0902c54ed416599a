"""Pictures of results; the only place that needs matplotlib (pip install
'jaxro[plots]')."""

import io
from typing import Any

import numpy as np
from jaxtyping import Float, Int

COLOURS = "viridis"
SIZE = 60.0
"""Area of the symbol of the mean standard deviation, points²."""

BESIDE = [(5, 4), (5, -9), (-5, 4), (-5, -9), (0, 8), (0, -13), (12, -3), (-12, -3)]
"""Where the label of a point may stand, points of the printer off it; the first ones
are the best."""


def surface(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    height: Float[np.ndarray, " point"],
    deviation: Float[np.ndarray, " point"],
    names: list[str],
    legs: Int[np.ndarray, "2 leg"],
    title: str,
) -> bytes:
    """A PNG of the surface through the points, contoured, with the legs of traverses
    between points (first, last), and beside it the standard deviations of the points
    (both in mm): circles whose radius and colour tell them, triangles where the height
    is given (0)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    if _spans_a_plane(x, y) and np.ptp(height) > 0:
        drawn = left.tricontourf(x, y, height, levels=12, cmap=COLOURS)
        for axes in (left, right):
            axes.tricontour(
                x,
                y,
                height,
                levels=12,
                colors="black",
                linestyles="solid",
                linewidths=0.4,
                alpha=0.4,
            )
        left.plot(x, y, ".k", markersize=4)
    else:
        drawn = left.scatter(x, y, c=height, cmap=COLOURS)
    figure.colorbar(drawn, ax=left, label="height, mm", location="bottom", shrink=0.8)
    free = deviation > 0
    size = SIZE * np.square(
        deviation[free] / (np.mean(deviation[free]) if np.any(free) else 1.0)
    )
    drawn = right.scatter(
        x[free],
        y[free],
        s=size,
        c=deviation[free],
        cmap="plasma_r",
        edgecolors="black",
        lw=0.5,
    )
    right.plot(x[~free], y[~free], "^k")
    figure.colorbar(
        drawn,
        ax=right,
        label="standard deviation, mm (triangle: given)",
        location="bottom",
        shrink=0.8,
    )
    for axes in (left, right):
        axes.plot(x[legs], y[legs], "--", color="black", linewidth=0.8, alpha=0.6)
        axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
        axes.use_sticky_edges = False
        axes.margins(0.1)
    if legs.size:
        left.plot([], [], "--k", linewidth=0.8, label="legs of traverses")
        left.legend(loc="lower left", fontsize=7)
    figure.suptitle(title)
    figure.draw_without_rendering()  # the axes have their places
    for axes, values, digits in ((left, height, 0), (right, deviation, 2)):
        told = [f"{n}  {v:.{digits}f}" for n, v in zip(names, values, strict=True)]
        _label(axes, np.stack([x, y], axis=-1), told)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    return file.getvalue()


def _label(axes: Any, places: Float[np.ndarray, "point 2"], texts: list[str]) -> None:
    """Write a text beside every place, where it covers no other text and no place; a
    text that finds no room is left out."""
    from matplotlib.patheffects import Normal, Stroke
    from matplotlib.transforms import Bbox

    points = axes.transData.transform(places)
    frame, taken = axes.get_window_extent(), []

    def is_free(box: Any) -> bool:
        inside = frame.contains(*box.min) and frame.contains(*box.max)
        covers = Bbox.count_overlaps(box, taken) or _holds(box, points)
        return bool(inside and not covers)

    for place, told in zip(places, texts, strict=True):
        text = axes.annotate(
            told, place, BESIDE[0], textcoords="offset points", fontsize=6
        )
        text.set_in_layout(False)
        text.set_path_effects([Stroke(linewidth=1.5, foreground="white"), Normal()])
        for right, up in BESIDE:
            text.xyann = right, up
            text.set_ha("left" if right > 0 else "right" if right < 0 else "center")
            box = text.get_window_extent()
            if is_free(box):
                taken.append(box)
                break
        else:
            text.remove()


def _holds(box: Any, points: Float[np.ndarray, "point 2"]) -> bool:
    """Whether a point lies within a box."""
    return any(box.contains(*point) for point in points)


def _spans_a_plane(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether there are three points off one line, without which no surface lies
    between them."""
    if len(x) < 3:
        return False
    spread = np.linalg.svd(np.stack([x - np.mean(x), y - np.mean(y)]), compute_uv=False)
    return bool(spread[1] > 1e-6 * spread[0])
