"""Critical values of the tests on residuals and what these tests can find, by formula;
all work under jit.

`level` is the probability that a test without any error rejects: of one point, or of a
whole pair where the docstring says so. `power` is the probability that it rejects when
there is an error; `delta` is the size of an error in standard deviations of the
statistic (Baarda's square root of lambda, the non-centrality).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import betainc, gammainc, gammaincc, gammaln, ndtr, ndtri
from jaxtyping import Array, ArrayLike, Float

Scalar = Float[Array, "..."]

BISECTIONS = 120
"""Halvings of an interval: to the last bit of a double even near zero."""

FEWER = 60
"""The same for what is nowhere near zero, and takes a quadrature each."""

WINDOW = 9.0
"""Standard deviations of a normal number outside which it is not looked for: 1e-19."""

EACH, DENSITY = 64, 32
"""Of tables by counts of points: up to which every count has an entry, and how many an
octave has beyond."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(96)


def normal(level: ArrayLike) -> Scalar:
    """Two-sided: |w| exceeds it with probability `level` (Baarda's w)."""
    return -ndtri(jnp.asarray(level, float) / 2)


def student(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """One-sided: t with `freedom` degrees of freedom exceeds it with probability
    `level`, at most one half."""
    level, freedom = jnp.asarray(level, float), jnp.asarray(freedom, float)
    # P(T > t) = I_x(f/2, 1/2) / 2 at x = f / (f + t²): found by bisection, since the
    # inverse has no closed form
    x = _where(
        lambda x: betainc(freedom / 2, 0.5, x) / 2 > level,
        jnp.ones_like(level * freedom),
        increasing=True,
    )
    return jnp.sqrt(freedom * (1 - x) / x)


def tau(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """Two-sided, of a residual over its estimated standard deviation (Pope 1976):
    sqrt(f) t / sqrt(f - 1 + t²), with t of f - 1 degrees of freedom. With one degree of
    freedom every residual has tau = 1, and nothing can be rejected."""
    freedom = jnp.asarray(freedom, float)
    t = student(jnp.asarray(level, float) / 2, jnp.maximum(freedom - 1, 1.0))
    value = jnp.sqrt(freedom) * t / jnp.sqrt(freedom - 1 + t * t)
    return jnp.where(freedom > 1, value, jnp.inf)


def chi_squared(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """A sum of `freedom` squared normal numbers exceeds it with probability `level`."""
    level, freedom = jnp.asarray(level, float), jnp.asarray(freedom, float)
    x = -jnp.log(jnp.clip(level, 1e-300, 1.0))
    # it exceeds this less often (Laurent and Massart 2000)
    most = freedom + 2 * jnp.sqrt(freedom * x) + 2 * x + 1
    return _where(
        lambda x: gammaincc(freedom / 2, x / 2) > level, most, increasing=False
    )


def chi_squared_bounds(level: ArrayLike, freedom: ArrayLike) -> tuple[Scalar, Scalar]:
    """Two-sided: a sum of `freedom` squared normal numbers lies below, or above, these
    with probability `level` / 2."""
    half, freedom = jnp.asarray(level, float) / 2, jnp.asarray(freedom, float)
    low = _where(
        lambda x: gammainc(freedom / 2, x / 2) < half,
        jnp.zeros_like(half) + freedom,
        increasing=False,
    )
    return low, chi_squared(half, freedom)


def fisher(level: ArrayLike, above: ArrayLike, below: ArrayLike) -> Scalar:
    """F of `above` and `below` degrees of freedom (numerator, denominator) exceeds it
    with probability `level`."""
    level, above, below = (jnp.asarray(a, float) for a in (level, above, below))
    # P(F > x) = I_y(below/2, above/2) at y = below / (below + above x)
    most = jnp.ones_like(level * above * below)
    y = _where(
        lambda y: betainc(below / 2 * most, above / 2 * most, y) > level,
        most,
        increasing=True,
    )
    return below / above * (1 - y) / y


def half_width(confidence: ArrayLike, freedom: ArrayLike) -> Scalar:
    """Of the interval that holds a normal number with probability `confidence`, in
    standard deviations estimated with `freedom` degrees of freedom: Student's t;
    infinite without any."""
    freedom = jnp.asarray(freedom, float)
    t = student((1 - jnp.asarray(confidence, float)) / 2, jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 0, t, jnp.inf)


def radius(confidence: ArrayLike, numbers: int, freedom: ArrayLike) -> Scalar:
    """Of the region that holds so many normal `numbers` together, in standard
    deviations estimated with `freedom` degrees of freedom: sqrt(numbers F); infinite
    without any."""
    freedom = jnp.asarray(freedom, float)
    f = fisher(1 - jnp.asarray(confidence, float), numbers, jnp.maximum(freedom, 1.0))
    return jnp.where(freedom > 0, jnp.sqrt(numbers * f), jnp.inf)


def grubbs(level: ArrayLike, count: ArrayLike) -> Scalar:
    """One-sided, of (mean - smallest) / S of a normal sample, S over n as in eq. (9) of
    1989:

    v = G sqrt(n/(n-1)),    G = (n-1)/sqrt(n) sqrt(t²/(n-2+t²)),

    t of level/n with n - 2 degrees of freedom.
    """
    n = jnp.asarray(count, float)
    t = student(jnp.asarray(level, float) / n, jnp.maximum(n - 2, 1.0))
    g = (n - 1) / jnp.sqrt(n) * jnp.sqrt(t**2 / (n - 2 + t**2))
    return jnp.where(n > 2, g * jnp.sqrt(n / (n - 1)), jnp.inf)


def sidak(level: ArrayLike, count: ArrayLike) -> Scalar:
    """The level of each of `count` independent tests that together reject with
    probability `level` (Šidák 1967)."""
    level, count = jnp.asarray(level, float), jnp.asarray(count, float)
    return -jnp.expm1(jnp.log1p(-level) / jnp.maximum(count, 1.0))


def delta_normal(level: ArrayLike, power: ArrayLike) -> Scalar:
    """The error that the two-sided normal test finds with probability `power`, in
    standard deviations (Baarda 1968):

    P(|z + delta| > k) = power,    nearly k + ndtri(power), from which it differs by the far tail.
    """
    limit, power = normal(level), jnp.asarray(power, float)
    missed = lambda x: ndtr(x - limit) + ndtr(-x - limit) < power
    return _where(missed, limit + jnp.abs(ndtri(power)) + 1, increasing=False)


def delta_student(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The error that a two-sided t test with `freedom` degrees of freedom finds with
    probability `power`, in true standard deviations: what takes the place of
    `delta_normal` where sigma itself is estimated."""
    freedom, power = jnp.asarray(freedom, float), jnp.asarray(power, float)
    limit = student(jnp.asarray(level, float) / 2, freedom)
    # s exceeds 1 + 9 / sqrt(f) hardly ever
    most = limit * (1 + 9 / jnp.sqrt(freedom)) + jnp.abs(ndtri(power)) + 1
    return _where(
        lambda x: student_power(limit, freedom, x) < power,
        most,
        increasing=False,
        halvings=FEWER,
    )


def delta_chi_squared(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The root of the non-centrality at which the chi-squared test of this level
    rejects with probability `power`."""
    freedom, power = jnp.asarray(freedom, float), jnp.asarray(power, float)
    limit = chi_squared(level, freedom)
    most = jnp.sqrt(limit) + jnp.abs(ndtri(power)) + 1
    return _where(
        lambda x: chi_squared_power(limit, freedom, x) < power,
        most,
        increasing=False,
        halvings=FEWER,
    )


def b_method(level: ArrayLike, power: ArrayLike, freedom: ArrayLike) -> Scalar:
    """The level of the global chi-squared test that finds an error of any one point as
    surely as the test of that point at `level` does: both with `power` at the same
    non-centrality (Baarda 1968, the B-method of testing)."""
    freedom = jnp.asarray(freedom, float)
    delta, power = delta_normal(level, power), jnp.asarray(power, float)
    most = freedom + delta**2 + 20 * jnp.sqrt(freedom + delta**2) + 60
    limit = _where(
        lambda x: chi_squared_power(x, freedom, delta) > power,
        most,
        increasing=False,
        halvings=FEWER,
    )
    return gammaincc(freedom / 2, limit / 2)


def chi_squared_power(limit: ArrayLike, freedom: ArrayLike, delta: ArrayLike) -> Scalar:
    """P((z1 + delta)² + z2² + ... > limit), `freedom` terms: the non-central
    chi-squared distribution, delta² = lambda.

    Integrated over u = z1 + delta = sqrt(limit) sin a, whatever its sign, in which the
    rest is smooth.
    """
    limit, freedom, delta = jnp.broadcast_arrays(
        *(jnp.asarray(a, float) for a in (limit, freedom, delta))
    )
    root = jnp.sqrt(limit)
    safe = jnp.where(root > 0, root, 1.0)
    rest = jnp.where(freedom > 1, (freedom - 1) / 2, 1.0)[..., None]
    low, high = (
        jnp.arcsin(jnp.clip((delta + side) / safe, 0.0, 1.0))
        for side in (-WINDOW, WINDOW)
    )
    angle, weight = _nodes(low, high)
    u, across = safe[..., None] * jnp.sin(angle), safe[..., None] * jnp.cos(angle)
    inside = _sum(
        weight * across * _either(u, delta[..., None]) * gammaincc(rest, across**2 / 2)
    )
    return (
        ndtr(delta - root)
        + ndtr(-delta - root)
        + jnp.where((freedom > 1) & (root > 0), inside, 0.0)
    )


def student_power(limit: ArrayLike, freedom: ArrayLike, delta: ArrayLike) -> Scalar:
    """P(|z + delta| > limit s), f s² chi-squared with f = `freedom`: the non-central t
    distribution.

    Integrated over z + delta where the limit scatters more than that, else over s, so
    that what stands under the integral is smooth.
    """
    limit, freedom, delta = jnp.broadcast_arrays(
        *(jnp.asarray(a, float) for a in (limit, freedom, delta))
    )
    f, t, d = freedom[..., None], limit[..., None], delta[..., None]
    u, weight = _nodes(jnp.maximum(delta - WINDOW, 0.0), delta + WINDOW)
    over_z = _sum(weight * _either(u, d) * gammainc(f / 2, f * (u / t) ** 2 / 2))
    width = WINDOW / jnp.sqrt(2 * freedom)
    s, weight = _nodes(jnp.maximum(1 - width, 0.0), 1 + width)
    density = (
        jnp.exp(
            f / 2 * jnp.log(f / 2)
            + (f - 1) * jnp.log(s)
            - f * s**2 / 2
            - gammaln(f / 2)
        )
        * 2
    )
    over_s = _sum(weight * density * (ndtr(d - t * s) + ndtr(-d - t * s)))
    return jnp.where(limit > jnp.sqrt(freedom), over_z, over_s)


def by_count(
    value: Callable[[Array], Scalar], most: int, count: Float[Array, ""]
) -> Float[Array, ""]:
    """value(count) for a count of 0 to `most` that is known only at run time: looked
    up, not calculated again."""
    with jax.ensure_compile_time_eval():
        table = value(jnp.asarray(counts(most)))
    return looked_up(table, count)


def counts(most: int) -> Float[np.ndarray, " entry"]:
    """The counts of a table for 0 to `most`: all up to `EACH`, then so dense that
    cubics join them."""
    each = np.arange(min(most, EACH) + 1.0)
    octaves = np.log2(max(most, EACH) / EACH)
    return np.concatenate(
        [each, EACH * 2 ** (np.arange(-1, octaves * DENSITY + 2) / DENSITY)]
        if octaves
        else [each]
    )


def looked_up(table: ArrayLike, count: Float[Array, ""]) -> Float[Array, ""]:
    """The value at a count, of a table of the values at `counts`; beyond `EACH` by
    Lagrange's cubic of its logarithm, which of the critical values of tests leaves an
    error below 1e-8."""
    table = jnp.asarray(table)
    each, beyond = table[: EACH + 1], table[EACH + 1 :]
    value = jnp.sum(jnp.where(jnp.arange(each.size) == count.astype(int), each, 0.0))
    if not beyond.size:
        return value
    away = jnp.abs(
        DENSITY * jnp.log2(jnp.maximum(count, 1.0) / EACH)
        - jnp.arange(-1.0, beyond.size - 1)
    )
    outer = jnp.where(away < 2, (1 - away) * (2 - away) * (3 - away) / 6, 0.0)
    cubic = jnp.where(away < 1, (1 - away**2) * (2 - away) / 2, outer)
    return jnp.where(count > EACH, jnp.sum(cubic * beyond), value)


def _where(
    above: Callable[[Array], Array],
    most: Array,
    increasing: bool,
    halvings: int = BISECTIONS,
) -> Scalar:
    """The x in (0, most) at which `above` changes, by bisection."""

    def halved(_, interval):
        low, high = interval
        middle = (low + high) / 2
        down = above(middle) == increasing
        return jnp.where(down, low, middle), jnp.where(down, middle, high)

    low, high = lax.fori_loop(0, halvings, halved, (jnp.zeros_like(most), most))
    return (low + high) / 2


def _nodes(low: Array, high: Array) -> tuple[Array, Array]:
    """Abscissae and weights of a Gauss-Legendre quadrature of each interval, on a new
    last axis."""
    half = ((high - low) / 2)[..., None]
    fixed = (1,) * low.ndim + (-1,)
    return low[..., None] + half * (1 + NODES.reshape(fixed)), half * WEIGHTS.reshape(
        fixed
    )


def _sum(values: Array) -> Array:
    return jnp.sum(values, axis=-1)


def _either(u: Array, delta: Array) -> Array:
    """The density of |z + delta| at u >= 0."""
    return (
        jnp.exp(-((u - delta) ** 2) / 2) + jnp.exp(-((u + delta) ** 2) / 2)
    ) / np.sqrt(2 * np.pi)
