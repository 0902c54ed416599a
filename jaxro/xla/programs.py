"""Compiled programs of functions: numbers are arguments, structure is the program.

    @compiled
    def fit(measured, *, model): ...

`fit(...)` is one program for each structure of its arguments: arrays are arguments of
it, and so are the numbers in `measured` and real numbers in `model` (tolerances, levels,
strengths); classes, whole numbers and names choose the program. Functions among the
arguments are compared by their code (`closures`). A second call with other numbers
compiles nothing, nor does the next process where programs are kept (`store`). What is
switched off by `settings.plain` is part of every key.
"""

import gc
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache, update_wrapper, wraps
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state
from jaxtyping import PyTree

from . import notices, store
from .closures import Unknown, keep_constants
from .settings import (
    COMPILE_FAST,
    NO_LIBRARY_SUMS,
    Trick,
    is_plain,
    known_settings,
    plain,
    switched_off,
)
from .structure import Structure, divide

MOST = 64
"""Programs that a process keeps; what was not used for longest goes."""

_used = _forked = False


def _mark_child() -> None:
    """Remember that this process is a copy of one that has used JAX."""
    global _forked
    _forked = _used


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_child)


Settings = dict[str, Any] | Callable[..., dict[str, Any]]
"""Settings of the compiler, or what makes them of the arguments."""


def compiled(
    function: Callable | None = None,
    *,
    settings: Settings = COMPILE_FAST,
    kernel: Callable[[Callable], Callable] | None = None,
    static: tuple[str, ...] = (),
    unit: str | None = None,
) -> Any:
    """The function as a compiled program: a decorator.

    All numbers in positional arguments are arguments of the program, and so are arrays
    and real numbers in keyword arguments, but for those that are `static`. Works under
    jit, vmap and grad, compiled or not. `kernel`: `kernels.one_kernel` or the like,
    which the compiler may refuse; the program is then compiled without. `unit`: what the
    first array has along its last axis, which a waiting user is told. Within programs
    it is a part of them that JAX traces once for all.
    """
    if function is None:
        return lambda function: compiled(
            function, settings=settings, kernel=kernel, static=static, unit=unit
        )
    return Compiled(function, settings, kernel, static, unit)


class Compiled:
    """A function that runs as a program; see `compiled`."""

    def __init__(
        self,
        function: Callable,
        settings: Settings = COMPILE_FAST,
        kernel: Callable[[Callable], Callable] | None = None,
        static: tuple[str, ...] = (),
        unit: str | None = None,
    ):
        update_wrapper(self, function)
        self.function, self._settings = function, settings
        self._kernel, self._static, self._unit = kernel, static, unit

    def __call__(self, *data: PyTree, **options: Any) -> Any:
        return self.bind(**options)(*data)

    def using(
        self,
        settings: Settings,
        kernel: Callable[[Callable], Callable] | None = None,
    ) -> "Compiled":
        """The same function, compiled with other settings."""
        return Compiled(self.function, settings, kernel, self._static, self._unit)

    def bind(self, **options: Any) -> "Program":
        """The program with its keyword arguments given."""
        static = {name: options.pop(name) for name in self._static if name in options}
        source = Source(self.function, self._settings, self._kernel, self._unit)
        return Program(source, options, static)


class Source(NamedTuple):
    """What a program is made of, and how."""

    function: Callable
    settings: Settings
    kernel: Callable[[Callable], Callable] | None
    unit: str | None


