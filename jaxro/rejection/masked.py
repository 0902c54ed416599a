"""Sums over the points in use, and choices between results."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..xla.passes import count, total

Values = Float[Array, "*pairs point"]
Use = Bool[Array, "*pairs point"]


def sum_of(values: Values, use: Use) -> Float[Array, "*pairs"]:
    """Sum over the points in use."""
    return total(jnp.where(use, values, 0.0))


def mean_of(values: Values, use: Use) -> Float[Array, "*pairs"]:
    """Mean over the points in use; zero if there are none."""
    return sum_of(values, use) / jnp.maximum(count(use), 1.0)


def choose(condition: Bool[Array, ""], one: PyTree, other: PyTree) -> PyTree:
    """The one tree if the condition holds, else the other."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)
