"""Critical values of the largest |w| and the largest |tau| of a pair, from their
correlations.

The level is the probability that any point of an errorless pair is rejected. Shared out
equally by Bonferroni or Šidák it is kept only where the w are independent: of 6, 7, 8
and 12 points in the standard zones a nominal 5 % are in truth 0.9, 1.8, 2.5 and 4.3 %,
as six points have but one w among them.

Let A_i be the event |w_i| > c and N the number of them that happen together. Then

    P(any A_i) = Σ P(A_i) E[1/N | A_i] = P(A_1) m,    m = Σ E[1/N | A_i]

(Naiman and Wynn 1997). m is the effective number of tests: 1 where all are the same, n
where no two happen together. The expectation is a mean over `DRAWS` fixed draws, each
for one point i in turn: w_i is drawn beyond c, the others given it. As 1/N lies between
1/n and 1 the mean has a small variance however rare the event is. The value of c is
that of one test at the level over m, with m taken at a first c of n tests and once
more.

Measured on layouts of 6 to 50 points: nominal 5 % are within 0.15 % and nominal 0.25 %
within 0.02 %. Pairs of more than `MOST` points have Šidák's value, from which theirs
differs by less than that unless most points stand in one place. The draws are assigned
to the tested points in their order: masked points change nothing.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import critical_values as critical
from ..xla.kernels import computed_once, while_loop
from .correlations import Normalised

DRAWS = 1024
"""Draws of the table: the effective number is right to about 1 %."""

MOST = 64
"""Tested points up to which the effective number is found."""

TURNS = 2
"""Evaluations of the effective number, which depends little on the value it is taken
at."""

KNOTS = 24
"""Effective numbers for which the critical value of tau is tabulated, between 1 and
MOST in equal ratios."""


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Normal numbers (point, draw) and numbers with the density exp(-x) (draw), which
    are spread evenly."""
    random = np.random.default_rng(1968)
    normal = random.normal(size=(MOST, DRAWS))
    even = (np.arange(DRAWS) + 0.5) / DRAWS
    return normal, -np.log(random.permutation(even))


NORMAL, EXPONENTIAL = _tables()


def largest_w(level: ArrayLike, normalised: Normalised) -> Float[Array, ""]:
    """The value that the largest |w| of an errorless pair exceeds with probability
    `level`; sigma0 is known."""
    value = lambda number: critical.normal(jnp.asarray(level, float) / number)
    beyond = critical.by_count(
        lambda n: critical.normal(critical.sidak(level, n)),
        normalised.w.shape[0],
        _count(normalised),
    )
    return _largest(value, beyond, normalised, _drawn_w)


def largest_tau(level: ArrayLike, normalised: Normalised) -> Float[Array, ""]:
    """The same of the largest |tau|: sigma0 is estimated. Infinite with one degree of
    freedom, where every |tau| is 1.

    The level of one test is the tail of the tau distribution, P(tau² / f > x) of a beta
    distribution.
    """
    points = normalised.w.shape[0]
    freedom = lambda n: jnp.maximum(n - 5, 1.0)
    with jax.ensure_compile_time_eval():
        number = jnp.asarray(MOST ** (np.arange(KNOTS) / (KNOTS - 1)))
        n = jnp.arange(min(points, MOST) + 1.0)
        table = critical.tau(
            jnp.asarray(level, float) / number[None, :], freedom(n)[:, None]
        )
    own = jnp.arange(table.shape[0]) == (normalised.freedom + 5).astype(int)
    row = jnp.sum(jnp.where(own[:, None] & (n > 6)[:, None], table, 0.0), axis=0)
    value = lambda number: _cubic(row, jnp.log(number) / np.log(MOST) * (KNOTS - 1))
    beyond = critical.by_count(
        lambda n: critical.tau(critical.sidak(level, n), freedom(n)),
        points,
        normalised.freedom + 5,
    )
    found = _largest(value, beyond, normalised, _drawn_tau)
    return jnp.where(normalised.freedom > 1, found, jnp.inf)


def effective_number(
    normalised: Normalised, limit: ArrayLike, estimated: bool = False
) -> Float[Array, ""]:
    """How many independent tests reject as often as those of the tested points of a
    pair, each at |w| = limit (|tau| if `estimated`); of at most MOST points."""
    drawn = _drawn_tau if estimated else _drawn_w
    return _number(_few(normalised), jnp.asarray(limit, float), drawn)


