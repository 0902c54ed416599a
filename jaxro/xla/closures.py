"""Functions as trees: what a function closes over becomes arguments of its program.

A function that a caller writes anew for every call, a lambda or an inner function, is
another object each time, though its code is the same. `open_function` turns it into a
tree of its code and of what it refers to: two functions of the same code have equal
trees but for their arrays, so that one compiled program serves both. A function that
refers to what may change unseen, a class or a module of the caller's, is `Unknown`.
"""

import dis
import enum
import functools
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

VERSIONED = (
    *("jaxro", "jax", "jaxlib", "jaxtyping", "equinox", "optimistix", "lineax"),
    "numpy",
)
"""Packages whose functions do not change while a process runs, and whose versions are
known: a function of theirs is what its name says."""

KNOWN = frozenset(VERSIONED) | sys.stdlib_module_names
"""These and Python's own, in which nothing changes unseen."""

FIXED = (
    *(type(None), str, bytes, range, slice),
    *(types.BuiltinFunctionType, enum.Enum, np.dtype),
)
"""Types of values that are part of the code: nothing in them can change unseen."""


ARRAYS = (jax.Array, np.ndarray, np.generic)


class Unknown(Exception):
    """A function refers to an object that may change without notice."""


class Module:
    """The global names of a function, compared by identity."""

    def __init__(self, function: types.FunctionType):
        self.names, self.name = function.__globals__, function.__module__

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Module) and self.names is other.names

    def __hash__(self) -> int:
        return id(self.names)


class Opened(eqx.Module):
    """A function as a tree: its code, and the values of its closure, of its defaults,
    and of the global names that it uses."""

    code: types.CodeType = eqx.field(static=True)
    module: Module = eqx.field(static=True)
    cells: tuple
    defaults: tuple | None
    keywords: dict[str, Any] | None
    used: dict[str, Any]

    def __call__(self, *arguments, **options):
        own = self.cells, self.defaults, self.keywords, self.used
        cells, defaults, keywords, used = jax.tree.map(_content, own)
        names = self.module.names | used if used else self.module.names
        places = tuple(map(types.CellType, cells))
        name = self.code.co_name
        function = types.FunctionType(self.code, names, name, defaults, places)
        function.__kwdefaults__ = keywords
        return function(*arguments, **options)


class Method(eqx.Module):
    """A method of an object that is a tree, bound to it."""

    function: Callable
    owner: PyTree

    def __call__(self, *arguments, **options):
        owner = jax.tree.map(_content, self.owner)
        return self.function(owner, *arguments, **options)


class Partial(eqx.Module):
    """A function of which some arguments are given."""

    function: Callable
    arguments: tuple
    options: dict[str, Any]

    def __call__(self, *arguments, **options):
        given = self.arguments, self.options
        first, named = jax.tree.map(_content, given)
        return self.function(*first, *arguments, **named, **options)


class Constant:
    """A number or an array of NumPy that is part of the code, compared by its
    content."""

    def __init__(self, content: Any):
        self.content = content
        array = np.asarray(content)
        self.key = type(content), array.shape, array.dtype.str, array.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def _content(leaf: Any) -> Any:
    return leaf.content if isinstance(leaf, Constant) else leaf


_need_constants: set[types.CodeType] = set()
"""Codes that do with arrays of NumPy what cannot be done with an argument."""


def keep_constants(tree: PyTree) -> bool:
    """Let arrays of NumPy be part of the code in all functions of a tree from now on;
    whether that is new of any of them."""
    is_open = lambda leaf: isinstance(leaf, Opened)
    codes = {
        part.code for part in jax.tree.leaves(tree, is_leaf=is_open) if is_open(part)
    }
    new = codes - _need_constants
    _need_constants.update(new)
    return bool(new)


def package_of(thing: Any) -> str:
    """The package that a module is of, or in which a function or class is written."""
    name = "__name__" if isinstance(thing, types.ModuleType) else "__module__"
    return (getattr(thing, name, None) or "").partition(".")[0]


def is_versioned(thing: Any) -> bool:
    """Whether a function or class belongs to one of the VERSIONED packages, and can be
    found in it by its name."""
    name = getattr(thing, "__qualname__", "<")
    return package_of(thing) in VERSIONED and "<" not in name


def open_function(function: Any) -> Any:
    """A function as a tree, or what it is if its name says all. Raises `Unknown`."""
    return _open(function, ())


FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial)


def _open(leaf: Any, within: tuple) -> Any:
    """A leaf as a tree; `within`: the functions that lead to it."""
    if isinstance(leaf, types.FunctionType):
        return leaf if _is_itself(leaf) else _open_function(leaf, within)
    if isinstance(leaf, types.MethodType):
        owner = jax.tree.map(lambda part: _value(part, within, False), leaf.__self__)
        return Method(_open(leaf.__func__, within), owner)
    if isinstance(leaf, functools.partial):
        parts = leaf.func, leaf.args, leaf.keywords
        return Partial(*jax.tree.map(lambda part: _value(part, within, False), parts))
    return leaf


def _is_itself(function: types.FunctionType) -> bool:
    """Whether a function is nothing but what its name says."""
    if not is_versioned(function):
        return False
    found: Any = sys.modules.get(function.__module__)
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return function.__closure__ is None or found is function


def _open_function(function: types.FunctionType, within: tuple) -> Opened:
    if function in within:
        raise Unknown(f"{function.__qualname__} calls itself")
    within = *within, function
    constant = function.__code__ in _need_constants

    def value(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: _value(leaf, within, constant), tree)

    cells = tuple(value(cell.cell_contents) for cell in function.__closure__ or ())
    return Opened(
        code=function.__code__,
        module=Module(function),
        cells=cells,
        defaults=value(function.__defaults__),
        keywords=value(function.__kwdefaults__),
        used={name: value(found) for name, found in _used_globals(function)},
    )


def _value(leaf: Any, within: tuple, constant: bool) -> Any:
    """What a function refers to, as a leaf or a tree. Raises `Unknown` where it may
    change without notice."""
    if isinstance(leaf, bool | int | float | complex):
        return Constant(leaf)
    if isinstance(leaf, np.ndarray) and (constant or leaf.dtype.kind in "US"):
        return Constant(leaf)
    if isinstance(leaf, type | types.ModuleType) and package_of(leaf) in KNOWN:
        return leaf
    opened = _open(leaf, within)
    if opened is not leaf or isinstance(leaf, (*FIXED, *ARRAYS, types.FunctionType)):
        return opened
    if callable(leaf) and is_versioned(type(leaf)):  # a compiled function, say
        return leaf
    raise Unknown(f"{type(leaf).__qualname__} is no tree")


def _used_globals(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The names of a caller's module that a function uses, and their values; those of
    VERSIONED packages do not change."""
    if package_of(function) in VERSIONED:
        return
    names = function.__globals__
    for name in sorted(_global_names(function.__code__)):
        if name in names:
            yield name, names[name]


@functools.lru_cache(maxsize=256)
def _global_names(code: types.CodeType) -> frozenset[str]:
    """The global names in a code, and in the functions that it makes."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    own = {
        step.argval
        for step in dis.get_instructions(code)
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")
    }
    return frozenset(own).union(*map(_global_names, inner))
