"""The argument at which a condition begins to hold, by halving an interval.

For functions whose inverse has no closed form. It takes arrays, which are halved side
by side, and works under jit and vmap.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


def bisect(
    reached: Callable[[Array], Array], low: Array, high: Array, halvings: int
) -> Float[Array, "..."]:
    """The x between `low` and `high` from which on `reached(x)` is true, to the width
    of the interval over 2^(halvings + 1)."""

    def halve(_, interval):
        low, high = interval
        middle = (low + high) / 2
        there = reached(middle)
        return jnp.where(there, low, middle), jnp.where(there, middle, high)

    low, high = lax.fori_loop(0, halvings, halve, (low, high))
    return (low + high) / 2