def _largest(
    value: Callable, beyond: Array, normalised: Normalised, drawn: Callable
) -> Float[Array, ""]:
    def found(normalised: Normalised) -> Float[Array, ""]:
        few = _few(normalised)
        number, at = jnp.maximum(_count(few), 1.0), computed_once(value)
        for _ in range(TURNS):
            number = _number(few, at(number), drawn)
        return at(number)

    if normalised.w.shape[0] <= MOST:
        return found(normalised)
    needed = _count(normalised) <= MOST

    def once(
        state,
        # a loop of at most one round: under vmap it is entered only if some pair needs it
    ):
        needed, _ = state
        tested = normalised.tested & needed
        return needed & False, jnp.where(
            needed, found(normalised._replace(tested=tested)), beyond
        )

    return while_loop(
        lambda state: state[0], once, (needed, beyond), normalised.squares
    )[1]


def _number(few: Normalised, limit: Array, drawn: Callable) -> Float[Array, ""]:
    """Σ E[1/N | A_i] by the draws: draw k is for the tested point k modulo their
    number."""
    n, places = _count(few), few.w.shape[0]
    root = jnp.sqrt(jnp.where(few.tested, few.redundancy, 1.0))
    used = jnp.where(few.tested, 1.0, 0.0)
    point = jnp.arange(DRAWS) % jnp.maximum(n, 1.0).astype(int)
    errors = jnp.asarray(NORMAL[:places])
    along = (few.basis * root[:, None]).T @ errors
    of_own = few.basis[point].T
    own_error = jnp.asarray(NORMAL.T)[jnp.arange(DRAWS), point]
    w = own_error / root[point] - jnp.sum(of_own * along, axis=0)
    inside = used @ errors**2 - jnp.sum(along**2, axis=0)
    at, threshold, weight = drawn(limit, w, inside, few.freedom)
    # given that the own w is `at`, those of the others are moved by their correlation
    # times the difference
    moved = along + of_own * (at - w)[None, :]
    others = errors * (used / root)[:, None] - few.basis @ moved
    happen = jnp.abs(others) > threshold[None, :]
    # the own event, which happens, is counted apart: rounding may not decide
    own = jnp.arange(places)[:, None] == point[None, :]
    together = 1 + jnp.sum(jnp.where(happen & ~own, 1.0, 0.0), axis=0)
    return jnp.maximum(n, 1.0) * jnp.sum(weight / together) / jnp.sum(weight)


def _drawn_w(
    limit: Array, w: Array, inside: Array, freedom: Array
) -> tuple[Array, Array, Array]:
    """w beyond the limit: w² / 2 exceeds limit² / 2 by an exponential number, with
    weights 1 / w."""
    at = jnp.sqrt(limit**2 + 2 * EXPONENTIAL)
    return at, jnp.broadcast_to(limit, at.shape), 1 / at


def _drawn_tau(
    limit: Array, w: Array, inside: Array, freedom: Array
) -> tuple[Array, Array, Array]:
    """tau beyond the limit. x = tau / sqrt(f) has the density (1 - x²)^((f - 3) / 2): 1
    - x² is that of the limit times u^(2 / (f - 1)), u uniform, with weights 1 / x. What
    is orthogonal to w keeps its length, so that the draw is the w, and the threshold
    the multiple of it, that have this x beside that length."""
    f = jnp.maximum(freedom, 2.0)
    left = jnp.maximum(1 - limit**2 / f, 1e-12)
    across = left * jnp.exp(-2 * EXPONENTIAL / (f - 1))
    x = jnp.sqrt(1 - across)
    length = jnp.sqrt(jnp.maximum(inside - w**2, 1e-12) / across)
    return x * length, jnp.sqrt(1 - left) * length, 1 / x


def _few(normalised: Normalised) -> Normalised:
    """The tested points one behind the other, in at most MOST places."""
    places = min(normalised.w.shape[0], MOST)
    rank = jnp.cumsum(normalised.tested.astype(int)) - 1
    rank = jnp.where(normalised.tested, rank, normalised.w.shape[0])
    packed = lambda values: (
        jnp.zeros((places, *values.shape[1:]), values.dtype)
        .at[rank]
        .set(values, mode="drop")
    )
    return normalised._replace(
        w=packed(normalised.w),
        basis=packed(normalised.basis),
        redundancy=packed(normalised.redundancy),
        tested=packed(normalised.tested),
    )


def _count(normalised: Normalised) -> Float[Array, ""]:
    return jnp.sum(normalised.tested.astype(normalised.w.dtype))


def _cubic(row: Float[Array, "knot"], place: Array) -> Array:
    """The value between equally spaced knots by Lagrange's cubic through the four
    nearest."""
    first = jnp.clip(jnp.floor(place) - 1, 0.0, KNOTS - 4.0)
    value = place * 0
    for k in range(4):
        others = [j for j in range(4) if j != k]
        factor = place * 0 + 1
        for j in others:
            factor = factor * (place - first - j) / (k - j)
        here = jnp.arange(KNOTS) == (first + k).astype(int)
        value = value + factor * jnp.sum(jnp.where(here, row, 0.0))
    return value
