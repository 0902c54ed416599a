"""What speaks for an orientation that a search has found: noise, and how likely it is
that the points agree by chance.

Right points under a wrong orientation are no independent accidents: those of one depth
agree with it together. The number of points that agree proves nothing by itself,
therefore, unless the search was thorough enough to have met the better orientation, and
unless the chance of agreement is measured on the scene itself.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, ArrayLike, Bool, Float

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.passes import count, total
from .hypotheses import moved_up, squares

Values = Float[Array, "point"]
Use = Bool[Array, "point"]

SHIFTS, TRIALS = 8, 4096
"""Other partners that each point is given: at least so many, more where there are few
points, to make so many trials.
"""

PARTS = [2 ** (-k / 4) for k in range(14)]
"""Of the limit, down to a tenth, within which points are counted: below it none is
nearer by more than accident."""


def chi_squared_limit(deviations: float, freedom: Float[Array, ""]) -> Float[Array, ""]:
    """What chi-squared exceeds as seldom as a normal number so many standard
    deviations, to a few per cent (Wilson and Hilferty 1931)."""
    part = 2 / (9 * jnp.maximum(freedom, 1.0))
    return freedom * (1 - part + deviations * jnp.sqrt(part)) ** 3


def shifted_agreement(
    pair: Pair, pose: RelativePose, limit: ArrayLike
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How many points agree with a pose when every point is given the partner of
    another one, and of how many."""
    rows, n = moved_up(pair), count(pair.mask)
    size = rows.shape[0]
    there = jnp.arange(size, dtype=n.dtype) < n
    shifts = max(min(max(SHIFTS, TRIALS // size), size - 1), 1)
    twice = [jnp.concatenate([a, a]) for a in (rows[:, 2], rows[:, 3], there)]

    def shifted(i, sums):
        # the places are turned, the empty ones with them: a shift by the number of
        # points would have to gather
        x, y, also = (
            lax.dynamic_slice_in_dim(a, 1 + i * (size - 1) // shifts, size)
            for a in twice
        )
        mixed = Pair(
            rows[:, 0],
            rows[:, 1],
            x,
            y,
            pair.sigma,
            there & also,
            pair.focal_left,
            pair.focal_right,
        )
        agree = mixed.mask & (squares(mixed, pose) <= jnp.asarray(limit, n.dtype) ** 2)
        return tuple(
            a + count(b) for a, b in zip(sums, (agree, mixed.mask), strict=True)
        )

    return lax.fori_loop(0, shifts, shifted, (n * 0, n * 0))


def scattered(squares: Values, out: Use, limit: Float[Array, ""]) -> Float[Array, ""]:
    """The chance that a wrong point agrees, from how far those lie that are out: limit
    / (mean |r| / sigma).

    It is twice that of points spread evenly up to twice their mean distance, since
    small distances are more frequent.
    """
    mean = total(jnp.where(out, jnp.sqrt(squares), 0.0)) / jnp.maximum(count(out), 1.0)
    return limit / jnp.maximum(mean, 2 * limit)


def accidents(
    chance: Float[Array, ""], of: Float[Array, ""], kept: Float[Array, ""]
) -> Float[Array, ""]:
    """Logarithm of the expected number of sets as good by accident (Moisan and Stival
    2004),

    C(n, k) C(k, 5) p^(k-5) (n - 5),

    `kept` = k of n points agree with an orientation of five of them, each other one
    with the probability `chance`.
    """
    k = jnp.maximum(kept, 5.0)
    choices = gammaln(of + 1) - gammaln(of - k + 1) - gammaln(6.0) - gammaln(k - 4)
    value = choices + (k - 5) * jnp.log(chance) + jnp.log(jnp.maximum(of - 5, 1.0))
    return jnp.where(kept > 5, value, jnp.inf)


def least_accidents(
    squares: Values,
    use: Use,
    chance: Float[Array, ""],
    of: Float[Array, ""],
    limit: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Logarithm of the expected number of accidents of the points within a part of the
    limit, for the part for which it is least; `squares` = (r / sigma)².

    Another point lies within a part of the limit with that part of the `chance` that it
    lies within the limit (Moisan and Stival 2004). So right points that lie well within
    it are the stronger evidence for it, and sigma need not be known well.
    """

    def within(part):
        kept = count(use & (squares <= (part * limit) ** 2))
        return accidents(chance * part, of, kept)

    return jnp.min(jax.vmap(within)(jnp.asarray(PARTS, squares.dtype)))


def fewest(
    chance: Float[Array, ""], of: Float[Array, ""], most: Float[Array, ""], size: int
) -> Float[Array, ""]:
    """The fewest points that are no accident: whose expected number of sets as good is
    at most exp(`most`), if they lie within half of the limit."""
    kept = jnp.arange(6, size + 6, dtype=of.dtype)
    fine = (jax.vmap(lambda k: accidents(chance / 2, of, k))(kept) <= most) & (
        kept <= of
    )
    return jnp.where(jnp.any(fine), kept[jnp.argmax(fine)], of)


def repeats(pair: Pair) -> tuple[Use, Float[Array, "point"]]:
    """The points that repeat an earlier one, which is no evidence of its own, and a
    number that tells them apart."""
    # what repeats another point is like it in any number made of its coordinates
    key = jnp.zeros_like(pair.sigma)
    for k, c in enumerate(pair.coordinates):
        key = key + c * (k + 0.1) ** 0.5
    order = jnp.argsort(jnp.where(pair.mask, key, jnp.inf), stable=True)
    sorted_key = key[order]
    again = jnp.concatenate([jnp.zeros(1, bool), sorted_key[1:] == sorted_key[:-1]])
    return pair.mask & jnp.zeros_like(pair.mask).at[order].set(again), key


def with_repeats(use: Use, again: Use, key: Values) -> Use:
    """The points in use, and those that repeat one of them."""
    order = jnp.argsort(jnp.where(use, key, jnp.inf))
    used = jnp.where(use[order], key[order], jnp.inf)
    place = jnp.clip(jnp.searchsorted(used, key), 0, key.shape[0] - 1)
    return use | (again & (used[place] == key))
