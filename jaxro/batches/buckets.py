"""Some of many pairs: those that are padded to one size, or those with some of their
points."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int, PyTree

from .batch import map_batch
from .padding import SIZES, Plan, sizes
from .ragged import Ragged

Rows = Int[np.ndarray, " _"]

OF_PAIRS = ("begins", "focal_left", "focal_right")
"""The fields of `Ragged` that have no value for each row."""


def buckets(lengths: list[int], most: int = SIZES) -> dict[int, list[int]]:
    """Indices of the pairs to be padded to each of `padding.sizes`, at most so many."""
    known = np.asarray(lengths, int)
    chosen = sizes(known, most)
    place = np.searchsorted(chosen, known)
    every = {size: np.flatnonzero(place == k).tolist() for k, size in enumerate(chosen)}
    return {size: members for size, members in every.items() if members}


def choose(pairs: Ragged, members: Rows, rows: Sequence[Rows]) -> Ragged:
    """These pairs with these of their rows."""
    flat = np.concatenate(rows)
    of_rows = lambda column: column[flat]
    chosen = jax.tree.map(of_rows, pairs._replace(**dict.fromkeys(OF_PAIRS)))
    return chosen._replace(
        begins=np.cumsum([0] + [len(own) for own in rows]),
        focal_left=pairs.focal_left[members],
        focal_right=pairs.focal_right[members],
    )


def by_size(
    pairs: Ragged, plan: Plan, most: Callable[[int], int]
) -> Iterator[tuple[Rows, int]]:
    """(numbers, size) of the pairs that are padded to one size of the plan, at most
    `most(size)` of them together."""
    place = np.searchsorted(plan.sizes, pairs.lengths)
    for k, size in enumerate(plan.sizes):
        members = np.flatnonzero(place == k)
        for begin in range(0, len(members), most(size)):
            yield members[begin : begin + most(size)], size


def rows_of(pairs: Ragged, members: Rows) -> list[Rows]:
    """The rows of each of these pairs."""
    spans = zip(pairs.begins[members], pairs.begins[members + 1], strict=True)
    return [np.arange(begin, end) for begin, end in spans]


def map_ragged(
    function: Callable[[Any], PyTree],
    pairs: Ragged,
    batch_of: Callable[[Rows, int], PyTree],
    plan: Plan,
    threads: int | None = None,
) -> PyTree:
    """function(...) of every pair, which tells something of its points, in the rows of
    `pairs`. `batch_of(numbers, size)`: what `function` takes, of these pairs, padded."""
    out: PyTree = None
    slabs = dict(zip(plan.sizes, plan.slabs, strict=True))
    for members, size in by_size(pairs, plan, lambda size: slabs[size]):
        missing = slabs[size] - len(members)  # filled up: no other program for the rest
        fill = lambda a, n=missing: np.pad(a, [(0, n)] + [(0, 0)] * (np.ndim(a) - 1))
        batch = jax.tree.map(fill, batch_of(members, size))
        found = jax.tree.map(np.asarray, map_batch(function, batch, threads=threads))
        if out is None:
            out = jax.tree.map(
                lambda a: np.empty((len(pairs.x_left), *a.shape[2:]), a.dtype), found
            )
        own = [a[: len(members)] for a in jax.tree.leaves(found)]
        pairs.gather(members, own, jax.tree.leaves(out))
    return out
