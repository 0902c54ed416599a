"""Critical values of the tests on residuals, and the errors that these tests can find.

`level` is the probability that a test rejects although there is no error. `power` is
the probability that it rejects when there is an error, and `delta` the size of this
error in standard deviations of the statistic (the root of Baarda's non-centrality
lambda). `freedom` are degrees of freedom.

Quantiles without a closed form are found by bisection of the distribution, powers by
quadrature. All arguments may be arrays that broadcast together; everything works under
jit and vmap.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammainc, gammaincc, gammaln, ndtr, ndtri
from jaxtyping import Array, ArrayLike, Float

from .bisection import bisect

Scalar = Float[Array, "..."]

UNTESTABLE = 1e-6
"""Redundancy number below which an observation counts as not checked by the others."""

HALVINGS = 120
"""Of an interval: to the last bit of a double even near zero."""

FEWER_HALVINGS = 60
"""For values that are nowhere near zero and take a quadrature each."""

WINDOW = 9.0
"""Standard deviations: a normal number lies further away with a probability of 1e-19,
which integrals leave out."""

EACH, DENSITY = 64, 32
"""Tables by counts of points have an entry for every count up to EACH, and DENSITY
entries an octave beyond."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(96)


def normal(level: ArrayLike) -> Scalar:
    """Two-sided: |w| of a normal number w exceeds it with probability `level` (Baarda
    1968)."""
    return -ndtri(jnp.asarray(level, float) / 2)


