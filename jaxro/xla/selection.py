"""Run an expensive function only for those members of a batch that need it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .settings import Trick, is_plain


def where_needed(
    function: Callable,
    needed: Bool[Array, ""],
    data: PyTree,
    otherwise: PyTree,
    most: int,
) -> PyTree:
    """function(data) where it is needed, else `otherwise`: under `vmap` the function runs
    only for the members that need it, `most` at a time.

    For a function that few members need, and one that takes so much memory that a batch
    of a caller's own would not fit. Where no more than `most` members are batched, or
    none, what is not needed may be either. The function closes over no arrays and has
    no derivatives.
    """
    if is_plain(Trick.SELECTION):
        choose = lambda a, b: jnp.where(needed, a, b)
        return jax.tree.map(choose, function(data), otherwise)
    once = eqx.filter_closure_convert(function, data)  # traced once for both
    split = jax.custom_batching.custom_vmap(lambda needed, data, otherwise: once(data))

    @split.def_vmap
    def _(size: int, batched: list, *arguments: PyTree) -> tuple[PyTree, PyTree]:
        spread = lambda a, along: (
            a if along else jnp.broadcast_to(a, (size, *jnp.shape(a)))
        )
        needed, data, otherwise = (
            jax.tree.map(spread, *both) for both in zip(arguments, batched, strict=True)
        )
        out = (
            jax.vmap(once)(data)
            if size <= most
            else _some(once, needed, data, otherwise, most)
        )
        return out, jax.tree.map(lambda _: True, out)

    return split(needed, data, otherwise)


def _some(
    one: Callable, needed: Bool[Array, " pair"], data: PyTree, out: PyTree, most: int
) -> PyTree:
    """The rows of `out` that are needed replaced by `one` of theirs, `most` at a
    time."""
    size = needed.shape[0]
    place = jnp.where(needed, jnp.cumsum(needed) - 1, size)
    # behind the last one a row that is none
    order = jnp.full(size, size).at[place].set(jnp.arange(size), mode="drop")
    total = jnp.sum(needed)

    def turn(state: tuple[Array, PyTree]) -> tuple[Array, PyTree]:
        done, out = state
        rows = jax.lax.dynamic_slice_in_dim(order, done, most)
        new = jax.vmap(one)(jax.tree.map(lambda a: a.at[rows].get(mode="clip"), data))
        return done + most, jax.tree.map(
            lambda a, b: a.at[rows].set(b, mode="drop"), out, new
        )

    return jax.lax.while_loop(
        lambda state: state[0] < total, turn, (jnp.zeros_like(total), out)
    )[1]
