"""Pairs of photos with points in common, of a block that is measured photo by photo.

A block is chained from pairs. Of a strip these are few; of a network in which every photo
sees every point they are all, of which each photo needs a dozen: those with the most
points in common.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..batches.ragged import Ragged
from .measured_block import MeasuredBlock, pairs_of_rays

FEWEST = 6
"""Points that a pair needs in common: one more than its elements."""

PARTNERS = 12
"""Pairs of each photo: among fewer all may be taken from one station."""


class CommonPoints(NamedTuple):
    """Points in common of pairs of photos, row by row: pair k of the photos `left` and
    `right` has the rows begins[k] to begins[k + 1], each the numbers of two rays."""

    left: Int[np.ndarray, " pair"]
    right: Int[np.ndarray, " pair"]
    begins: Int[np.ndarray, " ends"]
    one: Int[np.ndarray, " row"]
    other: Int[np.ndarray, " row"]

    @property
    def counts(self) -> Int[np.ndarray, " pair"]:
        """How many points the photos of each pair have in common."""
        return np.diff(self.begins)

    def take(self, pairs: Int[np.ndarray, " some"]) -> "CommonPoints":
        """Some of the pairs, in this order."""
        counts = self.counts[pairs]
        begins = np.append(0, np.cumsum(counts))
        rows = np.repeat(self.begins[pairs] - begins[:-1], counts)
        rows = rows + np.arange(len(rows))
        return CommonPoints(
            self.left[pairs],
            self.right[pairs],
            begins,
            self.one[rows],
            self.other[rows],
        )

    def as_pairs(self, block: MeasuredBlock) -> Ragged:
        """The pairs with the places of a block."""
        return pairs_of_rays(
            block, self.begins, self.one, self.other, self.left, self.right
        )


def common_points(
    photo: Int[np.ndarray, " ray"], point: Int[np.ndarray, " ray"], photos: int
) -> CommonPoints:
    """All pairs of photos that see a point in common, left before right, of rays by the
    numbers of their photo and their point."""
    by_point = np.lexsort((photo, point))
    point, rows = point[by_point], []
    for lag in range(1, len(point)):
        same = np.flatnonzero(point[lag:] == point[:-lag])
        if len(same) == 0:
            break
        rows.append(np.stack([by_point[same], by_point[same + lag]]))
    one, other = np.concatenate([np.zeros((2, 0), int), *rows], axis=1)
    key = photo[one] * photos + photo[other]
    by_pair = np.argsort(key, kind="stable")
    keys, begins = np.unique(key[by_pair], return_index=True)
    left, right = np.divmod(keys, max(photos, 1))
    begins = np.append(begins, len(key))
    return CommonPoints(left, right, begins, one[by_pair], other[by_pair])


def choose_pairs(common: CommonPoints, photos: int) -> CommonPoints:
    """The pairs that a chain of all photos needs: of each photo those `PARTNERS` with
    the most points in common, and those that join the photos most firmly."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    counts = common.counts
    use = np.flatnonzero(counts >= FEWEST)
    order = use[np.argsort(-counts[use], kind="stable")]
    ends = np.stack([common.left[order], common.right[order]]).T.reshape(-1)
    # of each photo its pairs in the order of their counts
    by_photo = np.argsort(ends, kind="stable")
    first = np.searchsorted(ends[by_photo], np.arange(photos))
    rank = np.empty(len(ends), int)
    rank[by_photo] = np.arange(len(ends)) - first[ends[by_photo]]
    kept = np.min(rank.reshape(-1, 2), axis=1, initial=len(ends)) < PARTNERS
    chosen = np.zeros(len(counts), bool)
    chosen[order[kept]] = True
    edges = common.left[use], common.right[use]
    tree = minimum_spanning_tree(coo_array((1 / counts[use], edges), (photos, photos)))
    joined = tree.tocoo()
    number = np.searchsorted(
        common.left * photos + common.right,
        np.asarray(joined.row) * photos + np.asarray(joined.col),
    )
    chosen[number] = True
    return common.take(np.flatnonzero(chosen))
