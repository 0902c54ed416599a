"""Critical values of the tests on residuals, by formula; all work under jit.

`level` is the probability that a test without any error rejects: of one point, or of a whole pair where the docstring
says so.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import betainc, gammaincc, ndtri
from jaxtyping import Array, ArrayLike, Float

Scalar = Float[Array, "..."]

BISECTIONS = 120
"""Halvings of an interval: to the last bit of a double even near zero."""


def normal(level: ArrayLike) -> Scalar:
    """Two-sided: |w| exceeds it with probability `level` (Baarda's w)."""
    return -ndtri(jnp.asarray(level, float) / 2)


def student(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """One-sided: t with `freedom` degrees of freedom exceeds it with probability `level`, at most one half."""
    level, freedom = jnp.asarray(level, float), jnp.asarray(freedom, float)
    # P(T > t) = I_x(f/2, 1/2) / 2 at x = f / (f + t²): found by bisection, since the inverse has no closed form
    x = _where(lambda x: betainc(freedom / 2, 0.5, x) / 2 > level, jnp.ones_like(level * freedom), increasing=True)
    return jnp.sqrt(freedom * (1 - x) / x)


def tau(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """Two-sided, of a residual over its estimated standard deviation (Pope 1976): sqrt(f) t / sqrt(f - 1 + t²), with t
    of f - 1 degrees of freedom. With one degree of freedom every residual has tau = 1, and nothing can be rejected."""
    freedom = jnp.asarray(freedom, float)
    t = student(jnp.asarray(level, float) / 2, jnp.maximum(freedom - 1, 1.0))
    value = jnp.sqrt(freedom) * t / jnp.sqrt(freedom - 1 + t * t)
    return jnp.where(freedom > 1, value, jnp.inf)


def chi_squared(level: ArrayLike, freedom: ArrayLike) -> Scalar:
    """A sum of `freedom` squared normal numbers exceeds it with probability `level`."""
    level, freedom = jnp.asarray(level, float), jnp.asarray(freedom, float)
    most = jnp.zeros_like(level) + freedom + 20 * jnp.sqrt(freedom) + 60
    return _where(lambda x: gammaincc(freedom / 2, x / 2) > level, most, increasing=False)


def grubbs(level: ArrayLike, count: ArrayLike) -> Scalar:
    """One-sided, of (mean - smallest) / S of a normal sample, S over n as in eq. (9) of 1989:

    v = G sqrt(n/(n-1)),    G = (n-1)/sqrt(n) sqrt(t²/(n-2+t²)),    t of level/n with n - 2 degrees of freedom.
    """
    n = jnp.asarray(count, float)
    t = student(jnp.asarray(level, float) / n, jnp.maximum(n - 2, 1.0))
    g = (n - 1) / jnp.sqrt(n) * jnp.sqrt(t**2 / (n - 2 + t**2))
    return jnp.where(n > 2, g * jnp.sqrt(n / (n - 1)), jnp.inf)


def by_count(value: Callable[[Array], Scalar], most: int, count: Float[Array, ""]) -> Float[Array, ""]:
    """value(count) for a count of 0 to `most` that is known only at run time: looked up, not calculated again."""
    with jax.ensure_compile_time_eval():
        table = value(jnp.arange(most + 1.0))
    here = jnp.arange(most + 1) == count.astype(int)
    return jnp.sum(jnp.where(here, table, 0.0))


def _where(above: Callable[[Array], Array], most: Array, increasing: bool) -> Scalar:
    """The x in (0, most) at which `above` changes, by bisection."""

    def halved(_, interval):
        low, high = interval
        middle = (low + high) / 2
        down = above(middle) == increasing
        return jnp.where(down, low, middle), jnp.where(down, middle, high)

    low, high = lax.fori_loop(0, BISECTIONS, halved, (jnp.zeros_like(most), most))
    return (low + high) / 2
