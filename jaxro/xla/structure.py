"""What is an argument of a program, and what chooses the program: the numbers of a
call, and the structure of all else in it, compared by value."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from .closures import FUNCTIONS, open_function


class Structure:
    """All of the arguments but their numbers, compared by value: the structure of data,
    of options and of what is held, each with its leaves."""

    def __init__(self, *trees: tuple):
        self.trees = trees
        self._hash = hash(trees)

    def restore(self, numbers: Sequence[Any]) -> list[Any]:
        """Data, options and what is held, with these numbers in their places."""
        rest = iter(numbers)
        return [
            structure.unflatten(
                next(rest) if leaf is _NUMBER else leaf.value for leaf in leaves
            )
            for structure, leaves in self.trees
        ]

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self.trees == other.trees

    def __reduce__(self):
        return Structure, tuple(
            structure.unflatten(leaves) for structure, leaves in self.trees
        )


def divide(
    data: tuple, options: dict[str, Any], held: dict[str, Any]
) -> tuple[list[Any], Structure]:
    """The numbers of the arguments, and all else of them. Raises `Unknown`."""
    numbers: list[Any] = []
    trees = (
        _take_numbers(data, _is_number, numbers),
        _take_numbers(options, _is_real, numbers),
        _take_numbers(held, lambda leaf: False, numbers),
    )
    return numbers, Structure(*trees)


def _take_numbers(
    tree: PyTree, is_argument: Callable[[Any], bool], numbers: list[Any]
) -> tuple:
    """The structure of a tree and its leaves, with _NUMBER in the place of each
    argument, which is added to `numbers`."""
    leaves, structure = jax.tree.flatten(tree)
    if any(isinstance(leaf, FUNCTIONS) for leaf in leaves):
        opened = [open_function(leaf) for leaf in leaves]
        leaves, structure = jax.tree.flatten(structure.unflatten(opened))
    kept = []
    for leaf in leaves:
        if is_argument(leaf):
            numbers.append(leaf)
            kept.append(_NUMBER)
        else:
            kept.append(_Leaf(leaf, type(leaf)))
    return structure, tuple(kept)


class _Leaf(NamedTuple):
    """A leaf that is no argument; 1, 1.0 and True are three."""

    value: Any
    kind: type


class _Number:
    """Stands where a number is an argument of the program."""


_NUMBER = _Number()
_ARRAYS = (jax.Array, np.ndarray, np.generic)


def _is_number(leaf: Any) -> bool:
    """Whether a leaf of what is computed with is an argument of the program."""
    return isinstance(leaf, (*_ARRAYS, bool, int, float, complex))


def _is_real(leaf: Any) -> bool:
    """Whether a leaf of the options is one."""
    return isinstance(leaf, (*_ARRAYS, float))
