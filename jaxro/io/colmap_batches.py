"""The matched pairs of a database as padded batches, through search and judgement on all cores."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ..pairs import Pair
from ..programs import FAST, QUICK, Program
from ..rejection.ransac import Ransac
from ..slabs import Way, chunked, spread
from .buckets import buckets
from .colmap_cameras import PhotoPoints
from .colmap_orientation import EIGHT, FIVE, SEARCHED, Found, Kind, judged, searched, suffices

TOGETHER = 2_000_000
"""Matches in memory at once, padding included: some 300 MB."""

IN_CACHE = 16_384
"""Matches that are judged together: what stays in the cache of a core."""

PAIRS = 48
"""Pairs in one call of a program: enough to hide the .3 ms that a call costs, few enough to share out among threads."""

FEW = 64
"""Matches to which shorter pairs are padded for a search."""


Fields = tuple[np.ndarray, ...]
"""The fields of a `Pair` in NumPy, pairs on the leading axis"""


class Block(NamedTuple):
    """Some pairs: `left` and `right` keypoint of their matches, one pair after another, as places in all keypoints;
    numbers of matches and focal lengths of the pairs."""

    left: Int[np.ndarray, "match"]
    right: Int[np.ndarray, "match"]
    lengths: Int[np.ndarray, "pair"]
    focal_left: Float[np.ndarray, "pair"]
    focal_right: Float[np.ndarray, "pair"]


def oriented(
    lengths: list[int],
    read: Callable[[list[int]], Block],
    points: PhotoPoints,
    sigma: float,
    told: Callable[[int], None],
) -> Iterator[tuple[list[int], Found]]:
    """Blocks of pairs, not in order: their places in `lengths` (their numbers of matches), and what was found.

    `read` gives the pairs at these places; `points` are all keypoints; `told` hears how many pairs are done.
    """
    done = 0
    for size, members in buckets(lengths).items() if lengths else ():
        most = max(1, TOGETHER // size)
        for begin in range(0, len(members), most):
            part = members[begin : begin + most]
            found = _found(read(part), points, size, sigma, lambda count, before=done: told(before + count))
            done += len(part)
            told(done)
            yield part, found


def _found(block: Block, points: PhotoPoints, size: int, sigma: float, told: Callable[[int], None]) -> Found:
    width = SEARCHED if size > FEW else FEW
    few, every = batch(block, points, width, sigma), batch(block, points, size, sigma)
    without_repeats(few)
    repeats = without_repeats(every)
    found, sure = _by(EIGHT, few, every, told)
    rest = np.flatnonzero(~(sure & (found.kind == Kind.oriented)) & (found.kind != Kind.too_few))
    if rest.size:
        again, sure_now = _by(FIVE, *(tuple(a[rest] for a in fields) for fields in (few, every)), lambda count: None)
        take = ~sure[rest] | (np.sum(again.kept, axis=1) >= np.sum(found.kept[rest], axis=1))
        for old, new in zip(jax.tree.leaves((found, sure)), jax.tree.leaves((again, sure_now)), strict=True):
            old[rest[take]] = new[take]
    found.kind[~sure & (found.kind != Kind.too_few)] = Kind.no_consensus
    found.kept[found.kind >= Kind.no_consensus] = False
    for row, like in repeats.items():
        found.kept[row] = found.kept[row, like]
    return found


def _by(search: Ransac, few: Fields, every: Fields, told: Callable[[int], None]) -> tuple[Found, np.ndarray]:
    """What was found by this search, and where it sufficed."""
    heard = lambda done, total: told(done)
    settings = FAST if search is EIGHT else QUICK  # few pairs need another search
    pose, tried = spread(few, Program(_all_searched, {"search": search}, settings), Way(slab=PAIRS), 1, heard)
    chunk = max(1, IN_CACHE // every[0].shape[1])
    found = spread((every, pose), Program(_all_judged, {"chunk": chunk}), Way(slab=PAIRS), chunk)
    return found, suffices(search, tried, np.sum(found.kept, axis=1), np.sum(every[5], axis=1))


def _all_searched(fields: tuple, *, search: Ransac) -> tuple:
    # subsets of one pair are work enough, and no pair waits for another one
    return chunked(lambda fields: searched(Pair(*fields), search), fields, 1)


def _all_judged(found: tuple, *, chunk: int) -> Found:
    return chunked(lambda found: judged(Pair(*found[0]), found[1]), found, chunk)


def without_repeats(fields: Fields) -> dict[int, Int[np.ndarray, "place"]]:
    """Masks, in place, what repeats an earlier match of its pair: it is no evidence of its own. Of the pairs where this
    happens, the place that every place is like."""
    *coordinates, _, there = fields[:6]
    found = {}
    # what repeats another match is like it in any number made of them: one that is cheap, then one that tells
    rows = _twice(coordinates[0].astype(np.float32), there)
    mixed = np.sum([c[rows] * (k + 0.1) ** 0.5 for k, c in enumerate(coordinates)], axis=0)
    rows = rows[_twice(mixed, there[rows])]
    for row in rows.tolist():
        points = np.stack([*(c[row] for c in coordinates), ~there[row]])
        _, first, which = np.unique(points, axis=1, return_index=True, return_inverse=True)
        found[row] = first[which.reshape(-1)]
        there[row] &= found[row] == np.arange(there.shape[1])
    return found


def _twice(key: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The rows in which a number stands twice."""
    np.copyto(key, np.arange(2**20, 2**20 + there.shape[1], dtype=key.dtype), where=~there)
    key.sort(axis=1)
    return np.flatnonzero(np.any(key[:, 1:] == key[:, :-1], axis=1))


def batch(block: Block, points: PhotoPoints, size: int, sigma: float) -> Fields:
    """The fields of the pairs padded to `size`, or `size` of their matches, evenly taken.

    A match with a keypoint that no ray is seen at is masked. The sigma of a match is that of the keypoints times the
    root mean square of their scales.
    """
    if not len(points.x):  # places without a match need one to point to
        points = PhotoPoints(*(np.zeros(1, a.dtype) for a in points))
    n, j = block.lengths[:, None], np.arange(size)[None, :]
    begin = np.cumsum(block.lengths)[:, None] - n
    there = j < n
    taken = np.where(n <= size, j, (j * n + n // 2) // size) if np.any(n > size) else j
    place = np.where(there, begin + taken, 0)
    left, right = (np.append(side, 0)[place] for side in (block.left, block.right))  # there may be none
    there = there & points.seen[left] & points.seen[right]
    # in place, since the system zeroes every page of a new array
    square = points.scale[left] ** 2
    square += points.scale[right] ** 2
    square /= 2
    coordinates = [points.x[left], points.y[left], points.x[right], points.y[right]]
    scale = np.sqrt(square, out=square)
    scale *= sigma
    nowhere = ~there
    for values, empty in (*((c, 0.0) for c in coordinates), (scale, 1.0)):
        np.copyto(values, empty, where=nowhere)
    return *coordinates, scale, there, block.focal_left, block.focal_right
