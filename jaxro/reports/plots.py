"""Pictures of results; the only place that needs matplotlib (pip install
'jaxro[plots]')."""

import io

import numpy as np
from jaxtyping import Float

COLOURS = "viridis"
SIZE = 60.0
"""Area of the symbol of the mean standard deviation, points²."""


def surface(
    x: Float[np.ndarray, " point"],
    y: Float[np.ndarray, " point"],
    height: Float[np.ndarray, " point"],
    deviation: Float[np.ndarray, " point"],
    names: list[str],
    title: str,
) -> bytes:
    """A PNG of the surface through the points, contoured, and beside it their standard
    deviations (both in mm): circles whose radius and colour tell them, triangles where
    the height is given (0)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patheffects import Normal, Stroke

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
    for axes, values, digits in ((left, height, 0), (right, deviation, 2)):
        for x0, y0, name, value in zip(x, y, names, values, strict=True):
            text = axes.annotate(
                f"{name}  {value:.{digits}f}",
                (x0, y0),
                (4, 4),
                textcoords="offset points",
                fontsize=6,
            )
            text.set_path_effects([Stroke(linewidth=1.5, foreground="white"), Normal()])
        axes.set(aspect="equal", xlabel="x", ylabel="y")
        axes.use_sticky_edges = False
        axes.margins(0.08)
    figure.suptitle(title)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    return file.getvalue()


def _spans_a_plane(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether there are three points off one line, without which no surface lies
    between them."""
    if len(x) < 3:
        return False
    spread = np.linalg.svd(np.stack([x - np.mean(x), y - np.mean(y)]), compute_uv=False)
    return bool(spread[1] > 1e-6 * spread[0])
