"""Several results of every point, in one loop.

XLA's CPU backend makes one loop of each array that is a result, and computes in each
all that leads up to it: seven results that share most of their work cost seven times
that work. The one operation with several results that it makes one loop of is a
variadic reduction; this one adds a zero to every number.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from .programs import of_many, stage
from .reductions import added


def pointwise(function: Callable, *points: PyTree) -> Any:
    """function(*point) of every point, as `jax.vmap(function)(*points)`; in a kernel of
    many pairs by one loop.

    The function may close over anything that is traced.
    """
    if not of_many():
        return jax.vmap(function)(*points)
    first = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), points)
    closed = eqx.filter_closure_convert(function, *first)
    shared, others = eqx.partition(
        closed,
        lambda leaf: eqx.is_array(leaf) and leaf.ndim == 0 and leaf.dtype == float,
    )
    numbers, structure = jax.tree.flatten(shared)

    def loop(together: Array, others: PyTree, points: tuple) -> Any:
        shared = jax.tree.unflatten(
            structure, [together[k] for k in range(len(numbers))]
        )
        results, tree = jax.tree.flatten(jax.vmap(eqx.combine(shared, others))(*points))
        return jax.tree.unflatten(tree, _one_loop(tuple(results)))

    # A loop that reads and writes many arrays is made of vectors only after each that
    # is written has been told from all others, at run time: what the points share is
    # one array, in a call of its own so that it stays one.
    return stage(loop)(jnp.asarray(numbers, float), others, points)


@jax.custom_jvp
def _one_loop(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """The arrays as they are. Each is followed by a zero along a new last axis, and
    both are added."""
    nothing = tuple(jnp.zeros((), a.dtype) for a in arrays)
    followed = tuple(
        lax.pad(a[..., None], zero, [(0, 0, 0)] * a.ndim + [(0, 1, 0)])
        for a, zero in zip(arrays, nothing, strict=True)
    )
    return tuple(lax.reduce(followed, nothing, added, (arrays[0].ndim,)))


@_one_loop.defjvp
def _one_loop_jvp(primals, tangents):
    return _one_loop(*primals), tangents[0]
