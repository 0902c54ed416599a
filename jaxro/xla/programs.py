"""Compiled programs of functions that have static options, and the compiler settings
that make them fast.

A program is cached by its function and its static options (classes, modules, plain
values), so that a second call with the same options compiles nothing.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, PyTree

from . import store

FAST = {
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
    "xla_cpu_fast_math_honor_division": True,
    "xla_cpu_fast_math_honor_functions": True,
}
"""Sums may be reordered, without which the CPU cannot vectorise them; NaN, infinity and
division stay exact."""

WIDE = {"xla_cpu_prefer_vector_width": 512}
"""Vectors of eight numbers where the processor has them."""

QUICK = {
    **FAST,
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""For single pairs: the older code generator, which jaxlib has up to 0.11.0, and a
lower level compile in half the time, and what they make runs no slower there."""

QUICKEST = {**QUICK, "xla_backend_optimization_level": 0}
"""For what is done once: compiles in another fifth less of the time, and a single pair
of few points takes a tenth longer."""

UNDIVIDED = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""Loops are not split over threads of the compiler's own: for pairs that are spread
over threads as they are. `whole_of_many` needs it, as a loop of several results cannot
be split."""

ONE_KERNEL = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""No sums by a library, which a kernel cannot call."""


class _Key:
    """Static options, compared by value."""

    def __init__(self, tree: PyTree):
        self.tree = tree
        leaves, structure = jax.tree.flatten(tree)
        self.key = (tuple(leaves), structure)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other) -> bool:
        return self.key == other.key


class Program:
    """data -> function(data, **options), compiled; arrays among the options are passed
    along as arguments.

    `kernel`: `whole` or `loops`, which the compiler may refuse; it is then compiled
    without.
    """

    def __init__(
        self,
        function: Callable,
        options: dict[str, Any],
        settings: dict[str, Any] = FAST,
        *,
        kernel: Callable[[Callable], Callable] | None = None,
    ):
        self._settings = tuple(settings.items())
        self._arrays, static = eqx.partition(options, eqx.is_array)
        self._static = _Key(static)
        self._function = function
        self._kernel = kernel

    def __call__(self, data: PyTree) -> PyTree:
        settings = *self._settings, *ONE_KERNEL.items()
        if self._kernel is not None and not self.refused and _known(settings):
            try:
                return self._run(data, self._kernel(self._function), settings)
            except jax.errors.JaxRuntimeError:  # sorting, say, in what a caller selects
                self._beside["refused"] = True
        return self._run(data, self._function, self._settings)

    @property
    def refused(self) -> bool:
        """Whether the compiler could not make one kernel of it."""
        return "refused" in self._beside

    @property
    def _beside(self) -> dict[str, Any]:
        return _beside(self._function, self._static, self._settings)

    def _run(self, data: PyTree, function: Callable, settings: tuple) -> PyTree:
        key = self._function, self._static, settings
        arguments = data, self._arrays
        if store.active():
            shapes = tuple(
                (np.shape(a), str(a.dtype)) for a in jax.tree.leaves(arguments)
            )
            stored = _beside(*key).setdefault("stored", {})
            if shapes not in stored:
                flat = _flat(function, self._static)
                stored[shapes] = store.compiled(flat, _known(settings), arguments, key)
            return stored[shapes](arguments)
        return _compiled(function, *key[1:])(*arguments)

    @property
    def outputs(self) -> dict[Any, PyTree]:
        """Room for a caller to keep the shapes of its results, as long as the compiled
        program lives."""
        return self._beside.setdefault("outputs", {})


def prompt(function: Callable, settings: dict[str, Any] | None = None) -> Callable:
    """`jax.jit(function)` that runs in the thread that calls it.

    JAX gives all but the smallest programs for the CPU to another thread, which costs
    50 µs a call, unless they may call back into Python. This one may: if its first
    number is the largest there is, which it gets back. JAX keeps no such program on
    disk, so that where it is to keep them this is an ordinary one.
    """
    kept = jax.config.jax_compilation_cache_dir is not None  # pyright: ignore[reportAttributeAccessIssue]
    if kept or jax.default_backend() != "cpu":
        return jax.jit(function, compiler_options=settings)

    def within(*arguments):
        numbers = [
            a
            for a in jax.tree.leaves(arguments)
            if jnp.issubdtype(a.dtype, jnp.floating)
        ]
        number = jnp.ravel(numbers[0])[:1] if numbers else jnp.zeros(1)
        same = lambda number: jax.pure_callback(np.asarray, number, number)
        largest = jnp.any(number == jnp.finfo(number.dtype).max)
        return function(*arguments), jax.lax.cond(
            largest, same, lambda number: number, number
        )

    compiled = jax.jit(within, compiler_options=settings)
    return lambda *arguments: compiled(*arguments)[0]


