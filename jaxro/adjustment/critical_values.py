"""Critical values of the tests on residuals, and the errors that these tests can find.

`level` is the probability that a test rejects although there is no error. `power` is
the probability that it rejects when there is an error, and `delta` the size of this
error in standard deviations of the statistic (the root of Baarda's non-centrality
lambda). `freedom` are degrees of freedom.

Quantiles without a closed form are found by bisection of the distribution, powers by
quadrature. All arguments may be arrays that broadcast together. Values that are known
are computed by NumPy and SciPy, so that no program is compiled for a constant; under
jit and vmap the same formulas run in JAX.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..xla.programs import is_traced
from .bisection import Numbers, bisect

Given = Any
"""A number or an array, known or traced: `ArrayLike`, which the type checker does not
let go of when it becomes an array."""

Scalar = Float[Numbers, "..."]

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

SILENT = np.errstate(all="ignore")
"""Infinite values are meant, as they are in JAX."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(96)


def normal(level: Given) -> Scalar:
    """Two-sided: |w| of a normal number w exceeds it with probability `level` (Baarda
    1968)."""
    _, special, level = _numbers(level)
    return -special.ndtri(level / 2)


@SILENT
def student(level: Given, freedom: Given) -> Scalar:
    """One-sided: t with `freedom` degrees of freedom exceeds it with probability
    `level`, at most one half."""
    xp, special, level, freedom = _numbers(level, freedom)
    # P(T > t) = I_x(f/2, 1/2) / 2 at x = f / (f + t²)
    beyond = lambda x: special.betainc(freedom / 2, 0.5, x) / 2 > level
    one = xp.ones_like(level * freedom)
    x = _bisect(beyond, one)
    return xp.sqrt(freedom * (1 - x) / x)


@SILENT
def tau(level: Given, freedom: Given) -> Scalar:
    """Two-sided: a residual over its estimated standard deviation exceeds it with
    probability `level` (Pope 1976):

        tau = sqrt(f) t / sqrt(f - 1 + t²),    t of f - 1 degrees of freedom.

    Infinite with one degree of freedom, where every residual has tau = 1.
    """
    xp, _, level, freedom = _numbers(level, freedom)
    others = freedom - 1
    t = student(level / 2, xp.maximum(others, 1.0))
    value = xp.sqrt(freedom) * t / xp.sqrt(others + t * t)
    return xp.where(freedom > 1, value, xp.inf)


def chi_squared(level: Given, freedom: Given) -> Scalar:
    """A sum of `freedom` squared normal numbers exceeds it with probability `level`."""
    xp, special, level, freedom = _numbers(level, freedom)
    x = -xp.log(xp.clip(level, 1e-300, 1.0))
    # a bound that is exceeded less often (Laurent and Massart 2000)
    most = freedom + 2 * xp.sqrt(freedom * x) + 2 * x + 1
    beyond = lambda x: special.gammaincc(freedom / 2, x / 2) <= level
    return _bisect(beyond, most)


def chi_squared_bounds(level: Given, freedom: Given) -> tuple[Scalar, Scalar]:
    """Two-sided: a sum of `freedom` squared normal numbers lies below the first with
    probability `level` / 2, and above the second with the same probability."""
    xp, special, level, freedom = _numbers(level, freedom)
    half = level / 2
    beyond = lambda x: special.gammainc(freedom / 2, x / 2) >= half
    most = xp.zeros_like(half) + freedom
    low = _bisect(beyond, most)
    return low, chi_squared(half, freedom)


@SILENT
def fisher(level: Given, above: Given, below: Given) -> Scalar:
    """F exceeds it with probability `level`; `above`: degrees of freedom of the
    numerator, `below`: of the denominator."""
    xp, special, level, above, below = _numbers(level, above, below)
    # P(F > x) = I_y(below/2, above/2) at y = below / (below + above x)
    one = xp.ones_like(level * above * below)
    beyond = lambda y: special.betainc(below / 2 * one, above / 2 * one, y) > level
    y = _bisect(beyond, one)
    return below / above * (1 - y) / y


