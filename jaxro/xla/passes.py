"""One pass over the points for several sums, or for several results of each point.

XLA's CPU backend makes one loop of each array that is a result, and computes in each
all that leads up to it: seven results that share most of their work cost seven times
that work. It also turns a long sum into a tree of windows that nothing can be fused
into. The one operation with several results that it makes one loop of is a variadic
reduction: `sums` is one, and `pointwise` is one that adds a zero to every number.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from .kernels import computed_once, fusing_points
from .settings import Trick, is_plain


def sums(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """The sums of equally long arrays over their last axis."""
    if len(arrays) == 1 or is_plain(Trick.SUMS):
        return tuple(jnp.sum(a, axis=-1) for a in arrays)
    return _sums(arrays)


@jax.custom_jvp
def _sums(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    zeros = tuple(jnp.zeros((), a.dtype) for a in arrays)
    return tuple(lax.reduce(arrays, zeros, _add, (arrays[0].ndim - 1,)))


@_sums.defjvp
def _sums_jvp(primals, tangents):
    (arrays,), (moved,) = primals, tangents
    return _sums(arrays), tuple(jnp.sum(a, axis=-1) for a in moved)


def total(array: Array) -> Array:
    """The sum of one array over its last axis."""
    return jnp.sum(array, axis=-1)


def count(flags: Array) -> Array:
    """How many flags are true along the last axis, as a number of the default
    precision."""
    return total(flags.astype(jnp.result_type(float)))


def pointwise(function: Callable, *points: PyTree) -> Any:
    """function(*point) of every point, as `jax.vmap(function)(*points)`; in a program
    that fuses points by one loop.

    The function may close over anything that is traced.
    """
    if not fusing_points():
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
    return computed_once(loop)(jnp.asarray(numbers, float), others, points)


@jax.custom_jvp
def _one_loop(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """The arrays as they are. Each is followed by a zero along a new last axis, and
    both are added."""
    nothing = tuple(jnp.zeros((), a.dtype) for a in arrays)
    followed = tuple(
        lax.pad(a[..., None], zero, [(0, 0, 0)] * a.ndim + [(0, 1, 0)])
        for a, zero in zip(arrays, nothing, strict=True)
    )
    return tuple(lax.reduce(followed, nothing, _add, (arrays[0].ndim,)))


@_one_loop.defjvp
def _one_loop_jvp(primals, tangents):
    return _one_loop(*primals), tangents[0]


def _add(one: Sequence, other: Sequence) -> tuple:
    """The sum of each number of the one and of the other; of flags, whether any is
    true."""
    return tuple(a + b for a, b in zip(one, other, strict=True))
