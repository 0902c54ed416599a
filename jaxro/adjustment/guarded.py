"""Arithmetic whose derivatives are finite where the value is zero or does not exist.

What `where` selects away still meets its derivative backwards: 0 times an infinite or
unknown one is NaN.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool


def root(square: Array, there: Bool[Array, "..."] | bool = True) -> Array:
    """The square root, zero where the square is not positive or not `there`; with
    finite derivatives. NaN of NaN."""
    there = ~(square <= 0) & there
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)


def ratio(a: ArrayLike, b: ArrayLike, there: Bool[Array, "..."]) -> Array:
    """a / b, zero where not `there`; with finite derivatives."""
    return jnp.where(there, a / jnp.where(there, b, 1.0), 0.0)


def times(values: ArrayLike, unit: ArrayLike) -> Array:
    """The product, NaN where the unit is, as sigma0 is without redundancy; with finite
    derivatives by the values."""
    known = ~jnp.isnan(unit)
    return jnp.where(known, jnp.asarray(values) * jnp.where(known, unit, 0.0), jnp.nan)