def half_width(confidence: Given, freedom: Given) -> Scalar:
    """Half the width of the interval that holds a normal number with probability
    `confidence`, in standard deviations estimated with `freedom` degrees of freedom:
    Student's t. Infinite without a degree of freedom."""
    xp, _, confidence, freedom = _numbers(confidence, freedom)
    t = student((1 - confidence) / 2, xp.maximum(freedom, 1.0))
    return xp.where(freedom > 0, t, xp.inf)


def radius(confidence: Given, numbers: int, freedom: Given) -> Scalar:
    """Radius of the region that holds `numbers` normal numbers together with
    probability `confidence`, in standard deviations estimated with `freedom` degrees of
    freedom: sqrt(numbers F). Infinite without a degree of freedom."""
    xp, _, confidence, freedom = _numbers(confidence, freedom)
    f = fisher(1 - confidence, numbers, xp.maximum(freedom, 1.0))
    return xp.where(freedom > 0, xp.sqrt(numbers * f), xp.inf)


@SILENT
def grubbs(level: Given, count: Given) -> Scalar:
    """One-sided: (mean - smallest) / S of a sample of `count` = n normal numbers
    exceeds it with probability `level`; S² is the mean of the squared deviations, as in
    eq. (9) of Burshtynskaya and Dorozhinsky (1989):

        v = G sqrt(n / (n - 1)),    G = (n - 1) / sqrt(n) sqrt(t² / (n - 2 + t²)),

    t of level / n with n - 2 degrees of freedom. Infinite for n below 3.
    """
    xp, _, level, n = _numbers(level, count)
    t = student(level / n, xp.maximum(n - 2, 1.0))
    square = t**2
    g = (n - 1) / xp.sqrt(n) * xp.sqrt(square / (n - 2 + square))
    v = g * xp.sqrt(n / (n - 1))
    return xp.where(n > 2, v, xp.inf)


def sidak(level: Given, count: Given) -> Scalar:
    """The level of each of `count` independent tests that together reject with
    probability `level` (Šidák 1967)."""
    xp, _, level, count = _numbers(level, count)
    return -xp.expm1(xp.log1p(-level) / xp.maximum(count, 1.0))


def delta_normal(level: Given, power: Given) -> Scalar:
    """The error that the two-sided normal test finds with probability `power`, in
    standard deviations (Baarda 1968): delta with

        P(|z + delta| > k) = power,    k = normal(level),

    which is k + ndtri(power) but for the far tail.
    """
    xp, special, limit, power = _numbers(normal(level), power)
    found = lambda x: special.ndtr(x - limit) + special.ndtr(-x - limit) >= power
    return _bisect(found, limit + xp.abs(special.ndtri(power)) + 1)


def delta_student(level: Given, power: Given, freedom: Given) -> Scalar:
    """The error that a two-sided t test with `freedom` degrees of freedom finds with
    probability `power`, in true standard deviations. It replaces `delta_normal` where
    sigma is estimated."""
    xp, special, level, power, freedom = _numbers(level, power, freedom)
    limit = student(level / 2, freedom)
    # s exceeds 1 + 9 / sqrt(f) hardly ever
    most = limit * (1 + 9 / xp.sqrt(freedom)) + xp.abs(special.ndtri(power)) + 1
    found = lambda x: student_power(limit, freedom, x) >= power
    return _bisect(found, most, FEWER_HALVINGS)


def delta_chi_squared(level: Given, power: Given, freedom: Given) -> Scalar:
    """The root of the non-centrality at which the chi-squared test of this level
    rejects with probability `power`."""
    xp, special, level, power, freedom = _numbers(level, power, freedom)
    limit = chi_squared(level, freedom)
    most = xp.sqrt(limit) + xp.abs(special.ndtri(power)) + 1
    found = lambda x: chi_squared_power(limit, freedom, x) >= power
    return _bisect(found, most, FEWER_HALVINGS)


