"""Compiled programs of functions that have static options.

A program is cached by its function and its static options (classes, modules, plain
values), so that a second call with the same options compiles nothing. What is switched
off by `settings.plain` is part of every key.
"""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import lru_cache, wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from . import store
from .settings import (
    NO_LIBRARY_SUMS,
    RUN_FAST,
    Trick,
    is_plain,
    known_settings,
    plain,
    switched_off,
)

Watch = Callable[[tuple[int, ...]], AbstractContextManager]
"""Of the shape of the first array of the data: what surrounds a compilation."""

_watch: Watch | None = None


def watch(surround: Watch) -> None:
    """Let `surround` be around every compilation from now on, to say what is awaited."""
    global _watch
    _watch = surround


_used = _forked = False


def _mark_child() -> None:
    """Remember that this process is a copy of one that has used JAX."""
    global _forked
    _forked = _used


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_child)


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
    along as arguments. Works under jit, vmap and grad, compiled or not.

    `kernel`: `kernels.one_kernel` or the like, which the compiler may refuse; the
    program is then compiled without.
    """

    def __init__(
        self,
        function: Callable,
        options: dict[str, Any],
        settings: dict[str, Any] = RUN_FAST,
        *,
        kernel: Callable[[Callable], Callable] | None = None,
    ):
        self._settings = tuple(settings.items())
        self._arrays, static = eqx.partition(options, eqx.is_array)
        self._static = _Key(static)
        self._function = function
        self._kernel = kernel
        self._plain = switched_off()

    def __call__(self, data: PyTree) -> PyTree:
        _refuse_fork()
        if is_traced((data, self._arrays)):
            # compiled as a part of the caller's program, or, under a `grad` or `vmap`
            # that nobody compiles, by itself and once
            return _as_part(self._function, self._static)(data, self._arrays)
        if self._plain == switched_off():
            return self._call(data)
        with plain(self._plain):  # a thread that helps does not know of it
            return self._call(data)

    def _call(self, data: PyTree) -> PyTree:
        settings = *self._settings, *NO_LIBRARY_SUMS.items()
        if (
            self._kernel is not None
            and not self.refused
            and known_settings(dict(settings))
        ):
            try:
                return self._run(data, self._kernel(self._function), settings)
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" in str(error):
                    raise
                # sorting, say, in what a caller selects
                self._remembered["refused"] = True
        return self._run(data, self._function, self._settings)

    @property
    def refused(self) -> bool:
        """Whether the compiler could not make one kernel of it."""
        return "refused" in self._remembered

    @property
    def _remembered(self) -> dict[str, Any]:
        return _remembered(self._function, self._static, self._settings, self._plain)

    def _run(self, data: PyTree, function: Callable, settings: tuple) -> PyTree:
        key = self._function, self._static, settings, self._plain
        arguments = data, self._arrays
        if _watch is None and not store.active():
            return _compile(function, *key[1:])(*arguments)
        shapes = tuple((np.shape(a), str(a.dtype)) for a in jax.tree.leaves(arguments))
        where = "stored" if store.active() else "compiled"
        known = _remembered(*key).setdefault(where, {})
        if shapes in known:
            return known[shapes](*arguments)
        found = None
        with _watch(shapes[0][0] if shapes else ()) if _watch else nullcontext():
            if store.active():
                flat = _flat(function, self._static)
                options = known_settings(dict(settings))
                program = store.load_or_compile(flat, options, arguments, key)
            else:
                program = _compile(function, *key[1:])
                found = program(*arguments)  # the first call compiles
        known[shapes] = program
        return program(*arguments) if found is None else found

    @property
    def outputs(self) -> dict[Any, PyTree]:
        """Room for a caller to keep the shapes of its results, as long as the compiled
        program lives."""
        return self._remembered.setdefault("outputs", {})


def jit_in_this_thread(
    function: Callable, settings: dict[str, Any] | None = None
) -> Callable:
    """`jax.jit(function)` that runs in the thread that calls it.

    JAX gives all but the smallest programs for the CPU to another thread, which costs
    50 µs a call, unless they may call back into Python. This one may: if its first
    number is the largest there is, which it gets back. JAX keeps no such program on
    disk, so that where it is to keep them this is an ordinary one.
    """
    kept = jax.config.jax_compilation_cache_dir is not None  # pyright: ignore[reportAttributeAccessIssue]
    threaded = is_plain(Trick.SAME_THREAD) or jax.default_backend() != "cpu"
    if kept or threaded:
        return jax.jit(function, compiler_options=settings)

    @wraps(function)
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
    @wraps(function)
    def flat(data: PyTree, arrays: dict[str, Any]) -> PyTree:
        with pause_collection():
            return function(data, **eqx.combine(arrays, static.tree))

    return flat


@contextmanager
def pause_collection() -> Iterator[None]:
    """Without the garbage collector, which looks again and again through a trace, or a
    table, of which nothing is garbage yet, and each time through all that JAX keeps."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _refuse_fork() -> None:
    """Raises RuntimeError in a process that was forked from one that has used JAX,
    whose threads do not live on in it: it would wait for them for ever."""
    global _used
    _used = True
    if _forked:
        raise RuntimeError(
            "this process was forked from one that has already computed with jaxro, "
            "whose threads it has not got. Start processes anew: "
            "multiprocessing.get_context('spawn'), or fork before the first call"
        )


@lru_cache(maxsize=64)
def _as_part(function: Callable, static: _Key) -> Callable:
    return jax.jit(_flat(function, static))


@lru_cache(maxsize=64)
def _compile(function: Callable, static: _Key, settings: tuple, off: Trick) -> Callable:
    return jit_in_this_thread(_flat(function, static), known_settings(dict(settings)))


@lru_cache(maxsize=64)
def _remembered(
    function: Callable, static: _Key, settings: tuple, off: Trick
) -> dict[str, Any]:
    """What is remembered of a program."""
    return {}


def is_traced(tree: PyTree) -> bool:
    """Whether any array of the tree is being traced by jit, vmap or grad."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