def _flat(function: Callable, static: _Key) -> Callable:
    def flat(data: PyTree, arrays: dict[str, Any]) -> PyTree:
        with uncollected():
            return function(data, **eqx.combine(arrays, static.tree))

    return flat


@contextmanager
def uncollected() -> Iterator[None]:
    """Without the garbage collector, which looks again and again through a trace, or a
    table, of which nothing is garbage yet, and each time through all that JAX keeps."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def known(settings: dict[str, Any]) -> dict[str, Any] | None:
    """Those of the settings that the compiler has, as `jax.jit` takes them: names are
    its own, and come and go."""
    return _known(tuple(settings.items()))


@lru_cache(maxsize=64)
def _compiled(function: Callable, static: _Key, settings: tuple) -> Callable:
    return prompt(_flat(function, static), _known(settings))


@lru_cache(maxsize=64)
def _beside(function: Callable, static: _Key, settings: tuple) -> dict[str, Any]:
    """What is remembered of a program."""
    return {}


@lru_cache
def _known(settings: tuple) -> dict[str, Any] | None:
    if jax.default_backend() != "cpu":
        return None

    def has(*some: tuple[str, Any]) -> bool:
        try:
            jax.jit(lambda: 0, compiler_options=dict(some)).lower().compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    return dict(settings if has(*settings) else filter(has, settings)) or None


def stage(function: Callable) -> Callable:
    """The function as a call of its own in the compiled program, so that its results
    exist once.

    XLA's CPU backend fuses a small computation into every consumer and repeats it there
    (an `optimization_barrier` is gone before it does). Other backends see the plain
    function.
    """
    return (
        _call(function, inlineable="false")
        if jax.default_backend() == "cpu"
        else function
    )


_kernels = jax.make_user_context(False)
_many = jax.make_user_context(False)


@lru_cache(maxsize=64)
def whole_of_many(function: Callable) -> Callable:
    """`whole`, in which what is computed of every point is one loop (`pointwise`):
    compiles for a fifth of a second longer, runs in seven eighths of the time."""

    def within(data: PyTree, **options: Any) -> PyTree:
        with _many(True):
            return whole(function)(data, **options)

    return within


@lru_cache(maxsize=64)
def whole(function: Callable) -> Callable:
    """The function as one compiled function of the processor.

    XLA's CPU backend compiles a program as many small ones and goes from one to the
    next at run time, which here costs as much as a third of the work.
    """
    return loops(
        lambda data, **options: _call(
            lambda data: function(data, **options), **_AS_ONE
        )(data)
    )


@lru_cache(maxsize=64)
def loops(function: Callable) -> Callable:
    """The function with every `part` of it as one compiled function of the processor;
    compiles sooner than `whole`."""

    def within(data: PyTree, **options: Any) -> PyTree:
        with _kernels(True):
            return function(data, **options)

    return within


def of_many() -> bool:
    """Whether a kernel of many pairs is being made."""
    return _many.value


def part(function: Callable) -> Callable:
    """Where kernels are made a kernel of its own, which the compiler makes better than
    a piece of a large one.

    Elsewhere a function of its own, whose loops are batched in a fifth less of the
    time.
    """
    return _call(function, **_AS_ONE) if _kernels.value else eqx.filter_jit(function)


def while_loop(more: Callable, turn: Callable, state: PyTree, like: Array) -> PyTree:
    """`lax.while_loop` whose numbers all differ from pair to pair from the start, as
    the number `like` does.

    Of a loop that begins with constants `vmap` batches the body again each time it
    learns that one of them changes, and the loops in it as often each time. The
    compiler drops the selection.
    """
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

    def turn(state):
        open_, value = state
        return open_ & False, jax.tree.map(
            lambda a, b: jnp.where(open_, a, b), function(open_), value
        )

    return while_loop(lambda state: state[0], turn, (needed, otherwise), needed)[1]


_AS_ONE = {"inlineable": "false", "xla_cpu_small_call": "true"}


def _call(function: Callable, **marks: str) -> Callable:
    """The function as a call with these marks, not its contents."""

    def unmarked(*arguments):
        with set_xla_metadata(inlineable="true", xla_cpu_small_call="false"):
            return function(*arguments)

    compiled = eqx.filter_jit(unmarked)

    def call(*arguments):
        with set_xla_metadata(**marks):
            return compiled(*arguments)

    return call


def traced(tree: PyTree) -> bool:
    """Whether any array of the tree is being traced by jit, vmap or grad."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