def b_method(level: Given, power: Given, freedom: Given) -> Scalar:
    """The level at which the global chi-squared test finds an error with the same
    `power` as the test of its point at `level` does (the B-method of testing, Baarda
    1968)."""
    xp, special, level, power, freedom = _numbers(level, power, freedom)
    delta = delta_normal(level, power)
    mean = freedom + delta**2
    most = mean + 20 * xp.sqrt(mean) + 60
    missed = lambda x: chi_squared_power(x, freedom, delta) <= power
    limit = _bisect(missed, most, FEWER_HALVINGS)
    return special.gammaincc(freedom / 2, limit / 2)


@SILENT
def chi_squared_power(limit: Given, freedom: Given, delta: Given) -> Scalar:
    """P((z1 + delta)² + z2² + ... > limit), `freedom` terms: the non-central
    chi-squared distribution, delta² = lambda.

    Integrated over u = z1 + delta = sqrt(limit) sin a, in which the rest is smooth; the
    sign of u is taken into account by its density.
    """
    xp, special, *numbers = _numbers(limit, freedom, delta)
    x, f, d = xp.broadcast_arrays(*numbers)
    root = xp.sqrt(x)
    safe = xp.where(root > 0, root, 1.0)
    rest = xp.where(f > 1, (f - 1) / 2, 1.0)[..., None]
    angle_of = lambda u: xp.arcsin(xp.clip(u / safe, 0.0, 1.0))
    angle, weight = _nodes(angle_of(d - WINDOW), angle_of(d + WINDOW))
    u = safe[..., None] * xp.sin(angle)
    across = safe[..., None] * xp.cos(angle)
    density = _folded_density(u, d[..., None])
    outside = special.gammaincc(rest, across**2 / 2)
    inside = xp.sum(weight * across * density * outside, axis=-1)
    first_alone = special.ndtr(d - root) + special.ndtr(-d - root)
    return first_alone + xp.where((f > 1) & (root > 0), inside, 0.0)


@SILENT
def student_power(limit: Given, freedom: Given, delta: Given) -> Scalar:
    """P(|z + delta| > limit s), f s² chi-squared with f = `freedom`: the non-central t
    distribution.

    Integrated over z + delta if the limit scatters more than this, else over s: the
    other factor under the integral is then smooth.
    """
    xp, special, *numbers = _numbers(limit, freedom, delta)
    t, f, d = xp.broadcast_arrays(*numbers)
    by_s = t <= xp.sqrt(f)
    u, weight = _nodes(xp.maximum(d - WINDOW, 0.0), d + WINDOW)
    width = WINDOW / xp.sqrt(2 * f)
    s, weight_of_s = _nodes(xp.maximum(1 - width, 0.0), 1 + width)
    t, f, d = t[..., None], f[..., None], d[..., None]

    rejected = special.gammainc(f / 2, f * (u / t) ** 2 / 2)
    over_z = xp.sum(weight * _folded_density(u, d) * rejected, axis=-1)

    half = f / 2
    constant = half * xp.log(half) - special.gammaln(half)
    exponent = constant + (f - 1) * xp.log(s) - half * s**2
    density = 2 * xp.exp(exponent)
    rejected = special.ndtr(d - t * s) + special.ndtr(-d - t * s)
    over_s = xp.sum(weight_of_s * density * rejected, axis=-1)
    return xp.where(by_s, over_s, over_z)


def student_p(t: Given, freedom: Given) -> Scalar:
    """The probability that |t| is larger by chance; `freedom` is broadcast to t."""
    xp, special, x, f = _numbers(t, freedom)
    f = xp.broadcast_to(xp.where(f > 0, f, 1.0), x.shape)
    return special.betainc(f / 2, xp.full_like(x, 0.5), f / (f + x**2))


