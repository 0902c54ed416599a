"""The argument at which a condition begins to hold, by halving an interval.

For functions whose inverse has no closed form. It takes arrays, which are halved side
by side: those of NumPy as they are, those of JAX also under jit and vmap.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

if TYPE_CHECKING:  # arrays of NumPy go wherever those of JAX go
    Numbers = Array
else:
    Numbers = Array | np.ndarray | np.floating


def bisect(
    reached: Callable, low: Any, high: Any, halvings: int
) -> Float[Numbers, "..."]:
    """The x between `low` and `high` from which on `reached(x)` is true, to the width
    of the interval over 2^(halvings + 1)."""
    by_jax = isinstance(low, jax.Array) or isinstance(high, jax.Array)
    xp = jnp if by_jax else np

    def halve(_, interval):
        low, high = interval
        middle = (low + high) / 2
        there = reached(middle)
        return xp.where(there, low, middle), xp.where(there, middle, high)

    if by_jax:
        low, high = lax.fori_loop(0, halvings, halve, (low, high))
    else:
        for turn in range(halvings):
            low, high = halve(turn, (low, high))
    return (low + high) / 2
