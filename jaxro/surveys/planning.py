"""The accuracy to expect of a survey over a grid before it is made, and the base or
camera height that a wanted accuracy needs.

Errors are propagated exactly through `heights` at the planned geometry. In traverses
the points are read anew for each leg, and the grid once in each square, as in
`grid_survey`: only the readings of points add up from leg to leg. Errors of the squares
and of the grid enter both legs that meet in a point, and cancel except at the ends. The
error of the camera height enters for one step of height; the middle of a traverse that
leads down and up again is worse by up to 12.5 %. The paper's (13) and (16), in
`accuracy`, let everything add up.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import ArrayLike

from ..adjustment.guarded import root
from .accuracy import Budget, budget
from .heights import (
    Number,
    Sight,
    Square,
    Station,
    as_number,
    sighted_difference,
    sighted_height,
)

LARGEST_BASE = 0.25
"""Of the camera height, (10): beyond it the photos have too little in common."""

SHORTEST_BASE = LARGEST_BASE / 1000
"""Of the camera height: no shorter base is searched."""

HIGHEST = 20.0
"""Times the camera height of the plan: no larger one is searched."""

POINTS = 400
"""Steps of a search, in equal ratios."""

HALVINGS = 60
"""Of the step in which the wanted value lies."""


class Plan(NamedTuple):
    """A planned survey: focal length, height of the cameras over the grid, base, side
    of the squares, depth of the points below the grid, difference of height of
    neighbouring points (mm); legs of a traverse between two known heights, and how many
    such traverses meet in a node."""

    focal: ArrayLike
    camera_height: ArrayLike
    base: ArrayLike
    side: ArrayLike = 100.0
    depth: ArrayLike = 200.0
    step: ArrayLike = 20.0
    legs: ArrayLike = 9
    traverses: ArrayLike = 3


class Deviations(NamedTuple):
    """Standard deviations of what is measured: camera height, base, side of a square in
    nature and on the photo, and the readings of the grid and of a point (mm). The
    defaults are the paper's: 5.4 and 5.6 µm for the differences of two readings."""

    camera_height: ArrayLike = 10.0
    base: ArrayLike = 0.5
    side: ArrayLike = 0.17
    photo_side: ArrayLike = 0.007
    grid: ArrayLike = 0.0038
    point: ArrayLike = 0.0040

    @property
    def station(self) -> Station:
        """The deviations of the cameras."""
        return Station(self.camera_height, self.base)

    @property
    def sight(self) -> Sight:
        """The deviations of a point read in a square."""
        return Sight(Square(self.side, self.photo_side), self.grid, self.point)


class Expected(NamedTuple):
    """Standard deviations: of a height over the grid (1); of the difference to a
    neighbour in the next square (5), and in the same square (19); of the middle of a
    traverse (13), a node (16), and a point read from that middle (20). The middle of a
    single leg, whose ends are both known, is NaN."""

    height: Number
    difference: Number
    in_square: Number
    middle: Number
    node: Number
    detail: Number


def station(plan: Plan) -> Station:
    """The cameras of a plan."""
    return Station(plan.camera_height, plan.base)


def sight(plan: Plan, depth: ArrayLike) -> Sight:
    """The readings of a point at this depth below the grid, with 0 for the grid itself;
    p_c = f B / H."""
    camera_height = as_number(plan.camera_height)
    p_c = plan.focal * plan.base / camera_height
    square = Square(plan.side, plan.focal * plan.side / camera_height)
    return Sight(square, 0.0, -p_c * depth / (camera_height + depth))


def height_budget(plan: Plan, deviations: Deviations) -> Budget:
    """The standard deviation of a height over the grid and its parts from every source,
    mm."""
    values = station(plan), sight(plan, plan.depth)
    spread = deviations.station, deviations.sight
    return budget(lambda v: sighted_height(*v), values, spread)


def difference_budget(plan: Plan, deviations: Deviations) -> Budget:
    """The same for the difference of height of neighbours in two squares."""
    second = sight(plan, plan.depth + as_number(plan.step))
    values = station(plan), sight(plan, plan.depth), second
    spread = deviations.station, deviations.sight, deviations.sight
    return budget(lambda v: sighted_difference(*v), values, spread)


