"""A survey of heights over a grid as one function of everything measured, with the
exact errors of all it gives.

    height of a point   its known one, or that of the adjusted traverses through it,
                        or that of such a point in its square with the difference (19)
                        between their readings, or else (1) over the grid

What is measured once and used often (camera height, base, squares, readings of the
grid) makes errors in common. The Jacobian of the whole, through the adjustment, carries
each into every height and every misclosure, so that standard deviations, tests and
shares of the sources have all correlations in them. Traverses are weighted by the
readings made anew for each leg, back and fore: what points have in common cancels
between legs.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.guarded import root
from ..adjustment.propagation import jacobian, propagate_each
from ..xla.passes import total
from ..xla.programs import Program, is_traced
from ..xla.settings import COMPILE_FAST
from .heights import Number, Sight, Square, Station, sighted
from .levelling import Flags, Levelled, Network, Places, adjust_heights, network


class Measured(NamedTuple):
    """Everything measured, or the standard deviations of it: height of the cameras and
    base; of every square its side in nature and on the right photo; readings of the
    grid, of every point, and at the ends of every leg."""

    camera_height: Float[Array, "*batch"]
    base: Float[Array, "*batch"]
    side: Float[Array, "*batch square"]
    photo_side: Float[Array, "*batch square"]
    grid: Float[Array, "*batch reading"]
    point: Float[Array, "*batch point"]
    back: Float[Array, "*batch leg"]
    fore: Float[Array, "*batch leg"]


class Survey(eqx.Module):
    """What was measured and how it hangs together. Points are numbered through;
    `square` and `grid` are the numbers of the square and of the reading of the grid
    that belong to each, `datum` the height of the grid in each square, `known` and
    `height` the points of known height, `support` the point each is read from (its own
    number where none).

    Legs run from point `start` to `end`; `network` is that of the points `levelled`, in
    its own numbers; None without legs.
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
    """Heights of all points, those that (1) alone gives, and the misclosures of the
    traverses."""

    value: Float[Array, "*batch point"]
    over_grid: Float[Array, "*batch point"]
    misclosure: Float[Array, "*batch traverse"]


class Surveyed(eqx.Module):
    """A finished survey: heights and misclosures, their standard deviations, and the
    part of every source in the variances of the heights (of 1; fields (point,)). `w` of
    every traverse is its misclosure in its own standard deviation, `detectable` the
    least error of one of its legs that this test finds with its power, as in
    `levelling.Levelled`, whose numbers for the readings alone are in `adjusted` (None
    without legs); `leg_deviations` are those of the legs by these readings."""

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
    """The survey of these measurements; numbers as in `Survey`. `deviations` broadcast
    to `measured`.

    Raises ValueError where traverses do not determine their points (see
    `levelling.network`).
    """
    squares, known = np.asarray(square, int), np.asarray(known, bool)
    points, starts, ends = (
        np.arange(len(known)),
        np.asarray(start, int),
        np.asarray(end, int),
    )
    levelled = np.unique(np.concatenate([starts, ends]))
    found = None
    if len(starts):
        found = network(
            np.searchsorted(levelled, starts),
            np.searchsorted(levelled, ends),
            known[levelled],
        )
    reading = np.asarray(measured.point)
    safe = known | np.isin(points, levelled)
    support = points.copy()
    for i in points[
        ~safe
        # the nearest in height: what is left of the errors in common grows with the
        # difference
    ]:
        near = points[safe & (squares == squares[i])]
        if len(near):
            support[i] = near[np.argmin(np.abs(reading[near] - reading[i]))]
    measured = Measured(*(jnp.asarray(a, float) for a in measured))
    deviations = Measured(
        *(
            jnp.broadcast_to(jnp.asarray(s, float), a.shape)
            for s, a in zip(deviations, measured, strict=True)
        )
    )
    numbers = [jnp.asarray(np.asarray(a, int)) for a in (squares, grid)]
    return Survey(
        measured,
        deviations,
        *numbers,
        jnp.asarray(datum, float),
        jnp.asarray(known),
        jnp.asarray(height, float),
        jnp.asarray(support),
        jnp.asarray(starts),
        jnp.asarray(ends),
        found,
        jnp.asarray(levelled),
    )