def global_p(squares: Given, freedom: Given) -> Scalar:
    """Two-sided: the probability that a sum of `freedom` squared normal numbers is
    further out than `squares`."""
    xp, special, squares, freedom = _numbers(squares, freedom)
    below = special.gammainc(freedom / 2, squares / 2)
    above = special.gammaincc(freedom / 2, squares / 2)
    return xp.where(below < above, 2 * below, 2 * above)


BEYOND_CHANCE = 0.001
"""Probability of a sigma0 below which the given standard deviations are too small."""


def trusted_sigma0(sigma0: Given, freedom: Given) -> Scalar:
    """What given standard deviations are multiplied with: 1 unless the estimated sigma0
    is larger than chance allows, as few degrees of freedom tell less of it than these
    do."""
    xp, _, sigma0, freedom = _numbers(sigma0, freedom)
    some = xp.maximum(freedom, 1.0)
    larger = (freedom > 0) & (sigma0 > 1)
    chance = global_p(some * sigma0**2, some)
    return xp.where(larger & (chance < BEYOND_CHANCE), sigma0, 1.0)


def fisher_p(f: Given, above: Given, below: Given) -> Scalar:
    """The probability that F with `above` degrees of freedom of the numerator and
    `below` of the denominator is larger than `f`; NaN where one of them is not
    positive."""
    xp, special, f, a, b = _numbers(f, above, below)
    there = (a > 0) & (b > 0) & (f >= 0)
    a, b, f = (xp.where(there, value, 1.0) for value in (a, b, f))
    return xp.where(there, special.betainc(b / 2, a / 2, b / (b + a * f)), xp.nan)


def chi_squared_p(squares: Given, freedom: Given) -> Scalar:
    """The probability that a sum of `freedom` squared normal numbers is larger than
    `squares`; NaN without a degree of freedom."""
    xp, special, x, f = _numbers(squares, freedom)
    there = (f > 0) & (x >= 0)
    x, f = xp.where(there, x, 1.0), xp.where(there, f, 1.0)
    return xp.where(there, special.gammaincc(f / 2, x / 2), xp.nan)


def by_count(
    value: Callable[[np.ndarray], Scalar], most: int, count: Float[Array, ""]
) -> Float[Array, ""]:
    """value(count) for a count of 0 to `most` that is known only at run time, from a
    table that is computed by NumPy while tracing."""
    return look_up(value(counts(most)), count)


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
    reached: Callable[[Any], Any], most: Numbers, halvings: int = HALVINGS
) -> Scalar:
    """The x between 0 and `most` from which on `reached(x)` is true."""
    return bisect(reached, 0 * most, most, halvings)


def _numbers(*values: ArrayLike) -> tuple[Any, ...]:
    """The library of arrays, that of special functions, and the values as its arrays:
    NumPy and SciPy where all values are known, JAX where any is traced."""
    if is_traced(values):
        from jax.scipy import special

        return jnp, special, *(jnp.asarray(value, float) for value in values)
    from scipy import special  # not needed by those who only want a pose

    return np, special, *(np.asarray(value, float) for value in values)


def _nodes(low: Any, high: Any) -> tuple[Any, Any]:
    """Abscissae and weights of a Gauss-Legendre quadrature of each interval, on a new
    last axis."""
    half = ((high - low) / 2)[..., None]
    along_last = (1,) * low.ndim + (-1,)
    nodes, weights = NODES.reshape(along_last), WEIGHTS.reshape(along_last)
    return low[..., None] + half * (1 + nodes), half * weights


def _folded_density(u: Any, delta: Any) -> Any:
    """The density of |z + delta| at u >= 0, z normal."""
    xp, _, u, delta = _numbers(u, delta)
    density = lambda z: xp.exp(-(z**2) / 2)
    both = density(u - delta) + density(u + delta)
    return both / np.sqrt(2 * np.pi)
