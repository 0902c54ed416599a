"""Pieces of a program that the compiler keeps together or apart.

For numbers `one_kernel`, `one_kernel_fusing_points`, `kernels_of_parts`, `kernel_part`
and `computed_once` are the function they are given; `while_loop` is `lax.while_loop`
and `if_needed` is `jnp.where`.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, PyTree

from .settings import Trick, is_plain

_making_kernels = jax.make_user_context(False)
_fusing_points = jax.make_user_context(False)


@lru_cache(maxsize=64)
def one_kernel(function: Callable) -> Callable:
    """The function of (*data, **options) as one compiled function of the processor.

    XLA's CPU backend compiles a program as many small ones and goes from one to the
    next at run time, which costs more than the work of a small pair.
    """

    @wraps(function)
    def within(*data: PyTree, **options: Any) -> PyTree:
        with_options = lambda *data: function(*data, **options)
        if is_plain(Trick.ONE_KERNEL):
            return with_options(*data)
        return _call(with_options, **_AS_ONE)(*data)

    return kernels_of_parts(within)


@lru_cache(maxsize=64)
def one_kernel_fusing_points(function: Callable) -> Callable:
    """`one_kernel`, in which everything that `passes.pointwise` computes of a point is
    one loop."""

    @wraps(function)
    def within(*data: PyTree, **options: Any) -> PyTree:
        with _fusing_points(True):
            return one_kernel(function)(*data, **options)

    return within


@lru_cache(maxsize=64)
def kernels_of_parts(function: Callable) -> Callable:
    """The function with each `kernel_part` of it as one compiled function of the
    processor; compiles sooner than `one_kernel`."""

    @wraps(function)
    def within(*data: PyTree, **options: Any) -> PyTree:
        with _making_kernels(True):
            return function(*data, **options)

    return within


def fusing_points() -> bool:
    """Whether the program that is traced is `one_kernel_fusing_points`."""
    return _fusing_points.value and not is_plain(Trick.POINTWISE)


def kernel_part(function: Callable) -> Callable:
    """Where kernels are made the function as a kernel of its own, which the compiler
    makes better than a piece of a large one.

    Elsewhere a function of its own, whose loops `vmap` batches sooner.
    """
    if is_plain(Trick.KERNEL_PART):
        return function
    if _making_kernels.value:
        return _call(function, **_AS_ONE)
    return eqx.filter_jit(function)


def computed_once(function: Callable) -> Callable:
    """The function as a call of its own in the compiled program, so that its results
    exist once.

    XLA's CPU backend fuses a small computation into every consumer and repeats it there
    (it removes an `optimization_barrier` before it fuses). Other backends see the plain
    function.
    """
    if jax.default_backend() != "cpu" or is_plain(Trick.COMPUTED_ONCE):
        return function
    return _call(function, inlineable="false")


def while_loop(more: Callable, turn: Callable, state: PyTree, like: Array) -> PyTree:
    """`lax.while_loop` whose numbers all differ from pair to pair from the start, as
    the number `like` does.

    Of a loop that begins with constants `vmap` batches the body again each time it
    learns that one of them changes, and the loops in it as often each time. The
    compiler drops the selection.
    """
    if is_plain(Trick.WHILE_LOOP):
        return jax.lax.while_loop(more, turn, state)
    always = like == like
    return jax.lax.while_loop(
        more, turn, jax.tree.map(lambda a: jax.lax.select(always, a, a), state)
    )


def if_needed(
    needed: Array, function: Callable[[Array], PyTree], otherwise: PyTree
) -> PyTree:
    """`function`(needed) where it is needed, else `otherwise`: computed under `vmap`
    only if some pair needs it.

    It is a loop of at most one turn. What `function` works on has to depend on its
    argument (a mask, say), or the compiler computes it outside of the loop.
    """
    choose = lambda a, b: jnp.where(needed, a, b)
    if is_plain(Trick.IF_NEEDED):
        return jax.tree.map(choose, function(needed), otherwise)

    def turn(state):
        open_, value = state
        return open_ & False, jax.tree.map(
            lambda a, b: jnp.where(open_, a, b), function(open_), value
        )

    return while_loop(lambda state: state[0], turn, (needed, otherwise), needed)[1]


_AS_ONE = {"inlineable": "false", "xla_cpu_small_call": "true"}


def _call(function: Callable, **marks: str) -> Callable:
    """The function as a call with these marks; its contents have none."""

    def unmarked(*arguments):
        with set_xla_metadata(inlineable="true", xla_cpu_small_call="false"):
            return function(*arguments)

    compiled = eqx.filter_jit(unmarked)

    def call(*arguments):
        with set_xla_metadata(**marks):
            return compiled(*arguments)

    return call
