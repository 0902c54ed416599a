"""The matched pairs of a database as padded batches, through search and judgement on all cores."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int, PyTree

from ..pairs import Pair
from ..programs import Program
from ..rejection.ransac import Ransac
from .buckets import buckets
from .colmap_cameras import PhotoPoints
from .colmap_orientation import EIGHT, FIVE, SEARCHED, Found, judged, searched

TOGETHER = 2_000_000
"""Matches in memory at once, padding included: some 300 MB."""

IN_CACHE = 16_384
"""Matches in one call: what stays in the cache of a core."""

FEW = 64
"""Matches to which shorter pairs are padded for a search."""

Matches = Int[np.ndarray, "match 2"]


class Photo(NamedTuple):
    """An image: its keypoints and the focal length of their coordinates."""

    points: PhotoPoints
    focal: float


class Matched(NamedTuple):
    """Two images and the places of the keypoints that are matched."""

    left: Photo
    right: Photo
    matches: Matches


def oriented(
    lengths: list[int], matched: Callable[[list[int]], Iterator[Matched]], sigma: float, told: Callable[[int], None]
) -> Iterator[tuple[list[int], list[Matched], Found]]:
    """Blocks of pairs, not in order: their places in `lengths` (their numbers of matches), the pairs, what was found.

    `matched` reads the pairs at these places; `told` hears how many are done.
    """
    done = 0
    for size, members in buckets(lengths).items() if lengths else ():
        most = max(1, TOGETHER // size)
        for begin in range(0, len(members), most):
            part = members[begin : begin + most]
            pairs = list(matched(part))
            found = _found(pairs, size, sigma, lambda count, before=done: told(before + count))
            done += len(part)
            told(done)
            yield part, pairs, found


def _found(pairs: list[Matched], size: int, sigma: float, told: Callable[[int], None]) -> Found:
    width = SEARCHED if size > FEW else FEW
    few = batch([one._replace(matches=_thinned(one.matches)) for one in pairs], width, sigma)
    pose, enough = _each(_all_searched, few, IN_CACHE // 4 // width, told, search=EIGHT)
    rest = np.flatnonzero(~enough & (np.sum(few.mask, axis=1) > FIVE.hypotheses.size))
    if rest.size:
        again = _each(_all_searched, jax.tree.map(lambda a: a[rest], few), IN_CACHE // 8 // width, None, search=FIVE)
        for target, new in zip(jax.tree.leaves((pose, enough)), jax.tree.leaves(again), strict=True):
            target[rest] = new
    every = batch(pairs, size, sigma)
    return _each(_all_judged, (every, pose, enough), max(1, IN_CACHE // size), None)


def _all_searched(pairs: Pair, *, search: Ransac) -> tuple:
    return jax.vmap(lambda pair: searched(pair, search))(pairs)


def _all_judged(found: tuple) -> Found:
    return jax.vmap(judged)(*found)


def _thinned(matches: Matches) -> Matches:
    """At most SEARCHED of them, evenly taken."""
    n = len(matches)
    return matches if n <= SEARCHED else matches[(np.arange(SEARCHED) * n + n // 2) // SEARCHED]


def batch(pairs: list[Matched], size: int, sigma: float) -> Pair:
    """The pairs padded to `size`; a match with a keypoint that no ray is seen at is masked.

    Its sigma is that of the keypoints times the root mean square of their scales.
    """
    shape = (len(pairs), size)
    coordinates = [np.zeros(shape) for _ in range(4)]
    deviation, mask = np.ones(shape), np.zeros(shape, bool)
    for i, (left, right, matches) in enumerate(pairs):
        n = len(matches)
        a, b = matches[:, 0], matches[:, 1]
        p, q = left.points, right.points
        for target, source in zip(coordinates, (p.x[a], p.y[a], q.x[b], q.y[b]), strict=True):
            target[i, :n] = source
        mask[i, :n] = p.seen[a] & q.seen[b]
        deviation[i, :n] = sigma * np.sqrt((p.scale[a] ** 2 + q.scale[b] ** 2) / 2)
    deviation = np.where(mask, deviation, 1.0)
    focals = [np.array([photo.focal for photo in photos]) for photos in zip(*((p.left, p.right) for p in pairs))]
    return Pair(*coordinates, deviation, mask, *focals)


def _each(function: Callable, data: PyTree, chunk: int, told: Callable[[int], None] | None, **options) -> PyTree:
    """function(data) in chunks of one size on all cores, as NumPy arrays; the last chunk repeats its last row."""
    total = len(jax.tree.leaves(data)[0])
    run = Program(function, options)

    def part(begin: int) -> list[np.ndarray]:
        rows = np.minimum(np.arange(begin, begin + chunk), total - 1)
        return jax.tree.map(np.asarray, run(jax.tree.map(lambda a: a[rows], data)))

    first = part(0)  # alone, so that it is compiled once
    out = jax.tree.map(lambda a: np.empty((total, *a.shape[1:]), a.dtype), first)
    done = 0

    def store(begin: int) -> int:
        end = min(begin + chunk, total)
        for target, new in zip(jax.tree.leaves(out), jax.tree.leaves(part(begin) if begin else first), strict=True):
            target[begin:end] = new[: end - begin]
        return end - begin

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for count in pool.map(store, range(0, total, chunk)):
            done += count
            if told is not None:
                told(done)
    return out
