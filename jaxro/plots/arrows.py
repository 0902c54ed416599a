"""Small vectors at places, enlarged, with a key arrow that says how long they are."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from .style import BLACK, SMALL, plain

LENGTH = 0.14
"""Length of the longest arrow over the longer side of the area, at most."""

ROOM, ABOVE = 18.0, 9.0
"""Room between axes and title that the key takes, and its height above the axes,
points."""


def round_down(size: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not larger."""
    power = 10.0 ** math.floor(math.log10(size) + 1e-9)
    return next(k * power for k in (5.0, 2.0, 1.0) if k * power <= size * (1 + 1e-9))


def side_of(places: Float[np.ndarray, "place d"]) -> float:
    """The longer side of the area in which places lie; 1 where it has none."""
    plan = places[:, :2]
    return float(np.max(np.ptp(plan, axis=0))) if len(plan) > 1 else 1.0


def enlargement(side: float, longest: float) -> float:
    """How many times vectors are drawn larger: a round number, by which the longest one
    becomes at most `LENGTH` of the side of the area."""
    return round_down(LENGTH * side / longest) if longest > 0 and side > 0 else 1.0


def draw_arrows(
    axes: Any,
    places: Float[np.ndarray, "place 2"],
    shifts: Float[np.ndarray, "place 2"],
    factor: float,
    *,
    colours: Any = BLACK,
    **how: Any,
) -> Any:
    """Arrows from places along shifts, `factor` times as long as these. The ends count
    for the borders of the axes."""
    ends = places + factor * shifts
    axes.update_datalim(np.concatenate([places, ends]))
    scaled = {"angles": "xy", "scale_units": "xy", "scale": 1 / factor}
    shape = {"units": "inches", "width": 0.011, "zorder": 3}
    shape |= {"headwidth": 4.0, "headlength": 5.0, "headaxislength": 4.5}
    given = (colours,) if isinstance(colours, np.ndarray) else ()
    plain = {} if given else {"color": colours}
    drawn = axes.quiver(*places.T, *shifts.T, *given, **scaled, **shape, **plain, **how)
    axes.autoscale_view()
    return drawn


def add_key(axes: Any, drawn: Any, longest: float, unit: str) -> Any:
    """Write an arrow of round length above the axes, with its size."""
    size = round_down(longest) if longest > 0 else 1.0
    height = axes.get_window_extent().height / axes.figure.dpi
    return axes.quiverkey(
        drawn,
        0.7,
        1 + ABOVE / (72 * height),
        size,
        plain(f"{size:g} {unit}"),
        labelpos="E",
        coordinates="axes",
        fontproperties={"size": SMALL},
    )