def _level(survey: Survey, measured: Measured, point: Array, reading: Array) -> Number:
    """Heights of points by (1) from these readings of them."""
    square = survey.square[point]
    datum = survey.datum[square]
    sight = Sight(
        Square(measured.side[square], measured.photo_side[square]),
        measured.grid[survey.grid[point]],
        reading,
    )
    return datum + sighted(
        Station(measured.camera_height - datum, measured.base), sight
    )


def leg_variances(survey: Survey) -> Float[Array, " leg"]:
    """Variances of the legs from their own readings."""
    m, s = survey.measured, survey.deviations

    def one(point, reading, spread):
        square = survey.square[point]
        sight = Sight(
            Square(m.side[square], m.photo_side[square]),
            m.grid[survey.grid[point]],
            reading,
        )
        station = Station(m.camera_height - survey.datum[square], m.base)
        values, exact = (station, sight), jax.tree.map(jnp.zeros_like, (station, sight))
        return propagate_each(
            lambda v: sighted(*v), values, (exact[0], exact[1]._replace(point=spread))
        )

    return one(survey.start, m.back, s.back) ** 2 + one(survey.end, m.fore, s.fore) ** 2


def heights(
    survey: Survey, measured: Measured, variances: Float[Array, " leg"]
) -> tuple[Heights, Levelled | None]:
    """Everything the survey gives, from these measurements."""
    points = jnp.arange(survey.known.shape[0])
    over_grid = _level(survey, measured, points, measured.point)
    best = jnp.where(survey.known, survey.height, over_grid)
    adjusted, misclosure = None, jnp.zeros(0)
    if survey.network is not None:
        back, fore = (
            _level(survey, measured, at, reading)
            for at, reading in (
                (survey.start, measured.back),
                (survey.end, measured.fore),
            )
        )
        adjusted = adjust_heights(
            survey.network, fore - back, variances, survey.height[survey.levelled]
        )
        best, misclosure = (
            best.at[survey.levelled].set(adjusted.heights),
            adjusted.misclosure,
        )
    own = survey.support == points
    value = jnp.where(
        own, best, best[survey.support] + over_grid - over_grid[survey.support]
    )
    return Heights(value, over_grid, misclosure), adjusted


def solve(survey: Survey, *, level: float = 0.001, power: float = 0.80) -> Surveyed:
    """Heights with their standard deviations, and the tests of the traverses. Works
    under jit and vmap."""
    if is_traced(survey):
        return _solved(survey, level=level, power=power)
    return Program(_solved, {"level": level, "power": power}, COMPILE_FAST)(survey)


def _solved(survey: Survey, level: float, power: float) -> Surveyed:
    variances = leg_variances(survey)
    value, adjusted = heights(survey, survey.measured, variances)
    slopes = jacobian(
        lambda measured: heights(survey, measured, variances)[0], survey.measured
    )
    parts = [
        Measured(*(_squares(j, s) for j, s in zip(of, survey.deviations, strict=True)))
        for of in slopes
    ]
    deviations = Heights(*(root(sum(of, jnp.zeros(()))) for of in parts))
    whole = deviations.value**2
    shares = Measured(
        *(
            jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), 0.0)
            for part in parts[0]
        )
    )
    limit, delta = critical.normal(level), critical.delta_normal(level, power)
    if adjusted is None:
        return Surveyed(
            value,
            deviations,
            shares,
            jnp.zeros(0),
            jnp.zeros(0),
            limit,
            jnp.zeros(0),
            None,
        )
    there, spread = adjusted.testable, deviations.misclosure
    w = jnp.where(there, value.misclosure / jnp.where(there, spread, 1.0), 0.0)
    detectable = jnp.where(
        there, delta * spread / jnp.where(there, adjusted.redundancy, 1.0), jnp.inf
    )
    return Surveyed(
        value, deviations, shares, w, detectable, limit, jnp.sqrt(variances), adjusted
    )


def _squares(slopes: Array, deviations: Array) -> Array:
    """The variance of every result from one source."""
    if deviations.ndim == 0:
        return (slopes * deviations) ** 2
    return total((slopes * deviations[None, :]) ** 2)
