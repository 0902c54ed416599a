"""A photo that is wrong as a whole: each place has the name of the row before or after
it, or it is the mirror image of a photo.

Such a photo fits no other one, and no place of it is worse than the rest. Under each
hypothesis the pairs of the photo are oriented anew: where nearly all of their points fit
then, and few did before, it is the cause. Names are moved by one row of the list in which
they came, or of the list by name; of places in a list of no order nothing is found.
"""

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int, Shaped

from ..batches.ragged import Ragged
from .chain import Oriented
from .columns import Cause
from .measured_block import MeasuredBlock, pairs_of_rays

FEW = 0.7
"""Part of the points of a photo's pairs up to which the photo may be wrong."""

NEARLY_ALL = 0.8
"""Part of them that has to fit under a hypothesis; and part of the points of a
refused pair with which it joins photos that nothing else joins."""

FEWEST = 8
"""Points of its pairs that can tell."""

TRIED = 2
"""Photos that are tried."""


class Mended(NamedTuple):
    """The block with a photo as it should be, all pairs oriented with it, and the
    cause."""

    block: MeasuredBlock
    oriented: Oriented
    cause: Cause


def mend_photo(
    block: MeasuredBlock,
    left: Int[np.ndarray, " pair"],
    right: Int[np.ndarray, " pair"],
    oriented: Oriented,
    orient: Callable[[Ragged], Oriented],
    roughly: Callable[[Ragged], Ragged],
) -> Mended | None:
    """The block without what is wrong with one photo as a whole, None where nothing is.
    `left`, `right`: the photos of the pairs, whose names are `block`'s; `orient`: how
    pairs are oriented; `roughly`: pairs with standard deviations that cover all that may
    be wrong with a camera."""
    for photo in _suspects(len(block.photos), left, right, oriented):
        own = np.flatnonzero((left == photo) | (right == photo))
        some = partial(_pairs_of, left=left[own], right=right[own])
        # names and axes are right where nearly all points are about where they should be
        found = orient(roughly(some(block)))
        if _fitting(found) > NEARLY_ALL * np.sum(found.points):
            continue
        for mended, name, said in _hypotheses(block, photo):
            found = orient(some(mended))
            fitting, points = _fitting(found), int(np.sum(found.points))
            if fitting > NEARLY_ALL * points:
                told = f"{said} {fitting} of the {points} points of its pairs fit"
                every = _replace(oriented, own, found)
                return Mended(mended, every, Cause(name, told))
    return None


def _pairs_of(
    block: MeasuredBlock,
    left: Int[np.ndarray, " pair"],
    right: Int[np.ndarray, " pair"],
) -> Ragged:
    """The pairs of these photos of a block, by the points that they have in common."""
    ends = zip(left.tolist(), right.tolist(), strict=True)
    rows = [_common(block, one, other) for one, other in ends]
    begins = np.cumsum([0, *map(len, rows)])
    return pairs_of_rays(block, begins, *np.concatenate(rows).T, left, right)


def _fitting(oriented: Oriented) -> int:
    """The points that fit."""
    return int(np.sum(np.where(oriented.usable, oriented.kept, 0)))


def _suspects(
    photos: int,
    left: Int[np.ndarray, " pair"],
    right: Int[np.ndarray, " pair"],
    oriented: Oriented,
) -> list[int]:
    """The photos in whose pairs few points fit, the worst first."""
    points = np.asarray(oriented.points, float)
    fitting = np.where(oriented.usable, oriented.kept, 0.0)
    of_photo = lambda a: np.bincount(left, a, photos) + np.bincount(right, a, photos)
    with np.errstate(invalid="ignore"):
        part = of_photo(fitting) / of_photo(points)
    part = np.where(of_photo(points) >= FEWEST, part, np.inf)
    worst = np.argsort(part, kind="stable")[:TRIED]
    return worst[part[worst] <= FEW].tolist()


def _hypotheses(
    block: MeasuredBlock, photo: int
) -> Iterator[tuple[MeasuredBlock, str, str]]:
    """The block as it would be right, the name of what is wrong, and how a sentence on it
    begins."""
    name = block.photos[photo]
    y = np.where(block.photo == photo, -block.y, block.y)
    yield (
        block._replace(y=y),
        "photo_mirrored",
        f"Photo {name} is the mirror image of a photo: its x and y are exchanged, or one "
        "of its axes counts the other way; mirrored",
    )
    for point in _moved(block, photo):
        yield (
            block._replace(point=point),
            "names_moved",
            f"On photo {name} each place has the name of the row before or after it: "
            "moved by one row",
        )


def _moved(block: MeasuredBlock, photo: int) -> list[Int[np.ndarray, " ray"]]:
    """The points of all rays with those of a photo moved by a row, in either direction,
    in the order in which they came and in that of their names."""
    own = np.flatnonzero(block.photo == photo)
    natural = lambda k: [
        (int(part) if part.isdigit() else 0, part)
        for part in re.split(r"(\d+)", block.points[block.point[k]])
    ]
    found = []
    for rows in (own, np.array(sorted(own, key=natural), int)):
        for step in (1, -1):
            point = block.point.copy()
            point[rows] = np.roll(block.point[rows], step)
            found.append(point)
    return found


def _common(block: MeasuredBlock, one: int, other: int) -> Int[np.ndarray, "row 2"]:
    """The rays of two photos that show the same points."""
    rays = [np.flatnonzero(block.photo == photo) for photo in (one, other)]
    left, right = (block.point[own] for own in rays)
    _, *places = np.intersect1d(left, right, return_indices=True)
    return np.stack([own[k] for own, k in zip(rays, places, strict=True)], axis=1)


def _replace(
    oriented: Oriented, own: Int[np.ndarray, " some"], found: Oriented
) -> Oriented:
    """The oriented pairs with some of them replaced."""

    def put(
        before: Shaped[np.ndarray, "pair ..."], after: Shaped[np.ndarray, "some ..."]
    ) -> Shaped[np.ndarray, "pair ..."]:
        changed = np.array(before)
        changed[own] = after
        return changed

    return jax.tree.map(put, oriented, found)
