"""A survey of heights over a grid: one function of all measurements, with the exact
standard deviations of its results.

The height of a point is the first of these that exists:

1. its known height,
2. its height from the adjusted traverses through it,
3. the height of such a point in its square, with the difference (19) of their readings,
4. its height over the grid, (1).

Measurements that are made once and used often (camera height, base, squares, readings
of the grid) make errors in common. The Jacobian of the whole, through the adjustment,
carries each of them into every height and every misclosure, so that standard
deviations, tests and shares of the sources contain all correlations. Traverses are
weighted by the readings that are made anew for each leg, back and fore: errors that
points have in common cancel between legs. The numbers (1) and (19) are those of
`heights`.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.guarded import ratio, root
from ..adjustment.propagation import jacobian, propagate_each
from ..xla.passes import total
from ..xla.programs import compiled
from .heights import Number, Sight, Square, Station, sighted_height
from .levelling import Levelled, adjust_heights
from .networks import Flags, Network, Places, network


class Measured(NamedTuple):
    """All measurements, or their standard deviations: height of the cameras and base;
    of every square its side in nature and on the right photo; readings of the grid, of
    every point, and at the ends of every leg."""

    camera_height: Float[Array, "*batch"]
    base: Float[Array, "*batch"]
    side: Float[Array, "*batch square"]
    photo_side: Float[Array, "*batch square"]
    grid: Float[Array, "*batch reading"]
    point: Float[Array, "*batch point"]
    back: Float[Array, "*batch leg"]
    fore: Float[Array, "*batch leg"]


class Survey(eqx.Module):
    """The measurements of a survey and how they belong together.

    Per point: `square` and `grid`, the numbers of its square and of the reading of the
    grid beside it; `known`, and the known `height`; `support`, the point from which its
    height is carried over in its square (its own number if there is none). Per square:
    `datum`, the height of the grid in it. Per leg: the points `start` and `end`.
    `levelled`: the points of traverses; `network`: their network, in numbers of its
    own, None without legs.
    """

    measured: Measured
    deviations: Measured
    square: Int[Array, " point"]
    grid: Int[Array, " point"]
    datum: Float[Array, " square"]
    known: Bool[Array, " point"]
    height: Float[Array, " point"]
    support: Int[Array, " point"]
    start: Int[Array, " leg"]
    end: Int[Array, " leg"]
    network: Network | None
    levelled: Int[Array, " node"]


class Heights(NamedTuple):
    """Heights of all points, their heights by (1) alone, and the misclosures of the
    traverses."""

    value: Float[Array, "*batch point"]
    over_grid: Float[Array, "*batch point"]
    misclosure: Float[Array, "*batch traverse"]


class Surveyed(eqx.Module):
    """A finished survey: `heights` and misclosures, their standard `deviations`, and
    the `shares` of every measurement in the variances of the heights (they add up to 1;
    fields (point,)).

    Per traverse: `w`, its misclosure over the standard deviation of this, and the
    `detectable` error of one of its legs, as in `levelling.Levelled`. `adjusted`: the
    adjustment with errors of the readings alone (None without legs); `leg_deviations`:
    standard deviations of the legs by these readings.
    """

    heights: Heights
    deviations: Heights
    shares: Measured
    w: Float[Array, "*batch traverse"]
    detectable: Float[Array, "*batch traverse"]
    limit: Float[Array, "*batch"]
    leg_deviations: Float[Array, "*batch leg"]
    adjusted: Levelled | None


def survey(
    measured: Measured,
    deviations: Measured,
    *,
    square: Places,
    grid: Places,
    datum: Float[np.ndarray, " square"],
    known: Flags,
    height: Float[np.ndarray, " point"],
    start: Places = (),
    end: Places = (),
) -> Survey:
    """The survey of these measurements; the arguments are those of `Survey`.
    `deviations` broadcast to `measured`.

    Raises ValueError if traverses do not determine their points (see
    `networks.network`).
    """
    squares, known = np.asarray(square, int), np.asarray(known, bool)
    starts, ends = np.asarray(start, int), np.asarray(end, int)
    levelled = np.unique(np.concatenate([starts, ends]))
    places = [np.searchsorted(levelled, a) for a in (starts, ends)]
    found = network(*places, known[levelled]) if len(starts) else None
    safe = known | np.isin(np.arange(len(known)), levelled)
    support = _supports(np.asarray(measured.point), squares, safe)
    measured = Measured(*(jnp.asarray(a, float) for a in measured))
    both = zip(deviations, measured, strict=True)
    spread = (jnp.broadcast_to(jnp.asarray(s, float), a.shape) for s, a in both)
    return Survey(
        measured=measured,
        deviations=Measured(*spread),
        square=jnp.asarray(squares),
        grid=jnp.asarray(np.asarray(grid, int)),
        datum=jnp.asarray(datum, float),
        known=jnp.asarray(known),
        height=jnp.asarray(height, float),
        support=jnp.asarray(support),
        start=jnp.asarray(starts),
        end=jnp.asarray(ends),
        network=found,
        levelled=jnp.asarray(levelled),
    )


def _supports(reading: np.ndarray, squares: np.ndarray, safe: np.ndarray) -> np.ndarray:
    """For every point that is not `safe` (known or levelled) the safe point of its
    square that is nearest in height: the errors in common that remain grow with the
    difference. All other points have their own number."""
    points = np.arange(len(safe))
    support = points.copy()
    for i in points[~safe]:
        near = points[safe & (squares == squares[i])]
        if len(near):
            support[i] = near[np.argmin(np.abs(reading[near] - reading[i]))]
    return support


def _sight(
    survey: Survey, measured: Measured, point: Array, reading: Array
) -> tuple[Station, Sight]:
    """What (1) takes for these readings of points, heights counted from the grid in
    their square."""
    square = survey.square[point]
    sides = Square(measured.side[square], measured.photo_side[square])
    sight = Sight(sides, measured.grid[survey.grid[point]], reading)
    return Station(measured.camera_height - survey.datum[square], measured.base), sight


def _level(survey: Survey, measured: Measured, point: Array, reading: Array) -> Number:
    """Heights of points by (1) from these readings of them."""
    datum = survey.datum[survey.square[point]]
    return datum + sighted_height(*_sight(survey, measured, point, reading))


def leg_variances(survey: Survey) -> Float[Array, " leg"]:
    """Variances of the legs from their own readings."""
    m, s = survey.measured, survey.deviations

    def deviation(point: Array, reading: Array, spread: Array) -> Array:
        values = _sight(survey, m, point, reading)
        station, sight = jax.tree.map(jnp.zeros_like, values)
        deviations = station, sight._replace(point=spread)
        return propagate_each(lambda v: sighted_height(*v), values, deviations)

    back = deviation(survey.start, m.back, s.back)
    fore = deviation(survey.end, m.fore, s.fore)
    return back**2 + fore**2


def heights(
    survey: Survey, measured: Measured, variances: Float[Array, " leg"]
) -> tuple[Heights, Levelled | None]:
    """The results of the survey from these measurements; `variances` of the legs are
    the weights of the adjustment."""
    points = jnp.arange(survey.known.shape[0])
    over_grid = _level(survey, measured, points, measured.point)
    best = jnp.where(survey.known, survey.height, over_grid)
    adjusted, misclosure = None, jnp.zeros(0)
    if survey.network is not None:
        back = _level(survey, measured, survey.start, measured.back)
        fore = _level(survey, measured, survey.end, measured.fore)
        known = survey.height[survey.levelled]
        adjusted = adjust_heights(survey.network, fore - back, variances, known)
        best = best.at[survey.levelled].set(adjusted.heights)
        misclosure = adjusted.misclosure
    support = survey.support
    carried = best[support] + over_grid - over_grid[support]
    value = jnp.where(support == points, best, carried)
    return Heights(value, over_grid, misclosure), adjusted


def solve(survey: Survey, *, level: float = 0.001, power: float = 0.80) -> Surveyed:
    """Heights with their standard deviations, and the tests of the traverses. Works
    under jit and vmap."""
    return _solve(survey, critical.delta_normal(level, power), critical.normal(level))


@compiled
def _solve(
    survey: Survey, smallest: Float[Array, ""], limit: Float[Array, ""]
) -> Surveyed:
    """`smallest`: the error that is found, in standard deviations; `limit`: of |w|."""
    variances = leg_variances(survey)
    value, adjusted = heights(survey, survey.measured, variances)
    deviations, shares = _propagate(survey, variances)
    w = detectable = leg_deviations = jnp.zeros(0)
    if adjusted is not None:
        there, spread = adjusted.testable, deviations.misclosure
        w = ratio(value.misclosure, spread, there)
        r = jnp.where(there, adjusted.redundancy, 1.0)
        error = smallest * spread / r
        detectable = jnp.where(there, error, jnp.inf)
        leg_deviations = jnp.sqrt(variances)
    return Surveyed(
        heights=value,
        deviations=deviations,
        shares=shares,
        w=w,
        detectable=detectable,
        limit=limit,
        leg_deviations=leg_deviations,
        adjusted=adjusted,
    )


def _propagate(
    survey: Survey, variances: Float[Array, " leg"]
) -> tuple[Heights, Measured]:
    """Standard deviations of all results, and the shares of every measurement in the
    variances of the heights."""
    results = lambda measured: heights(survey, measured, variances)[0]
    slopes: Heights = jacobian(results, survey.measured)
    of_result: Callable = lambda by: [
        _variance(j, s) for j, s in zip(by, survey.deviations, strict=True)
    ]
    parts = [of_result(by) for by in slopes]
    deviations = Heights(*(root(sum(part, jnp.zeros(()))) for part in parts))
    whole = deviations.value**2
    shares = (ratio(part, whole, whole > 0) for part in parts[0])
    return deviations, Measured(*shares)


def _variance(slopes: Array, deviations: Array) -> Array:
    """The variance of every result from one kind of measurement."""
    if deviations.ndim == 0:
        return (slopes * deviations) ** 2
    return total((slopes * deviations[None, :]) ** 2)
