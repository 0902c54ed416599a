"""The matched pairs of a database as padded batches, through the engine and the
classification on all cores."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ..batches.batch import clean_in_stages
from ..batches.buckets import buckets
from ..batches.padding import FEWER
from ..geometry.pairs import Pair
from ..xla.programs import Program
from ..xla.slabs import Split, map_chunks, spread
from .cameras import PhotoPoints
from .two_view import ENGINE, Found, Verdict, classified, verdict

TOGETHER = 2_000_000
"""Matches in memory at once, padding included: some 300 MB."""

PAIRS = 48
"""Pairs in one call of a program: enough to hide the .3 ms that a call costs, few
enough to share out among threads."""

ONE_BY_ONE = Split(slab=PAIRS, chunk=1)
"""A pair is work enough by itself: it waits for no other one, and without `vmap` the
programs compile a third sooner.
"""


class Block(NamedTuple):
    """Some pairs: `left` and `right` keypoint of their matches, one pair after another,
    as places in all keypoints; numbers of matches and focal lengths of the pairs."""

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
    """Blocks of pairs, not in order: their places in `lengths` (their numbers of
    matches), and what was found.

    `read` gives the pairs at these places; `points` are all keypoints; `told` hears how
    many pairs are done.
    """
    done = 0
    for size, members in buckets(lengths, FEWER).items() if lengths else ():
        most = max(1, TOGETHER // size)
        for begin in range(0, len(members), most):
            part = members[begin : begin + most]
            found = _found(
                read(part),
                points,
                size,
                sigma,
                lambda count, before=done: told(before + count),
            )
            done += len(part)
            told(done)
            yield part, found


def _found(
    block: Block,
    points: PhotoPoints,
    size: int,
    sigma: float,
    told: Callable[[int], None],
) -> Found:
    pairs = batch(block, points, size, sigma)
    verdicts = clean_in_stages(
        pairs, ENGINE, verdict, ONE_BY_ONE, lambda done, total: told(done)
    )
    return spread((pairs, verdicts), Program(_all_classified, {}), ONE_BY_ONE, 1)


def _all_classified(verdicts: tuple[Pair, Verdict]) -> Found:
    return map_chunks(lambda one: classified(*one), verdicts, 1)


def batch(block: Block, points: PhotoPoints, size: int, sigma: float) -> Pair:
    """The pairs padded to `size`, in NumPy.

    A match with a keypoint that no ray is seen at is masked. The sigma of a match is
    that of the keypoints times the root mean square of their scales.
    """
    if not len(points.x):  # places without a match need one to point to
        points = PhotoPoints(*(np.zeros(1, a.dtype) for a in points))
    n, j = block.lengths[:, None], np.arange(size)[None, :]
    begin = np.cumsum(block.lengths)[:, None] - n
    there = j < n
    place = np.where(there, begin + j, 0)
    left, right = (
        np.append(side, 0)[place] for side in (block.left, block.right)
    )  # there may be none
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
    fields = *coordinates, scale, there, block.focal_left, block.focal_right
    return jax.tree.map(np.asarray, Pair(*jax.device_put(fields)))