def student(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """One-sided: t with `freedom` degrees of freedom exceeds it with probability
    `level`, at most one half."""
    level, freedom = _numbers(level, freedom)
    # P(T > t) = I_x(f/2, 1/2) / 2 at x = f / (f + t²)
    beyond = lambda x: betainc(freedom / 2, 0.5, x) / 2 > level
    one = jnp.ones_like(level * freedom)
    x = _bisect(beyond, one)
    return jnp.sqrt(freedom * (1 - x) / x)


def tau(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """Two-sided: a residual over its estimated standard deviation exceeds it with
    probability `level` (Pope 1976):

        tau = sqrt(f) t / sqrt(f - 1 + t²),    t of f - 1 degrees of freedom.

    Infinite with one degree of freedom, where every residual has tau = 1.
    """
    level, freedom = _numbers(level, freedom)
    others = freedom - 1
    t = student(level / 2, jnp.maximum(others, 1.0))
    value = jnp.sqrt(freedom) * t / jnp.sqrt(others + t * t)
    return jnp.where(freedom > 1, value, jnp.inf)


def chi_squared(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """A sum of `freedom` squared normal numbers exceeds it with probability `level`."""
    level, freedom = _numbers(level, freedom)
    x = -jnp.log(jnp.clip(level, 1e-300, 1.0))
    # a bound that is exceeded less often (Laurent and Massart 2000)
    most = freedom + 2 * jnp.sqrt(freedom * x) + 2 * x + 1
    beyond = lambda x: gammaincc(freedom / 2, x / 2) <= level
    return _bisect(beyond, most)


def chi_squared_bounds(level: ArrayLike, freedom: ArrayLike) -> tuple[Scalar, Scalar]:
    """Two-sided: a sum of `freedom` squared normal numbers lies below the first with
    probability `level` / 2, and above the second with the same probability."""
    half, freedom = jnp.asarray(level, float) / 2, jnp.asarray(freedom, float)
    beyond = lambda x: gammainc(freedom / 2, x / 2) >= half
    most = jnp.zeros_like(half) + freedom
    low = _bisect(beyond, most)
    return low, chi_squared(half, freedom)


def fisher(level: ArrayLike, above: ArrayLike, below: ArrayLike) -> Scalar:
    """F exceeds it with probability `level`; `above`: degrees of freedom of the
    numerator, `below`: of the denominator."""
    level, above, below = _numbers(level, above, below)
    # P(F > x) = I_y(below/2, above/2) at y = below / (below + above x)
    one = jnp.ones_like(level * above * below)
    beyond = lambda y: betainc(below / 2 * one, above / 2 * one, y) > level
    y = _bisect(beyond, one)
    return below / above * (1 - y) / y


def half_width(confidence: ArrayLike, freedom: ArrayLike) -> Scalar:
    """Half the width of the interval that holds a normal number with probability
    `confidence`, in standard deviations estimated with `freedom` degrees of freedom:
    Student's t. Infinite without a degree of freedom."""
    freedom = jnp.asarray(freedom, float)
    level = (1 - jnp.asarray(confidence, float)) / 2
    t = student(level, jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 0, t, jnp.inf)


def radius(confidence: ArrayLike, numbers: int, freedom: ArrayLike) -> Scalar:
    """Radius of the region that holds `numbers` normal numbers together with
    probability `confidence`, in standard deviations estimated with `freedom` degrees of
    freedom: sqrt(numbers F). Infinite without a degree of freedom."""
    freedom = jnp.asarray(freedom, float)
    f = fisher(1 - jnp.asarray(confidence, float), numbers, jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 0, jnp.sqrt(numbers * f), jnp.inf)


def grubbs(level: ArrayLike, count: ArrayLike) -> Scalar:
    """One-sided: (mean - smallest) / S of a sample of `count` = n normal numbers
    exceeds it with probability `level`; S² is the mean of the squared deviations, as in
    eq. (9) of Burshtynskaya and Dorozhinsky (1989):

        v = G sqrt(n / (n - 1)),    G = (n - 1) / sqrt(n) sqrt(t² / (n - 2 + t²)),

    t of level / n with n - 2 degrees of freedom. Infinite for n below 3.
    """
    n = jnp.asarray(count, float)
    t = student(jnp.asarray(level, float) / n, jnp.maximum(n - 2, 1.0))
    square = t**2
    g = (n - 1) / jnp.sqrt(n) * jnp.sqrt(square / (n - 2 + square))
    v = g * jnp.sqrt(n / (n - 1))
    return jnp.where(n > 2, v, jnp.inf)


def sidak(level: ArrayLike, count: ArrayLike) -> Scalar:
    """The level of each of `count` independent tests that together reject with
    probability `level` (Šidák 1967)."""
    level, count = _numbers(level, count)
    return -jnp.expm1(jnp.log1p(-level) / jnp.maximum(count, 1.0))


def delta_normal(level: ArrayLike, power: ArrayLike) -> Scalar:
    """The error that the two-sided normal test finds with probability `power`, in
    standard deviations (Baarda 1968): delta with

        P(|z + delta| > k) = power,    k = normal(level),

    which is k + ndtri(power) but for the far tail.
    """
    limit, power = normal(level), jnp.asarray(power, float)
    found = lambda x: ndtr(x - limit) + ndtr(-x - limit) >= power
    return _bisect(found, limit + jnp.abs(ndtri(power)) + 1)


def delta_student(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The error that a two-sided t test with `freedom` degrees of freedom finds with
    probability `power`, in true standard deviations. It replaces `delta_normal` where
    sigma is estimated."""
    freedom, power = _numbers(freedom, power)
    limit = student(jnp.asarray(level, float) / 2, freedom)
    # s exceeds 1 + 9 / sqrt(f) hardly ever
    most = limit * (1 + 9 / jnp.sqrt(freedom)) + jnp.abs(ndtri(power)) + 1
    found = lambda x: student_power(limit, freedom, x) >= power
    return _bisect(found, most, FEWER_HALVINGS)


def delta_chi_squared(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The root of the non-centrality at which the chi-squared test of this level
    rejects with probability `power`."""
    freedom, power = _numbers(freedom, power)
    limit = chi_squared(level, freedom)
    most = jnp.sqrt(limit) + jnp.abs(ndtri(power)) + 1
    found = lambda x: chi_squared_power(limit, freedom, x) >= power
    return _bisect(found, most, FEWER_HALVINGS)


def b_method(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The level at which the global chi-squared test finds an error with the same
    `power` as the test of its point at `level` does (the B-method of testing, Baarda
    1968)."""
    freedom = jnp.asarray(freedom, float)
    delta, power = delta_normal(level, power), jnp.asarray(power, float)
    mean = freedom + delta**2
    most = mean + 20 * jnp.sqrt(mean) + 60
    missed = lambda x: chi_squared_power(x, freedom, delta) <= power
    limit = _bisect(missed, most, FEWER_HALVINGS)
    return gammaincc(freedom / 2, limit / 2)


def chi_squared_power(limit: ArrayLike, freedom: ArrayLike, delta: ArrayLike) -> Scalar:
    """P((z1 + delta)² + z2² + ... > limit), `freedom` terms: the non-central
    chi-squared distribution, delta² = lambda.

    Integrated over u = z1 + delta = sqrt(limit) sin a, in which the rest is smooth; the
    sign of u is taken into account by its density.
    """
    numbers = _numbers(limit, freedom, delta)
    limit, freedom, delta = jnp.broadcast_arrays(*numbers)
    root = jnp.sqrt(limit)
    safe = jnp.where(root > 0, root, 1.0)
    rest = jnp.where(freedom > 1, (freedom - 1) / 2, 1.0)[..., None]
    angle_of = lambda u: jnp.arcsin(jnp.clip(u / safe, 0.0, 1.0))
    angle, weight = _nodes(angle_of(delta - WINDOW), angle_of(delta + WINDOW))
    u = safe[..., None] * jnp.sin(angle)
    across = safe[..., None] * jnp.cos(angle)
    density = _folded_density(u, delta[..., None])
    inside = _sum(weight * across * density * gammaincc(rest, across**2 / 2))
    first_alone = ndtr(delta - root) + ndtr(-delta - root)
    return first_alone + jnp.where((freedom > 1) & (root > 0), inside, 0.0)


def student_power(limit: ArrayLike, freedom: ArrayLike, delta: ArrayLike) -> Scalar:
    """P(|z + delta| > limit s), f s² chi-squared with f = `freedom`: the non-central t
    distribution.

    Integrated over z + delta if the limit scatters more than this, else over s: the
    other factor under the integral is then smooth.
    """
    numbers = _numbers(limit, freedom, delta)
    limit, freedom, delta = jnp.broadcast_arrays(*numbers)
    f, t, d = freedom[..., None], limit[..., None], delta[..., None]

    u, weight = _nodes(jnp.maximum(delta - WINDOW, 0.0), delta + WINDOW)
    rejected = gammainc(f / 2, f * (u / t) ** 2 / 2)
    over_z = _sum(weight * _folded_density(u, d) * rejected)

    width = WINDOW / jnp.sqrt(2 * freedom)
    s, weight = _nodes(jnp.maximum(1 - width, 0.0), 1 + width)
    half = f / 2
    constant = half * jnp.log(half) - gammaln(half)
    exponent = constant + (f - 1) * jnp.log(s) - half * s**2
    density = 2 * jnp.exp(exponent)
    rejected = ndtr(d - t * s) + ndtr(-d - t * s)
    over_s = _sum(weight * density * rejected)
    return jnp.where(limit > jnp.sqrt(freedom), over_z, over_s)


def student_p(t: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The probability that |t| is larger by chance; `freedom` is broadcast to t."""
    t = jnp.asarray(t)
    f = jnp.broadcast_to(jnp.where(jnp.asarray(freedom) > 0, freedom, 1.0), t.shape)
    return betainc(f / 2, jnp.full_like(t, 0.5), f / (f + t**2))


def by_count(
    value: Callable[[Array], Scalar], most: int, count: Float[Array, ""]
) -> Float[Array, ""]:
    """value(count) for a count of 0 to `most` that is known only at run time, from a
    table that is computed while tracing."""
    with jax.ensure_compile_time_eval():
        table = value(jnp.asarray(counts(most)))
    return look_up(table, count)


def counts(most: int) -> Float[np.ndarray, " entry"]:
    """The counts of a table for 0 to `most`: all up to `EACH`, then `DENSITY` an
    octave, with room for the cubics of `look_up`."""
    each = np.arange(min(most, EACH) + 1.0)
    octaves = np.log2(max(most, EACH) / EACH)
    if not octaves:
        return each
    steps = np.arange(-1, octaves * DENSITY + 2)
    return np.concatenate([each, EACH * 2 ** (steps / DENSITY)])


def look_up(table: ArrayLike, count: Float[Array, ""]) -> Float[Array, ""]:
    """The value at a count, from a table of the values at `counts`. Beyond `EACH` it is
    interpolated by Lagrange's cubic of the logarithm of the count, which is accurate to
    1e-8 for critical values of tests."""
    table = jnp.asarray(table)
    each, beyond = table[: EACH + 1], table[EACH + 1 :]
    own = jnp.arange(each.size) == count.astype(int)
    value = jnp.sum(jnp.where(own, each, 0.0))
    if not beyond.size:
        return value
    place = DENSITY * jnp.log2(jnp.maximum(count, 1.0) / EACH)
    away = jnp.abs(place - jnp.arange(-1.0, beyond.size - 1))
    outer = jnp.where(away < 2, (1 - away) * (2 - away) * (3 - away) / 6, 0.0)
    inner = (1 - away**2) * (2 - away) / 2
    cubic = jnp.where(away < 1, inner, outer)
    return jnp.where(count > EACH, jnp.sum(cubic * beyond), value)


def _bisect(
    reached: Callable[[Array], Array], most: Array, halvings: int = HALVINGS
) -> Scalar:
    """The x between 0 and `most` from which on `reached(x)` is true."""
    return bisect(reached, jnp.zeros_like(most), most, halvings)


def _numbers(*values: ArrayLike) -> list[Array]:
    """Arrays of the default precision."""
    return [jnp.asarray(value, float) for value in values]


def _nodes(low: Array, high: Array) -> tuple[Array, Array]:
    """Abscissae and weights of a Gauss-Legendre quadrature of each interval, on a new
    last axis."""
    half = ((high - low) / 2)[..., None]
    along_last = (1,) * low.ndim + (-1,)
    nodes, weights = NODES.reshape(along_last), WEIGHTS.reshape(along_last)
    return low[..., None] + half * (1 + nodes), half * weights


def _sum(values: Array) -> Array:
    return jnp.sum(values, axis=-1)


def _folded_density(u: Array, delta: Array) -> Array:
    """The density of |z + delta| at u >= 0, z normal."""
    density = lambda z: jnp.exp(-(z**2) / 2)
    both = density(u - delta) + density(u + delta)
    return both / np.sqrt(2 * np.pi)
