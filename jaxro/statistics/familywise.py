"""Critical values of the largest |w| and the largest |tau| of an adjustment, from their
correlations.

The level is the probability that any row of errorless observations is rejected. The shares
of Bonferroni or Šidák keep it only where the w are independent: of 6, 7, 8 and 12
points in the standard zones a nominal 5 % are in truth 0.9, 1.8, 2.5 and 4.3 %, as six
points have but one w among them.

Let A_i be the event |w_i| > c, and N the number of these events that happen together.
Then

    P(any A_i) = Σ P(A_i) E[1/N | A_i] = P(A_1) m,    m = Σ E[1/N | A_i]

(Naiman and Wynn 1997). m is the effective number of tests: 1 if all events are the
same, n if no two happen together. The expectation is a mean over `DRAWS` fixed draws,
each for one row i in turn: w_i is drawn beyond c, and the other w given w_i. As 1/N
lies between 1/n and 1, the mean has a small variance however rare the event is. c is
the critical value of one test at the level over m, with m found at the value of n tests
first and then once more.

In layouts of 6 to 50 points the true probability is within 0.15 % of a nominal 5 % and
within 0.02 % of a nominal 0.25 %. Adjustments of more than `MOST` rows have the value of
Šidák; the difference is smaller than that, unless most points lie in one place. The
draws belong to the tested rows in their order, so that masked rows change nothing.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import critical_values as critical
from ..xla.kernels import computed_once, while_loop
from .normalised import Normalised

DRAWS = 1024
"""Fixed draws: the effective number is right to about 1 %."""

MOST = 64
"""Tested rows up to which the effective number is found."""

TURNS = 2
"""Evaluations of the effective number. It depends little on the critical value at which
it is evaluated."""

KNOTS = 24
"""Effective numbers for which the critical value of tau is tabulated, from 1 to MOST in
equal ratios."""


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Normal numbers (row, draw), and evenly spread numbers (draw) of the density
    exp(-x)."""
    random = np.random.default_rng(1968)
    normal = random.normal(size=(MOST, DRAWS))
    even = (np.arange(DRAWS) + 0.5) / DRAWS
    return normal, -np.log(random.permutation(even))


NORMAL, EXPONENTIAL = _tables()


def largest_w(level: ArrayLike, normalised: Normalised) -> Float[Array, ""]:
    """The value that the largest |w| of errorless observations exceeds with probability
    `level`; sigma0 is known."""
    value = lambda number: critical.normal(level / number)
    beyond = critical.by_count(
        lambda n: critical.normal(critical.sidak(level, n)),
        normalised.w.shape[0],
        _count(normalised),
    )
    return _largest(value, beyond, normalised, _draw_w)


def largest_tau(level: ArrayLike, normalised: Normalised) -> Float[Array, ""]:
    """The value that the largest |tau| of errorless observations exceeds with probability
    `level`; sigma0 is estimated. Infinite with one degree of freedom, where every |tau|
    is 1."""
    p, most = normalised.parameters, normalised.w.shape[0]
    rows = normalised.freedom + p
    freedom = lambda n: np.maximum(n - p, 1.0)
    beyond = critical.by_count(
        lambda n: critical.tau(critical.sidak(level, n), freedom(n)), most, rows
    )
    number = MOST ** (np.arange(KNOTS) / (KNOTS - 1))
    n = np.arange(min(most, MOST) + 1.0)
    table = critical.tau(level / number[None, :], freedom(n)[:, None])
    own = jnp.arange(n.size) == rows.astype(int)
    own = own & (n > p + 1)
    row = jnp.sum(jnp.where(own[:, None], table, 0.0), axis=0)
    value = lambda number: _cubic(row, jnp.log(number) / np.log(MOST) * (KNOTS - 1))
    found = _largest(value, beyond, normalised, _draw_tau)
    return jnp.where(normalised.freedom > 1, found, jnp.inf)


def effective_number(
    normalised: Normalised, limit: ArrayLike, estimated: bool = False
) -> Float[Array, ""]:
    """The number of independent tests that reject as often as the tests of the rows,
    each at |w| = limit (|tau| if sigma0 is `estimated`); for at most MOST rows."""
    draw = _draw_tau if estimated else _draw_w
    return _number(_few(normalised), jnp.asarray(limit, float), draw)


def _largest(
    value: Callable, beyond: Array, normalised: Normalised, draw: Callable
) -> Float[Array, ""]:
    """value(m) at the effective number m; `beyond` for more than MOST rows."""

    def find(normalised: Normalised) -> Float[Array, ""]:
        few = _few(normalised)
        number, at = jnp.maximum(_count(few), 1.0), computed_once(value)
        for _ in range(TURNS):
            number = _number(few, at(number), draw)
        return at(number)

    if normalised.w.shape[0] <= MOST:
        return find(normalised)

    # a loop of at most one round: under vmap it is entered only if some of them needs it
    def once(state):
        needed, _ = state
        tested = normalised.tested & needed
        found = find(normalised._replace(tested=tested))
        return needed & False, jnp.where(needed, found, beyond)

    start = _count(normalised) <= MOST, beyond
    return while_loop(lambda state: state[0], once, start, normalised.squares)[1]