class Program:
    """data -> function(*data, **options), compiled."""

    def __init__(self, source: Source, options: dict[str, Any], held: dict[str, Any]):
        self._source, self._options, self._held = source, options, held
        self._plain = switched_off()

    def __call__(self, *data: PyTree) -> Any:
        _refuse_fork()
        if self._plain == switched_off():
            return self._call(data)
        with plain(self._plain):  # a thread that helps does not know of it
            return self._call(data)

    def _call(self, data: tuple) -> Any:
        try:
            numbers, structure = divide(data, self._options, self._held)
        except Unknown:
            return self._alone(*data)
        try:
            return self._choose(data, numbers, structure)
        except _NO_ARGUMENT:
            if not keep_constants(structure.restore(numbers)):
                raise
        return self._choose(data, *divide(data, self._options, self._held))

    @cached_property
    def _alone(self) -> Callable:
        """The function where nothing tells whether it is what it was: compiled for the
        calls of this object, and no longer."""
        options = self._options | self._held
        return eqx.filter_jit(lambda *data: self._source.function(*data, **options))

    def _choose(self, data: tuple, numbers: list, structure: Structure) -> Any:
        """The result by the program that fits."""
        source = self._source
        if is_traced(numbers):
            # compiled as a part of the caller's program, or, under a `grad` or `vmap`
            # that nobody compiles, by itself and once
            return _as_part(source.function, structure)(*numbers)
        if get_opaque_trace_state() == _NOTHING_TRACED:
            return self._choose_settings(data, numbers, structure)
        # within a program of the caller's, what is known is computed while it is traced
        with jax.ensure_compile_time_eval():
            return self._choose_settings(data, numbers, structure)

    def _choose_settings(self, data: tuple, numbers: list, structure: Structure) -> Any:
        """The result by the program of the settings that fit."""
        source, settings = self._source, self._source.settings
        if callable(settings):
            settings = settings(*data, **self._options, **self._held)
        every = tuple(settings.items())
        whole = *every, *NO_LIBRARY_SUMS.items()
        remembered = _remembered(source.function, structure, every, self._plain)
        if (
            source.kernel is not None
            and "refused" not in remembered
            and known_settings(dict(whole))
        ):
            try:
                return self._run(
                    source.kernel(source.function), numbers, structure, whole
                )
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" in str(error):
                    raise
                # sorting, say, in what a caller selects
                remembered["refused"] = True
        return self._run(source.function, numbers, structure, every)

    def _run(
        self, function: Callable, numbers: list, structure: Structure, settings: tuple
    ) -> Any:
        key = function, structure, settings, self._plain
        place = *key, tuple(map(_shape, numbers)), store.active()
        program = _programs.find(place)
        if program is not None:
            return program(*numbers)
        flat, options = _flat(function, structure), known_settings(dict(settings))
        with notices.compiling(self._describe(numbers)):
            if store.active():
                program = store.load_or_compile(flat, options, numbers, key)
            else:
                program = jit_in_this_thread(flat, options)
            found = program(*numbers)  # the first call of a jit compiles
        _programs.keep(place, program)
        return found

    def _describe(self, numbers: list[Any]) -> str:
        """What is compiled, for a user who waits."""
        unit, kept = self._source.unit, ", kept for later" if store.active() else ""
        if unit is None or not numbers or not np.shape(numbers[0]):
            return f"a program{kept}"
        return f"for up to {np.shape(numbers[0])[-1]} {unit}{kept}"

    @cached_property
    def outputs(self) -> dict[Any, PyTree]:
        """Room for a caller to keep the shapes of its results."""
        try:
            _, structure = divide((), self._options, self._held)
        except Unknown:
            return {}
        remembered = _remembered(self._source.function, structure, (), self._plain)
        return remembered.setdefault("outputs", {})


_NO_ARGUMENT = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""What JAX says where a value is needed and an argument is found."""


def _shape(leaf: Any) -> tuple:
    """What a program depends on of an argument."""
    dtype = getattr(leaf, "dtype", None)
    return (type(leaf),) if dtype is None else (leaf.shape, dtype)


_NOTHING_TRACED = get_opaque_trace_state()
"""The state of JAX where no program is being traced, as while this is imported."""


class _Recent:
    """The programs that were used last."""

    def __init__(self, most: int):
        self._most, self._lock = most, threading.Lock()
        self._kept: OrderedDict[tuple, Callable] = OrderedDict()

    def find(self, place: tuple) -> Callable | None:
        with self._lock:
            program = self._kept.get(place)
            if program is not None:
                self._kept.move_to_end(place)
            return program

    def keep(self, place: tuple, program: Callable) -> None:
        with self._lock:
            self._kept[place] = program
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)

    def clear(self) -> None:
        with self._lock:
            self._kept.clear()


_programs = _Recent(MOST)


def forget() -> None:
    """Give back all compiled programs."""
    _programs.clear()
    _as_part.cache_clear()
    _remembered.cache_clear()


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


def _flat(function: Callable, structure: Structure) -> Callable:
    """The function of the numbers alone."""

    @wraps(function)
    def flat(*numbers: Any) -> PyTree:
        with pause_collection():
            data, options, held = structure.restore(numbers)
            return function(*data, **options, **held)

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


@lru_cache(maxsize=4 * MOST)
def _as_part(function: Callable, structure: Structure) -> Callable:
    return jax.jit(_flat(function, structure))


@lru_cache(maxsize=2 * MOST)
def _remembered(
    function: Callable, structure: Structure, settings: tuple, off: Trick
) -> dict[str, Any]:
    """What is remembered of a program."""
    return {}


def is_traced(tree: PyTree) -> bool:
    """Whether any array of the tree is being traced by jit, vmap or grad."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
