"""An adjusted block by other ways: the conditions of the 1982 fragment, and the classical
adjustment of independent models."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Int

from ..adjustment import RESULTS
from ..block.classical_comparison import Compared, compare_estimators
from ..block.conditions import ConditionAdjustment, adjust_conditions
from ..block.measured_block import Ground
from ..reports.block_model import Done
from ..tables.fields import TableError

Found = TypeVar("Found")

NEIGHBOURS = 0.7
"""Part of the points of the best pair of a photo that one of neighbours has."""


def by_conditions(done: Done) -> ConditionAdjustment:
    """The same rays and known coordinates by conditions. Raises TableError where the
    block is too large for them."""
    adjusted = done.adjusted
    block = adjusted.block.without(done.oriented.wrong.rays)
    call = lambda: adjust_conditions(block, adjusted.as_start, adjusted.ground)
    found = _refusing("--conditions", call)
    if found.result != RESULTS.successful:
        raise TableError(
            "--conditions",
            found=RESULTS[found.result],
            expected="a block whose photos are joined by points on neighbouring photos",
        )
    return found


def classically(
    done: Done,
    left: Sequence[str],
    right: Sequence[str],
    points: Int[np.ndarray, " pair"],
) -> list[Compared]:
    """The classical adjustment of neighbouring photos, by several weights, beside the
    rigorous one. Raises TableError where the block is too large."""
    adjusted, ground = done.adjusted, done.adjusted.ground
    assert ground is not None
    use = done.oriented.usable & _are_neighbours(left, right, points)
    usable = np.flatnonzero(use).tolist()
    block = adjusted.block.without(done.oriented.wrong.rays)
    call = lambda: compare_estimators(
        block,
        adjusted.as_start,
        _whole(ground),
        [left[k] for k in usable],
        [right[k] for k in usable],
    )
    return _refusing("--classical", call)


def _are_neighbours(
    left: Sequence[str], right: Sequence[str], points: Int[np.ndarray, " pair"]
) -> Bool[np.ndarray, " pair"]:
    """Pairs with not much fewer points than any other pair of one of their photos: small
    overlaps make weak models, which nobody would take."""
    most: dict[str, int] = {}
    for photos in (left, right):
        for name, number in zip(photos, points.tolist(), strict=True):
            most[name] = max(most.get(name, 0), number)
    both = zip(left, right, strict=True)
    largest = np.array([min(most[a], most[b]) for a, b in both])
    return points >= NEIGHBOURS * largest


def _whole(ground: Ground) -> Ground:
    """The points that take part: no check points, and no stations."""
    keep = np.flatnonzero(~(ground.check | ground.station))
    return Ground(
        tuple(ground.points[k] for k in keep),
        *(column[keep] for column in ground[1:]),
    )


def _refusing(option: str, call: Callable[[], Found]) -> Found:
    """What a call returns; what it refuses as a TableError."""
    try:
        return call()
    except (ValueError, RuntimeError) as error:
        raise TableError(
            option, found=str(error).partition(": ")[2] or str(error), expected="less"
        ) from None