def _number(few: Normalised, limit: Array, draw: Callable) -> Float[Array, ""]:
    """Σ E[1/N | A_i] by the draws: draw k is for the tested row k modulo their
    number."""
    n, places = _count(few), few.w.shape[0]
    number, draws = jnp.maximum(n, 1.0), jnp.arange(DRAWS)
    own = draws % number.astype(int)
    used = jnp.where(few.tested, 1.0, 0.0)
    root = jnp.sqrt(jnp.where(few.tested, few.redundancy, 1.0))
    errors = jnp.asarray(NORMAL[:places])
    along = (few.basis * root[:, None]).T @ errors
    basis = few.basis[own].T
    w = jnp.asarray(NORMAL.T)[draws, own] / root[own] - jnp.sum(basis * along, axis=0)
    inside = used @ errors**2 - jnp.sum(along**2, axis=0)
    at, threshold, weight = draw(limit, w, inside, few.freedom)

    # given that the own w is `at`, the other w move by their correlation times the
    # difference
    moved = along + basis * (at - w)[None, :]
    others = errors * (used / root)[:, None] - few.basis @ moved
    happen = jnp.abs(others) > threshold[None, :]
    # the own event, which happens, is counted apart: rounding may not decide
    happen = happen & (jnp.arange(places)[:, None] != own[None, :])
    together = 1 + jnp.sum(jnp.where(happen, 1.0, 0.0), axis=0)
    return number * jnp.sum(weight / together) / jnp.sum(weight)


def _draw_w(
    limit: Array, w: Array, inside: Array, freedom: Array
) -> tuple[Array, Array, Array]:
    """w beyond the limit, the threshold of the other |w|, and the weights of the draws:
    w² / 2 exceeds limit² / 2 by an exponential number, with weights 1 / w."""
    at = jnp.sqrt(limit**2 + 2 * EXPONENTIAL)
    return at, jnp.broadcast_to(limit, at.shape), 1 / at


def _draw_tau(
    limit: Array, w: Array, inside: Array, freedom: Array
) -> tuple[Array, Array, Array]:
    """w with tau beyond the limit, the threshold of the other |w|, and the weights.

    x = tau / sqrt(f) has the density (1 - x²)^((f - 3) / 2): 1 - x² is its value at the
    limit times u^(2 / (f - 1)), u uniform, with weights 1 / x. The part of the errors
    that is orthogonal to w keeps its length (`inside` is Σ r²); the draw is the w that
    has this x beside that length.
    """
    f = jnp.maximum(freedom, 2.0)
    left = jnp.maximum(1 - limit**2 / f, 1e-12)
    across = left * jnp.exp(-2 * EXPONENTIAL / (f - 1))
    x = jnp.sqrt(1 - across)
    length = jnp.sqrt(jnp.maximum(inside - w**2, 1e-12) / across)
    return x * length, jnp.sqrt(1 - left) * length, 1 / x


def _few(normalised: Normalised) -> Normalised:
    """The tested rows one behind the other, in at most MOST places."""
    rows = normalised.w.shape[0]
    places = min(rows, MOST)
    rank = jnp.cumsum(normalised.tested.astype(int)) - 1
    rank = jnp.where(normalised.tested, rank, rows)

    def pack(values: Array) -> Array:
        empty = jnp.zeros((places, *values.shape[1:]), values.dtype)
        return empty.at[rank].set(values, mode="drop")

    return normalised._replace(
        w=pack(normalised.w),
        basis=pack(normalised.basis),
        redundancy=pack(normalised.redundancy),
        tested=pack(normalised.tested),
    )


def _count(normalised: Normalised) -> Float[Array, ""]:
    return jnp.sum(normalised.tested.astype(normalised.w.dtype))


def _cubic(row: Float[Array, "knot"], place: Array) -> Array:
    """The value between equally spaced knots by Lagrange's cubic through the four
    nearest."""
    first = jnp.clip(jnp.floor(place) - 1, 0.0, KNOTS - 4.0)
    value = place * 0
    for k in range(4):
        factor = place * 0 + 1
        for j in range(4):
            if j != k:
                factor = factor * (place - first - j) / (k - j)
        here = jnp.arange(KNOTS) == (first + k).astype(int)
        value = value + factor * jnp.sum(jnp.where(here, row, 0.0))
    return value
