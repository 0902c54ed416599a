"""Pairs of every length in few batches, with what is asked of each."""

import sys
from collections.abc import Callable, Iterator

import jax
import numpy as np
from jaxtyping import PyTree

from ..geometry.pairs import Pair, stack
from .padding import SIZES, sizes


def each(
    pairs: list[Pair],
    one: Callable[[Pair], PyTree],
    many: Callable[[Pair, Callable[[int, int], None]], PyTree],
    progress: Callable[[int], None],
    most: Callable[[int], int] = lambda size: sys.maxsize,
) -> Iterator[tuple[int, PyTree]]:
    """(index of the pair, its result in NumPy): one(pair) of a single pair, many(batch,
    progress) of several.

    Not in order, and padded. `most(points)`: pairs of so many points that go together
    at most.
    """
    if len(pairs) == 1:
        found = jax.tree.map(np.asarray, one(pairs[0]))
        progress(1)
        yield 0, found
        return
    finished = 0
    for size, members in buckets([len(pair.x_left) for pair in pairs]).items():
        step = min(len(members), most(size))
        for begin in range(0, len(members), step):
            part = members[begin : begin + step]
            batch = jax.tree.map(np.asarray, stack([pairs[i] for i in part], size))
            told = lambda done, total, before=finished: progress(
                min(before + done, len(pairs))
            )
            found = jax.tree.map(np.asarray, many(_filled(batch, step), told))
            finished += len(part)
            for row, i in enumerate(part):
                yield i, jax.tree.map(lambda a, row=row: a[row], found)


def buckets(lengths: list[int], most: int = SIZES) -> dict[int, list[int]]:
    """Indices of the pairs to be padded to each of `padding.sizes`, at most so many."""
    known = np.asarray(lengths, int)
    chosen = sizes(known, most)
    place = np.searchsorted(chosen, known)
    every = {size: np.flatnonzero(place == k).tolist() for k, size in enumerate(chosen)}
    return {size: members for size, members in every.items() if members}


def _filled(batch: Pair, count: int) -> Pair:
    """The batch with empty pairs up to `count`: no program for the rest."""
    missing = count - len(batch.x_left)
    if not missing:
        return batch
    return jax.tree.map(
        lambda a: np.concatenate([a, np.zeros((missing, *a.shape[1:]), a.dtype)]), batch
    )
