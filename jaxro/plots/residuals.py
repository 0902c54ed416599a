"""Residual vectors on photos, enlarged, beside the standard positions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from ..geometry.mock_pairs import ZONES
from ..geometry.pairs import Pair
from ..orientation.result import Orientation
from .arrows import ROOM, add_key, draw_arrows, enlargement, side_of
from .labels import NAMED, place_labels
from .style import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    SMALL,
    add_legend,
    describe,
    make_plan,
    plan_or_new,
    times,
    two_axes_or_new,
    with_unit,
)

NEAR = 0.3
"""Part of the smaller of base and y-range up to which a point lies in a standard
position."""

FEWEST = 5
"""Standard positions with a point that a standard layout has at least."""


class Zone(NamedTuple):
    """A standard position of von Gruber: its number, the place, and how far from it a
    point lies in it at most."""

    number: int
    x: float
    y: float
    radius: float


def find_zones(
    x: Float[np.ndarray, " point"], y: Float[np.ndarray, " point"], base: float
) -> list[Zone]:
    """The six standard positions in the left photo for a base at photo scale, if points
    lie in at least `FEWEST` of them; their y are those of the outermost points. Empty
    for other layouts."""
    if not len(x) or base == 0:
        return []
    above, below = float(np.max(y)), float(-np.min(y))
    radius = NEAR * min(abs(base), above, below)
    if radius <= 0:
        return []
    zones = [
        Zone(number, u * base, v * (above if v > 0 else below), radius)
        for number, (u, v) in ZONES.items()
    ]
    held = [np.any(np.hypot(x - zone.x, y - zone.y) <= radius) for zone in zones]
    return zones if sum(held) >= FEWEST else []


def draw_residuals(
    places: Float[np.ndarray, "point 2"],
    shifts: Float[np.ndarray, "point 2"],
    *,
    rejected: Bool[np.ndarray, " point"] | None = None,
    names: Sequence[str] = (),
    zones: Sequence[Zone] = (),
    unit: str = "mm",
    factor: float | None = None,
    title: str = "Residuals",
    y_down: bool = False,
    axes: Any = None,
) -> Any:
    """The residuals `shifts` at their `places` as arrows, `factor` times as long as they
    are (a round number of its own if None). A `rejected` point is a cross without an
    arrow. `names` are written of rejected points, and of all if there are few."""
    axes = plan_or_new(axes, places)
    out = np.zeros(len(places), bool) if rejected is None else np.asarray(rejected)
    kept, longest = ~out, _longest(shifts[~out])
    if factor is None:
        factor = enlargement(side_of(places), longest)
    for zone in zones:
        _draw_zone(axes, zone)
    axes.plot(*places[kept].T, ".", color=BLUE, ms=5, label="kept", zorder=4)
    if np.any(out):
        style = {"ms": 7, "mew": 1.8, "zorder": 5}
        axes.plot(*places[out].T, "x", color=RED, label="rejected", **style)
    drawn = draw_arrows(axes, places[kept], shifts[kept], factor)
    if longest > 0:
        add_key(axes, drawn, longest, unit)
    describe(
        axes,
        title if longest == 0 else f"{title} {times(factor)}",
        with_unit("x", unit),
        with_unit("y", unit),
        room=ROOM,
    )
    make_plan(axes)
    if y_down:
        axes.invert_yaxis()
    if np.any(out) or zones:
        add_legend(axes)
    _name_points(axes, places, out, names)
    return axes


def draw_photos(
    pair: Pair,
    orientation: Orientation | None,
    *,
    rejected: Bool[Array | np.ndarray, " point"] | None = None,
    names: Sequence[str] = (),
    unit: str = "mm",
    axes: Any = None,
) -> Any:
    """The corrections of an oriented pair on the left and on the right photo, both
    enlarged alike: of its points, and crosses for those that were `rejected` before,
    which are masked in the pair. Without an orientation the places alone. `axes`: both,
    (left, right)."""
    at = np.stack([np.asarray(c) for c in pair.coordinates])
    v = None
    if orientation is not None:
        v = np.stack([np.asarray(c) for c in orientation.corrections(pair)])
    used = np.asarray(pair.mask)
    out = np.zeros_like(used) if rejected is None else np.asarray(rejected) & ~used
    shown = used | out
    return draw_both_photos(
        at[:, shown],
        None if v is None else v[:, shown],
        rejected=out[shown],
        names=[names[k] for k in np.flatnonzero(shown).tolist()] if len(names) else (),
        unit=unit,
        axes=axes,
    )


def draw_both_photos(
    places: Float[np.ndarray, "4 point"],
    corrections: Float[np.ndarray, "4 point"] | None,
    *,
    rejected: Bool[np.ndarray, " point"] | None = None,
    names: Sequence[str] = (),
    unit: str = "mm",
    axes: Any = None,
) -> Any:
    """The same of plain arrays: x_left, y_left, x_right, y_right and their
    corrections."""
    left, right = axes = two_axes_or_new(axes)
    there = np.all(np.isfinite(places), axis=0)
    at = places[:, there]
    v = np.zeros_like(at) if corrections is None else corrections[:, there]
    out = (np.zeros_like(there) if rejected is None else rejected)[there]
    some = [names[k] for k in np.flatnonzero(there).tolist()] if len(names) else ()
    longest = max(_longest(v[:2, ~out].T), _longest(v[2:, ~out].T))
    factor = enlargement(max(side_of(at[:2].T), side_of(at[2:].T)), longest)
    base = float(np.median((at[0] - at[2])[~out])) if np.any(~out) else 0.0
    zones = find_zones(*at[:2, ~out], base)
    of_right = [zone._replace(x=zone.x - base) for zone in zones]
    what = ", not oriented" if corrections is None else ", residuals"
    for one, name, rows, marked in (
        (left, "Left photo", slice(0, 2), zones),
        (right, "Right photo", slice(2, 4), of_right),
    ):
        draw_residuals(
            at[rows].T,
            v[rows].T,
            rejected=out,
            zones=marked,
            unit=unit,
            factor=factor,
            title=name + what,
            axes=one,
        )
    _name_points(left, at[:2].T, out, some)  # when both axes have their places
    _name_points(right, at[2:].T, out, some)
    return axes


def _draw_zone(axes: Any, zone: Zone) -> None:
    """A circle around a standard position, with its number at the edge."""
    from matplotlib.patches import Circle

    first = not any(patch.get_label() == _OF_ZONE for patch in axes.patches)
    circle = Circle(
        (zone.x, zone.y),
        zone.radius,
        fill=False,
        linestyle=(0, (4, 3)),
        edgecolor=ORANGE,
        linewidth=1.0,
        label=_OF_ZONE if first else None,
    )
    axes.add_patch(circle)
    edge = zone.radius * np.sqrt(0.5)
    axes.text(
        zone.x - edge,
        zone.y + edge,
        str(zone.number),
        ha="right",
        va="bottom",
        fontsize=SMALL,
        color=GREY,
    )


_OF_ZONE = "standard position"


def _name_points(
    axes: Any,
    places: Float[np.ndarray, "point 2"],
    out: Bool[np.ndarray, " point"],
    names: Sequence[str],
) -> None:
    """The names of rejected points, then of the others if all are few."""
    if not len(names):
        return
    for which, colour in ((out, RED), (~out, "black")):
        if colour == RED or len(names) <= NAMED:
            texts = [
                str(name) if this else ""
                for name, this in zip(names, which, strict=True)
            ]
            place_labels(axes, places, texts, colour=colour)


def _longest(shifts: Float[np.ndarray, "point 2"]) -> float:
    """The length of the longest vector; 0 without any."""
    lengths = np.hypot(*shifts.T)
    return float(np.max(lengths[np.isfinite(lengths)], initial=0.0))
