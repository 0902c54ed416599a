"""What accuracy a survey over a grid will have, before it is made, and what base or
camera height a wanted one needs.

Errors are those of exact propagation through `heights` at the planned geometry. In
traverses the points are read anew for each leg, the grid once in each square, as
`surveys` takes it: of a leg only the readings of its points add up. Errors of the
squares and of the grid enter both legs that meet in a point, and cancel except at the
ends. The error of the camera height enters for one step of height; the middle of a
traverse that leads down and up again is worse by up to an eighth. The paper's (13) and
(16), in `height_accuracy`, let everything add up.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import ArrayLike

from ..adjustment.guarded import root
from .accuracy import Budget, budget
from .heights import Number, Sight, Square, Station, sighted, sighted_difference

LARGEST_BASE = 0.25
"""Of the camera height, (10): beyond it the photos have too little in common."""


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
        """Those of the cameras."""
        return Station(self.camera_height, self.base)

    @property
    def sight(self) -> Sight:
        """Those of a point read in a square."""
        return Sight(Square(self.side, self.photo_side), self.grid, self.point)


class Expected(NamedTuple):
    """Standard deviations: of a height over the grid (1); of the difference to a
    neighbour in the next square (5), and in the same square (19); of the middle of a
    traverse (13), a node (16), and a point read from that middle (20). NaN is the
    middle of a single leg, both ends of which are known."""

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
    """What will be read of a point so far below the grid, the grid itself at 0: p_c = f
    B / H."""
    camera_height = jnp.asarray(plan.camera_height, float)
    p_c = plan.focal * plan.base / camera_height
    square = Square(plan.side, plan.focal * plan.side / camera_height)
    return Sight(square, 0.0, -p_c * depth / (camera_height + depth))


def height_budget(plan: Plan, deviations: Deviations) -> Budget:
    """What every source adds to the standard deviation of a height over the grid,
    mm."""
    values = station(plan), sight(plan, plan.depth)
    return budget(lambda v: sighted(*v), values, (deviations.station, deviations.sight))


def difference_budget(plan: Plan, deviations: Deviations) -> Budget:
    """The same of the difference of height of neighbours in two squares."""
    values = (
        station(plan),
        sight(plan, plan.depth),
        sight(plan, plan.depth + jnp.asarray(plan.step, float)),
    )
    spread = deviations.station, deviations.sight, deviations.sight
    return budget(lambda v: sighted_difference(*v), values, spread)


def in_square_budget(plan: Plan, deviations: Deviations) -> Budget:
    """The same of neighbours in one square: its sides and the reading of the grid are
    those of both."""
    first, second = (
        sight(plan, plan.depth + jnp.asarray(step, float)) for step in (0.0, plan.step)
    )
    values = station(plan), first, second.point
    return budget(
        lambda v: sighted_difference(v[0], v[1], v[1]._replace(point=v[2])),
        values,
        (deviations.station, deviations.sight, deviations.point),
    )


def expected(plan: Plan, deviations: Deviations) -> Expected:
    """The accuracy to expect. All numbers may be arrays that broadcast."""
    between = difference_budget(plan, deviations)
    in_square = in_square_budget(plan, deviations).deviation
    legs, traverses = jnp.asarray(plan.legs, float), jnp.asarray(plan.traverses, float)
    read = between.parts[1].point ** 2 + between.parts[2].point ** 2
    ends = (
        between.deviation**2 - read
    )  # of two points; from two known ones, or k, that of these is divided
    middle = jnp.where(
        legs > 1, root(read * legs / 4 + ends * (1 + 1 / 2) / 2), jnp.nan
    )
    return Expected(
        height_budget(plan, deviations).deviation,
        between.deviation,
        in_square,
        middle,
        root(read * legs / traverses + ends * (1 + 1 / traverses) / 2),
        jnp.where(
            legs > 1,
            root(jnp.where(legs > 1, middle, 0.0) ** 2 + in_square**2),
            jnp.nan,
        ),
    )


POINTS = 400
HALVINGS = 60
SHORTEST_BASE = LARGEST_BASE / 1000
"""Of the camera height: no shorter base is looked at."""
HIGHEST = 20.0
"""Times the camera height of the plan: none higher is looked at."""


def least(
    error: Callable[[Number], Number],
    wanted: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
) -> Number:
    """The least x in [low, high] with error(x) <= wanted, infinite where there is none.
    `error` takes arrays; it may rise and fall, but not within a step of 1/400 of the
    (logarithmic) range."""
    return _outermost(error, wanted, jnp.asarray(low, float), jnp.asarray(high, float))


def largest(
    error: Callable[[Number], Number],
    wanted: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
) -> Number:
    """The largest such x; 0 where there is none."""
    found = _outermost(error, wanted, jnp.asarray(high, float), jnp.asarray(low, float))
    return jnp.where(jnp.isfinite(found), found, 0.0)


def _outermost(error, wanted, begin, end) -> Number:
    """The x nearest to `begin` with error(x) <= wanted."""
    x = begin * (end / begin) ** (jnp.arange(POINTS + 1) / POINTS)
    good = error(x) <= wanted
    first = jnp.argmax(good)

    def halved(_, interval):
        bad, fine = interval
        middle = jnp.sqrt(bad * fine)
        passes = error(middle) <= wanted
        return jnp.where(passes, bad, middle), jnp.where(passes, middle, fine)

    _, found = lax.fori_loop(
        0, HALVINGS, halved, (x[jnp.maximum(first - 1, 0)], x[first])
    )
    return jnp.where(jnp.any(good), found, jnp.inf)


def base_needed(
    plan: Plan,
    deviations: Deviations,
    wanted: ArrayLike,
    of: Callable[[Expected], Number],
) -> Number:
    """The shortest base that gives this quantity the wanted standard deviation, at most
    a quarter of the camera height; infinite where not even that does. None below
    SHORTEST_BASE is looked at."""
    camera_height = jnp.asarray(plan.camera_height, float)
    error = lambda base: of(expected(plan._replace(base=base), deviations))
    return least(
        error, wanted, SHORTEST_BASE * camera_height, LARGEST_BASE * camera_height
    )


def camera_height_allowed(
    plan: Plan,
    deviations: Deviations,
    wanted: ArrayLike,
    of: Callable[[Expected], Number],
    *,
    fixed_ratio: bool,
) -> Number:
    """The largest camera height, up to HIGHEST times that of the plan, at which this
    quantity has the wanted standard deviation, with the base of the plan (then not
    below four bases) or (`fixed_ratio`) its H : B; 0 where none has.

    A height over the grid has a best camera height: below it the error of H grows,
    above it that of the readings.
    """
    now = jnp.asarray(plan.camera_height, float)
    ratio = plan.base / now

    def error(camera_height):
        base = ratio * camera_height if fixed_ratio else plan.base
        return of(
            expected(plan._replace(camera_height=camera_height, base=base), deviations)
        )

    return largest(
        error,
        wanted,
        now / HIGHEST if fixed_ratio else plan.base / LARGEST_BASE,
        HIGHEST * now,
    )
