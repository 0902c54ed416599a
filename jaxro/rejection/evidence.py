"""The evidence for an orientation that a search has found: how well the points kept
fit, and how likely it is that they agree by chance.

Right points under a wrong orientation are no independent accidents: right points of one
depth agree with it together. The number of points that agree proves nothing by itself,
therefore. It proves something if the search was thorough enough to have met a better
orientation, and if the chance of agreement is measured on the scene itself.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, ArrayLike, Bool, Float, Int, ScalarLike

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.passes import count
from .agreement import points_within, squares
from .masked import Use, Values, mean_of, sum_of
from .subsets import move_up_coordinates

DEVIATIONS = 3.0
"""The level of the global test, as a multiple of the standard deviation of a normal
number."""

SHIFTS, TRIALS = 8, 4096
"""Other partners that each point is given: at least SHIFTS, and for few points so many
that there are TRIALS in all."""

PARTS = [2 ** (-k / 4) for k in range(14)]
"""Parts of the limit within which points are counted, down to a tenth: below it points
are no nearer than by accident."""


Cells = Int[Array, "point"]
"""Of each point the number of its cell."""

CELLS = 10
"""Cells along the longer side of what the points cover of a photo."""


def chi_squared_limit(
    deviations: ScalarLike, freedom: Float[Array, ""]
) -> Float[Array, ""]:
    """The value that chi-squared exceeds as seldom as a normal number exceeds so many
    standard deviations, to a few per cent (Wilson and Hilferty 1931)."""
    part = 2 / (9 * jnp.maximum(freedom, 1.0))
    return freedom * (1 - part + deviations * jnp.sqrt(part)) ** 3


def misfit(squares: Values, use: Use) -> Float[Array, ""]:
    """Σ (r / sigma)² of the points in use: the statistic of the global test."""
    return sum_of(squares, use)


def fits_well(squares: Values, use: Use) -> Bool[Array, ""]:
    """Whether the points in use pass the global test: their misfit is not too large."""
    freedom = count(use) - 5
    return misfit(squares, use) <= chi_squared_limit(DEVIATIONS, freedom)


def fits_too_well(squares: Values, use: Use) -> Bool[Array, ""]:
    """Whether the misfit is so small that sigma must be too large, which hides wrong
    points from the global test."""
    freedom = count(use) - 5
    return misfit(squares, use) < chi_squared_limit(-DEVIATIONS, freedom)


def shifted_agreement(
    pair: Pair, pose: RelativePose, limit: ArrayLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How many points agree with a pose when every point is given the partner of
    another one, and of how many."""
    n = count(pair.mask)
    rows = move_up_coordinates(pair)
    size = len(rows)
    there = jnp.arange(size, dtype=n.dtype) < n
    shifts = max(SHIFTS, TRIALS // size)
    shifts = max(min(shifts, size - 1), 1)
    twice = jnp.concatenate([rows[:, 2:], rows[:, 2:]])
    there_twice = jnp.concatenate([there, there])

    def shift(i, sums):
        # all places are turned, the empty ones with them: a shift by the number of
        # points would have to gather
        begin = 1 + i * (size - 1) // shifts
        partners = lax.dynamic_slice_in_dim(twice, begin, size)
        also = lax.dynamic_slice_in_dim(there_twice, begin, size)
        mixed = dataclasses.replace(
            pair,
            x_left=rows[:, 0],
            y_left=rows[:, 1],
            x_right=partners[:, 0],
            y_right=partners[:, 1],
            mask=there & also,
        )
        agree = points_within(mixed, pose, limit)
        agreed, asked = sums
        return agreed + count(agree), asked + count(mixed.mask)

    return lax.fori_loop(0, shifts, shift, (n * 0, n * 0))


def chance_by_distance(
    squares: Values, out: Use, limit: Float[Array, ""]
) -> Float[Array, ""]:
    """The chance that a wrong point agrees, from the distances of the points that are
    out: limit / (mean |r| / sigma).

    It is twice the chance of points spread evenly up to twice their mean distance,
    since small distances are more frequent.
    """
    mean = mean_of(jnp.sqrt(squares), out)
    return limit / jnp.maximum(mean, 2 * limit)


def chance_of_agreement(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> Float[Array, ""]:
    """The chance that a wrong point agrees with a pose: by the partners of other
    points, and by the distances of the points that are not in use."""
    agreed, asked = shifted_agreement(pair, pose, limit)
    out = pair.mask & ~use
    spread = chance_by_distance(squares(pair, pose), out, limit) / 2
    return jnp.maximum((agreed + 1) / (asked + 2), spread)


def log_accidents(
    chance: Float[Array, ""], of: Float[Array, ""], kept: Float[Array, ""]
) -> Float[Array, ""]:
    """Logarithm of the expected number of sets as good by accident (Moisan and Stival
    2004),

        C(n, k) C(k, 5) p^(k-5) (n - 5),

    where k = `kept` of n = `of` points agree with an orientation of five of them, and
    each other point agrees with the probability p = `chance`.
    """
    k = jnp.maximum(kept, 5.0)
    # C(n, k) C(k, 5) without the factor k! that both have
    choices = gammaln(of + 1) - gammaln(of - k + 1)
    choices = choices - gammaln(6.0) - gammaln(k - 4)
    orientations = jnp.log(jnp.maximum(of - 5, 1.0))
    agreement = (k - 5) * jnp.log(chance)
    value = choices + agreement + orientations
    return jnp.where(kept > 5, value, jnp.inf)


def log_least_accidents(
    squares: Values,
    use: Use,
    chance: Float[Array, ""],
    of: Float[Array, ""],
    limit: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """The least `log_accidents` of the points within a part of the limit, over all
    PARTS; `squares` = (r / sigma)².

    Another point lies within a part of the limit with that part of the `chance` that it
    lies within the limit (Moisan and Stival 2004). So right points that lie well within
    it are the stronger evidence, and sigma need not be known well.
    """

    def within(part):
        kept = count(use & (squares <= (part * limit) ** 2))
        return log_accidents(chance * part, of, kept)

    parts = jnp.asarray(PARTS, squares.dtype)
    return jnp.min(jax.vmap(within)(parts))


def z_of_scores(score: Values, use: Use, others: Use) -> Float[Array, ""]:
    """By how many standard deviations the ranks of the scores of points in use are
    higher than if they had been drawn from all, these and the others (Mann and Whitney
    1947); of points without a score nothing is said."""
    known = jnp.isfinite(score)
    use, others = use & known, others & known
    value = jnp.where(use | others, score, jnp.inf)
    in_order = jnp.sort(value)
    below, up_to = (
        jnp.searchsorted(in_order, value, side=side).astype(score.dtype)
        for side in ("left", "right")
    )
    k, m = count(use), count(others)
    rank = (below + up_to + 1) / 2
    above = sum_of(rank, use) - k * (k + m + 1) / 2
    variance = k * m * (k + m + 1) / 12
    return above / jnp.sqrt(jnp.maximum(variance, 1.0))


def fewest_points(
    chance: Float[Array, ""], of: Float[Array, ""], most: Float[Array, ""], size: int
) -> Float[Array, ""]:
    """The fewest points that are no accident, if they lie within half of the limit:
    their `log_accidents` are at most `most`."""
    kept = jnp.arange(6, size + 6, dtype=of.dtype)
    expected = lambda k: log_accidents(chance / 2, of, k)
    fine = (jax.vmap(expected)(kept) <= most) & (kept <= of)
    first = kept[jnp.argmax(fine)]
    return jnp.where(jnp.any(fine), first, of)


def apart(pair: Pair) -> Use:
    """One point of each group that lies in the same cell of both photos.

    A structure that repeats itself, such as the windows of a facade, gives many matches
    at few places, which agree with each other whatever they are: all of a cell are one
    witness.
    """
    return one_of_each(cells(pair), pair.mask)


def cells(pair: Pair) -> Cells:
    """In which cell of both photos each point lies, by numbers less than that of the
    points."""
    key = jnp.zeros_like(pair.sigma)
    x_left, y_left, x_right, y_right = pair.coordinates
    for x, y in ((x_left, y_left), (x_right, y_right)):
        columns, rows = (_from_first(pair, c) for c in (x, y))
        longest = jnp.maximum(jnp.max(columns), jnp.max(rows))
        size = jnp.maximum(longest, jnp.finfo(longest.dtype).tiny) / CELLS
        for c in (columns, rows):
            key = key * CELLS + jnp.clip(jnp.floor(c / size), 0, CELLS - 1)
    key = jnp.where(pair.mask, key, jnp.inf)
    order = jnp.argsort(key, stable=True)
    in_order = key[order]
    new = jnp.concatenate([jnp.zeros(1, bool), in_order[1:] != in_order[:-1]])
    return jnp.zeros_like(order).at[order].set(jnp.cumsum(new.astype(order.dtype)))


def one_of_each(cell: Cells, use: Use) -> Use:
    """The first of these points in each cell."""
    place = jnp.arange(cell.size)
    nobody = jnp.full_like(place, cell.size)
    first = nobody.at[cell].min(jnp.where(use, place, cell.size))
    return use & (place == first[cell])


def held_by(cell: Cells, use: Use) -> Bool[Array, "cell"]:
    """The cells that one of these points is in."""
    return jnp.zeros_like(use).at[cell].max(use)


def _from_first(pair: Pair, values: Values) -> Values:
    """The values less the least of all points; zero of masked points."""
    least = jnp.min(jnp.where(pair.mask, values, jnp.inf))
    return jnp.where(pair.mask, values - least, 0.0)
