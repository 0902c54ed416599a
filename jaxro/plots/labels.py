"""Names beside points, where they cover neither each other nor points."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..tables.fields import tell
from .style import LONGEST, SMALL, plain

BESIDE = [(5, 4), (5, -9), (-5, 4), (-5, -9), (0, 8), (0, -13), (12, -3), (-12, -3)]
"""Where the label of a point may stand, points of the printer off it; the first ones
are the best."""

PAPER = {"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.6}
"""What lies below a label, so that it is read on colours, too."""

NAME = 24
"""Letters of a name that are shown."""

NAMED = 40
"""Points up to which a picture writes all names."""


def show_name(name: str) -> str:
    """A name as a picture shows it: in one line, and not longer than NAME."""
    return plain(tell(name, NAME))


def place_labels(
    axes: Any,
    places: Float[np.ndarray, "point 2"],
    texts: Sequence[str],
    *,
    colour: str = "black",
    size: float = SMALL - 1,
) -> Any:
    """Write a text beside every place, where it covers no other text and no place; a
    text that finds no room is left out. It comes last, after all that moves the axes."""
    from matplotlib.transforms import Bbox

    if not len(texts):
        return axes
    axes.figure.draw_without_rendering()  # the axes have their places
    points = axes.transData.transform(places)
    frame = axes.get_window_extent()
    taken = [text.get_window_extent() for text in axes.texts if text.get_text()]

    def is_free(box: Any) -> bool:
        inside = frame.contains(*box.min) and frame.contains(*box.max)
        covers = Bbox.count_overlaps(box, taken) or _holds(box, points)
        return bool(inside and not covers)

    for place, told in zip(places, texts, strict=True):
        if not told:
            continue
        text = axes.annotate(
            plain(tell(told, LONGEST)),
            place,
            BESIDE[0],
            textcoords="offset points",
            fontsize=size,
            color=colour,
            bbox=PAPER,
        )
        text.set_in_layout(False)
        for right, up in BESIDE:
            text.xyann = right, up
            text.set_ha("left" if right > 0 else "right" if right < 0 else "center")
            box = text.get_window_extent()
            if is_free(box):
                taken.append(box)
                break
        else:
            text.remove()
    return axes


def _holds(box: Any, points: Float[np.ndarray, "point 2"]) -> bool:
    """Whether a point lies within a box."""
    return any(box.contains(*point) for point in points)
