"""Sums of several arrays in one pass over all of them.

XLA's CPU backend computes one sum at a time, each with all that leads up to it, and
turns a long sum into a tree of windows that nothing can be fused into. One variadic
reduction has neither cost.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


@jax.custom_jvp
def sums(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """The sums of equally long arrays over their last axis."""
    if len(arrays) == 1:
        return (jnp.sum(arrays[0], axis=-1),)
    zeros = tuple(jnp.zeros((), a.dtype) for a in arrays)
    return tuple(lax.reduce(arrays, zeros, added, (arrays[0].ndim - 1,)))


def added(one: Sequence, other: Sequence) -> tuple:
    """The sum of each number of the one and of the other; of flags, whether any is
    true."""
    return tuple(a + b for a, b in zip(one, other, strict=True))


@sums.defjvp
def _sums_jvp(primals, tangents):
    (arrays,), (moved,) = primals, tangents
    return sums(arrays), tuple(jnp.sum(a, axis=-1) for a in moved)


def total(array: Array) -> Array:
    """The sum of one array over its last axis."""
    return sums((array,))[0]


def count(flags: Array) -> Array:
    """How many flags are true along the last axis, as a number of the default
    precision."""
    return total(flags.astype(jnp.result_type(float)))
