"""Error ellipses: where a place lies with a given probability."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..adjustment import critical_values as critical
from .style import BLUE

LARGEST = 0.06
"""The largest half axis over the longer side of the area, at most."""

ANGLES = np.linspace(0.0, 2 * np.pi, 33)
"""At which an ellipse is drawn."""


def ellipse_axes(
    covariances: Float[np.ndarray, "place 2 2"],
) -> Float[np.ndarray, "place 2 2"]:
    """Both half axes of each standard ellipse as columns, the smaller one first: the
    eigenvectors of the covariance, as long as the roots of the eigenvalues."""
    values, vectors = np.linalg.eigh(covariances)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


def confidence_radius(confidence: float, freedom: int | None) -> float:
    """How many times a standard ellipse is enlarged to hold the place with this
    probability; `freedom` of the estimated sigma0, None where sigma0 is known."""
    if freedom is None:
        return float(np.sqrt(critical.chi_squared(1 - confidence, 2)))
    return float(critical.radius(confidence, 2, max(freedom, 1)))


def draw_ellipses(
    axes: Any,
    places: Float[np.ndarray, "place 2"],
    covariances: Float[np.ndarray, "place 2 2"],
    factor: float,
    *,
    colour: str = BLUE,
) -> Any:
    """Outlines `factor` times as large as the standard ellipses, all in one collection
    of lines."""
    from matplotlib.collections import LineCollection

    circle = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    outlines = factor * (ellipse_axes(covariances) @ circle) + places[:, :, None]
    lines = np.moveaxis(outlines, 1, 2)
    drawn = LineCollection(list(lines), colors=colour, linewidths=0.9, zorder=3)
    axes.add_collection(drawn)
    if len(places):
        axes.update_datalim(lines.reshape(-1, 2))
        axes.autoscale_view()
    return drawn


def add_ellipse_key(
    axes: Any, size: float, factor: float, unit: str, *, colour: str = BLUE
) -> Any:
    """A cross of round length in the legend corner: a half axis of this size."""
    from matplotlib.lines import Line2D
    from matplotlib.offsetbox import (
        AnchoredOffsetbox,
        AuxTransformBox,
        HPacker,
        TextArea,
    )

    from .arrows import round_down
    from .style import SMALL, plain

    size = round_down(size) if size > 0 else 1.0
    bar = AuxTransformBox(axes.transData)
    bar.add_artist(Line2D([0, factor * size], [0, 0], color=colour, marker="|"))
    text = TextArea(plain(f"half axis {size:g} {unit}"), textprops={"size": SMALL})
    packed = HPacker(children=[text, bar], align="center", pad=0, sep=5)
    box = AnchoredOffsetbox(
        loc="lower right",
        child=packed,
        frameon=False,
        bbox_to_anchor=(1.0, 1.0),
        bbox_transform=axes.transAxes,
        pad=0.0,
        borderpad=0.4,
    )
    return axes.add_artist(box)
