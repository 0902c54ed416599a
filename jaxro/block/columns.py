"""Ways in which whole columns of known coordinates are wrong: northing in the column of
easting, feet, degrees, heights that are all 0, the coordinates of the next row.

Each is a function of numbers, and one hypothesis: where everything fits after it and
nothing does before, it is the cause. The mirror image stands for several causes, which
no fit tells apart.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..adjustment import critical_values as critical

FOOT = 0.3048
"""Metres in a foot."""

UNITS = (
    ("heights_in_feet", FOOT, "they are in feet"),
    ("plan_in_feet", 1 / FOOT, "plan is in feet and heights are in metres"),
    ("heights_in_mm", 0.001, "they are in thousandths of the unit of plan"),
    ("plan_in_km", 1000.0, "plan is in thousandths of their unit"),
)
"""Heights in another unit than plan: the name of it, by what they are to be multiplied,
and what to say."""

FLAT, STEEP = 0.01, 0.1
"""Times so small a factor heights are none, and any wrong height would be explained: it
is tried where their range is larger than this part of the extent in plan."""

EQUAL = 1e-6
"""Part of the extent in plan within which heights are all equal."""

EQUAL_HEIGHTS = "heights_equal"
"""The hypothesis that heights are none."""

AXIS, FLATTENING = 6_378_137.0, 1 / 298.257
"""Half the major axis of the ellipsoid of the earth in metres, and its flattening."""

DEGREES = (("longitude, latitude", (0, 1)), ("latitude, longitude", (1, 0)))
"""The order of degrees, and the columns of longitude and latitude."""

FACTOR = 5.0
"""By so much sigma0 falls at least under a cause."""

LEVEL = 1e-4
"""Probability that a cause is named although there is none."""

UNCERTAIN = 0.1
"""Standard deviation of a height of which nothing is known, over the extent in plan."""

FEWEST = 3
"""Known values of which a column can be judged."""

Known = Float[np.ndarray, "known 3"]
Rows = Bool[np.ndarray, " known"]


class Cause(NamedTuple):
    """What is wrong with what was given: a name, and a sentence with its figure."""

    name: str
    sentence: str
    is_hint: bool = False
    """Whether it is about how was measured, while nothing contradicts what is known: then
    the numbers may be used."""


class Altered(NamedTuple):
    """A hypothesis: what is wrong, in a sentence; the coordinates that would be right;
    and those that would be `unknown`: they tell no more than where the ground is about.
    """

    name: str
    sentence: str
    coordinates: Known
    unknown: Bool[np.ndarray, "known 3"]


def falls(before: float, freedom: int, after: float, freedom_after: int) -> float:
    """The probability that sigma0 falls so far by chance (F test); 1 where it does not
    fall to a part of 1 / `FACTOR`."""
    ratio = (before / max(after, 1e-300)) ** 2
    if ratio <= FACTOR**2:
        return 1.0
    return float(critical.fisher_p(ratio, freedom, freedom_after))


def alter(coordinates: Known, rows: Rows, who: str) -> list[Altered]:
    """All hypotheses about the coordinates of some rows, those of the others as they
    are. `who` they are, in the plural ("control points"), begins each sentence."""
    at = coordinates
    if np.sum(rows & np.all(np.isfinite(at), axis=1)) < FEWEST:
        return []

    def altered(
        name: str, sentence: str, change: Callable[[Known], Known] | None
    ) -> Altered:
        changed, unknown = at.copy(), np.zeros(at.shape, bool)
        if change is None:
            unknown[rows, 2] = True
        else:
            changed[rows] = change(at[rows])
        return Altered(name, sentence, changed, unknown)

    found = [
        altered(
            "mirrored",
            f"The {who} fit the mirror image of what was measured: X and Y are "
            "exchanged, or an axis counts the other way (y of the photos downwards: "
            "--y-down)",
            lambda a: a[:, [1, 0, 2]],
        ),
    ]
    found += [
        altered(
            name,
            f"The heights of the {who} do not fit their plan; times {factor:.5g} "
            f"everything fits: {unit}",
            lambda a, factor=factor: a * [1, 1, factor],
        )
        for name, factor, unit in UNITS
        if factor > FLAT or _relief(at[rows]) > STEEP
    ]
    if _are_degrees(at[rows]):
        found += [
            altered(
                "degrees",
                f"X and Y of the {who} are degrees ({order}): convert them to a system "
                "in metres, with which everything fits",
                lambda a, axes=axes: _in_metres(a, *axes),
            )
            for order, axes in DEGREES
        ]
    if (height := _common_height(at[rows])) is not None:
        found.append(
            altered(
                EQUAL_HEIGHTS,
                f"All heights of the {who} are {height:g}, which contradicts the rest: "
                "leave unknown heights blank",
                None,
            )
        )
    for step, other in ((1, "row before"), (-1, "next row")):
        found.append(
            altered(
                "rows_shifted",
                f"Each of the {who} has the coordinates of the {other}: moved by one row "
                "everything fits",
                lambda a, step=step: _moved(a, step),
            )
        )
    return found


def _moved(at: Known, step: int) -> Known:
    """The coordinates of each row that stand `step` rows further; NaN at the end."""
    moved = np.roll(at, -step, axis=0)
    moved[-1 if step > 0 else 0] = np.nan
    return moved


def _common_height(at: Known) -> float | None:
    """The height of all points, if it is one."""
    heights = at[np.isfinite(at[:, 2]), 2]
    if len(heights) < FEWEST:
        return None
    return float(heights[0]) if _relief(at) <= EQUAL else None


def _relief(at: Known) -> float:
    """The range of the heights over the extent in plan."""
    low, high = np.nanmin(at, axis=0), np.nanmax(at, axis=0)
    return float((high - low)[2] / max(np.max((high - low)[:2]), 1e-300))


def _are_degrees(at: Known) -> bool:
    """Whether X and Y may be longitudes and latitudes, in either order."""
    plan = at[:, :2]
    bounds = np.nanmin(plan), np.nanmax(plan)
    small = np.nanmax(np.ptp(plan[np.all(np.isfinite(plan), axis=1)], axis=0)) < 5
    return bool(small and bounds[0] >= -180 and bounds[1] <= 360)


def _in_metres(at: Known, east: int, north: int) -> Known:
    """Longitudes, latitudes and heights in metres, in the plane that touches the ellipsoid
    in their middle. Heights without a place in the plane are unknown."""
    longitude, latitude = np.radians(at[:, [east, north]].T)
    longitude = longitude - np.nanmean(longitude)
    middle = np.nanmean(latitude)
    square = FLATTENING * (2 - FLATTENING)

    def from_centre(latitude: Any, height: Any) -> tuple[Any, Any]:
        """Distances from the axis of the earth, and from its equator."""
        across = AXIS / np.sqrt(1 - square * np.sin(latitude) ** 2)
        return (
            (across + height) * np.cos(latitude),
            (across * (1 - square) + height) * np.sin(latitude),
        )

    heights = np.where(np.isfinite(at[:, 2]), at[:, 2], 0.0)
    from_axis, from_equator = from_centre(latitude, heights)
    axis, equator = from_centre(middle, 0.0)
    away, along = from_axis * np.cos(longitude) - axis, from_equator - equator
    up = np.cos(middle) * away + np.sin(middle) * along
    return np.stack(
        [
            from_axis * np.sin(longitude),
            np.cos(middle) * along - np.sin(middle) * away,
            np.where(np.isfinite(at[:, 2]), up, np.nan),
        ],
        axis=1,
    )
