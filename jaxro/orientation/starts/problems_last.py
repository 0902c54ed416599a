"""Small fixed-size problems with the batch on the last axis, the one along which a
processor works."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array


def cross(a: Array, b: Array, axis: int = 0) -> Array:
    """a x b along one axis of three."""
    a0, a1, a2 = (lax.index_in_dim(a, i, axis, keepdims=False) for i in range(3))
    b0, b1, b2 = (lax.index_in_dim(b, i, axis, keepdims=False) for i in range(3))
    return jnp.stack(
        [a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=axis
    )


def merging_last(solve: Callable) -> Callable:
    """A `solve` whose arrays all carry a problem axis at the end; a `vmap` outside only
    makes that axis longer."""

    @custom_vmap
    def many(*arrays):
        return solve(*arrays)

    @many.def_vmap
    def _(axis_size, in_batched, *arrays):
        merged = []
        for a, batched in zip(arrays, in_batched, strict=True):
            full = a if batched else jnp.broadcast_to(a[None], (axis_size, *a.shape))
            merged.append(jnp.moveaxis(full, 0, -2).reshape(*full.shape[1:-1], -1))
        split = jax.tree.map(
            lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], axis_size, -1), -2, 0),
            many(*merged),
        )
        return split, jax.tree.map(lambda _: True, split)

    return many


def problems_last(solve: Callable) -> Callable:
    """The one-problem function of a `solve` whose arrays all carry a problem axis at
    the end.

    However deep the `vmap` outside, it only makes that last axis longer.
    """
    many = merging_last(solve)

    def one(*arrays):
        return jax.tree.map(lambda a: a[..., 0], many(*(a[..., None] for a in arrays)))

    return one
