"""Probabilities that a statistic of a test is larger by chance. Arguments may be arrays
that broadcast together; works under jit and vmap."""

import jax.numpy as jnp
from jax.scipy.special import betainc, gammaincc
from jaxtyping import Array, ArrayLike, Float


def fisher_p(f: ArrayLike, above: ArrayLike, below: ArrayLike) -> Float[Array, "..."]:
    """That F with `above` degrees of freedom of the numerator and `below` of the
    denominator is larger than `f`; NaN where one of them is not positive."""
    f, a, b = (jnp.asarray(value, float) for value in (f, above, below))
    there = (a > 0) & (b > 0) & (f >= 0)
    a, b, f = (jnp.where(there, value, 1.0) for value in (a, b, f))
    return jnp.where(there, betainc(b / 2, a / 2, b / (b + a * f)), jnp.nan)


def chi_squared_p(squares: ArrayLike, freedom: ArrayLike) -> Float[Array, "..."]:
    """That a sum of `freedom` squared normal numbers is larger than `squares`; NaN
    without a degree of freedom."""
    x, f = jnp.asarray(squares, float), jnp.asarray(freedom, float)
    there = (f > 0) & (x >= 0)
    x, f = jnp.where(there, x, 1.0), jnp.where(there, f, 1.0)
    return jnp.where(there, gammaincc(f / 2, x / 2), jnp.nan)