def in_square_budget(plan: Plan, deviations: Deviations) -> Budget:
    """The same for neighbours in one square, which share its sides and the reading of
    the grid."""
    first = sight(plan, as_number(plan.depth))
    second = sight(plan, plan.depth + as_number(plan.step))
    values = station(plan), first, second.point
    spread = deviations.station, deviations.sight, deviations.point

    def formula(values) -> Number:
        station, first, point = values
        return sighted_difference(station, first, first._replace(point=point))

    return budget(formula, values, spread)


def expected_accuracy(plan: Plan, deviations: Deviations) -> Expected:
    """The accuracy to expect. All numbers may be arrays that broadcast."""
    between = difference_budget(plan, deviations)
    in_square = in_square_budget(plan, deviations).deviation
    legs, traverses = as_number(plan.legs), as_number(plan.traverses)
    read = between.parts[1].point ** 2 + between.parts[2].point ** 2
    # the variance of two points but for their readings; the part of k known points is
    # divided by k
    ends = between.deviation**2 - read
    several = legs > 1
    middle = root(read * legs / 4 + ends * (1 + 1 / 2) / 2)
    detail = root(jnp.where(several, middle, 0.0) ** 2 + in_square**2)
    return Expected(
        height=height_budget(plan, deviations).deviation,
        difference=between.deviation,
        in_square=in_square,
        middle=jnp.where(several, middle, jnp.nan),
        node=root(read * legs / traverses + ends * (1 + 1 / traverses) / 2),
        detail=jnp.where(several, detail, jnp.nan),
    )


def least(
    error: Callable[[Number], Number],
    wanted: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
) -> Number:
    """The least x in [low, high] with error(x) <= wanted; infinite if there is none.

    `error` takes arrays; it may rise and fall, but not within one of the `POINTS` steps
    in equal ratios.
    """
    return _outermost(error, wanted, as_number(low), as_number(high))


def largest(
    error: Callable[[Number], Number],
    wanted: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
) -> Number:
    """The largest such x; 0 if there is none."""
    found = _outermost(error, wanted, as_number(high), as_number(low))
    return jnp.where(jnp.isfinite(found), found, 0.0)


def _outermost(error, wanted, begin, end) -> Number:
    """The x nearest to `begin` with error(x) <= wanted."""
    x = begin * (end / begin) ** (jnp.arange(POINTS + 1) / POINTS)
    good = error(x) <= wanted
    first = jnp.argmax(good)

    def halve(_, interval):
        bad, fine = interval
        middle = jnp.sqrt(bad * fine)
        passes = error(middle) <= wanted
        return jnp.where(passes, bad, middle), jnp.where(passes, middle, fine)

    interval = x[jnp.maximum(first - 1, 0)], x[first]
    _, found = lax.fori_loop(0, HALVINGS, halve, interval)
    return jnp.where(jnp.any(good), found, jnp.inf)


def base_needed(
    plan: Plan,
    deviations: Deviations,
    wanted: ArrayLike,
    of: Callable[[Expected], Number],
) -> Number:
    """The shortest base, from SHORTEST_BASE to LARGEST_BASE of the camera height, that
    gives the quantity of(Expected) the wanted standard deviation; infinite if none
    does."""
    camera_height = as_number(plan.camera_height)
    error = lambda base: of(expected_accuracy(plan._replace(base=base), deviations))
    low, high = SHORTEST_BASE * camera_height, LARGEST_BASE * camera_height
    return least(error, wanted, low, high)


def camera_height_allowed(
    plan: Plan,
    deviations: Deviations,
    wanted: ArrayLike,
    of: Callable[[Expected], Number],
    *,
    fixed_ratio: bool,
) -> Number:
    """The largest camera height, up to HIGHEST times the one of the plan, at which the
    quantity of(Expected) has the wanted standard deviation; 0 if there is none. The
    base is the one of the plan (the height is then at least four bases), or
    (`fixed_ratio`) grows with the height.

    A height over the grid has a best camera height: below it the error of H grows,
    above it the error of the readings.
    """
    now = as_number(plan.camera_height)
    ratio = plan.base / now

    def error(camera_height):
        base = ratio * camera_height if fixed_ratio else plan.base
        moved = plan._replace(camera_height=camera_height, base=base)
        return of(expected_accuracy(moved, deviations))

    low = now / HIGHEST if fixed_ratio else plan.base / LARGEST_BASE
    return largest(error, wanted, low, HIGHEST * now)
