"""A block from its pairs alone to the adjusted block on the ground."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from ..adjustment import RESULTS
from ..batches.ragged import Ragged, clean_ragged
from ..rejection import Recommended, Rejection
from .adjust import BlockAdjustment
from .bars import Bars
from .chain import Chained, Oriented, chain, intersect, models_of
from .components import (
    GROUPS,
    Component,
    adjust_with_components,
    components_of,
    multiply,
)
from .inner import Inner
from .measured_block import Ground, MeasuredBlock, from_pairs
from .network import Start
from .place import Placed, on_ground, place
from .wrong import Wrong, adjust_without_wrong, fits


class OrientedBlock(NamedTuple):
    """The adjusted block; what was left out as wrong; the variance components, factors
    of the stated standard deviations; how its known points fitted before the adjustment
    (None: a free network); and which pairs could be oriented."""

    adjusted: BlockAdjustment
    wrong: Wrong
    components: dict[str, Component]
    placed: Placed | None
    usable: Bool[np.ndarray, " pair"]


def orient_block(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    points: Sequence[str],
    ground: Ground | None = None,
    more: MeasuredBlock | None = None,
    *,
    inner: Inner | None = None,
    bars: Bars | None = None,
    level: float = 0.05,
    components: bool = False,
) -> OrientedBlock:
    """Orient the pairs without their wrong points, chain them, place them on the ground,
    and adjust everything, without what is wrong.

    `left`, `right`: the photos of each pair, in any order and direction; `points`: the
    names of all rows of `pairs`; `more`: the block with further rays, such as known
    points on one photo; `inner`: the inner parameters of the cameras that are unknown;
    `bars`: known distances;
    `level`: the probability that anything is called wrong if nothing is; `components`:
    adjust with the standard deviations of places, known points and known stations as
    the residuals tell them. Without `ground` the network is free, its base lengths as the
    chain has them. Raises `Unjoined` and `TooLittleControl` with what is missing.
    """
    block = from_pairs(left, right, pairs, points) if more is None else more
    number = {name: k for k, name in enumerate(block.photos)}
    oriented = Oriented(*clean_ragged(pairs, Recommended(), read=_read)[0])
    models = models_of(
        np.array([number[name] for name in left]),
        np.array([number[name] for name in right]),
        oriented,
    )
    chained = chain(block, models)
    usable = np.asarray(oriented.usable)
    rest = {"inner": inner, "bars": bars, "level": level, "components": components}
    adjust = partial(_adjust, block, **rest)
    if ground is None:
        start = start_from(block, chained)
        start = start if bars is None else to_bars(block, start, bars)
        return OrientedBlock(*adjust(start), None, usable)
    placed = place(block, chained, ground)
    start = start_from(block, on_ground(chained, placed))
    adjusted, wrong, found = adjust(start, leave_out(ground, placed.wrong))
    back = placed.wrong & fits(adjusted, ground, level)
    if np.any(back):
        # they stood out by the errors of the chain alone
        placed = placed._replace(wrong=placed.wrong & ~back)
        begin, known = adjusted.as_start, leave_out(ground, placed.wrong)
        adjusted, wrong, found = adjust(begin, known)
    wrong = wrong._replace(control=wrong.control | placed.wrong[:, None])
    return OrientedBlock(adjusted, wrong, found, placed, usable)


def _adjust(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None = None,
    *,
    inner: Inner | None,
    bars: Bars | None,
    level: float,
    components: bool,
) -> tuple[BlockAdjustment, Wrong, dict[str, Component]]:
    """The adjustment without what is wrong, and its variance components; with them, if
    they are asked for, what is wrong is looked for once more."""
    adjusted, wrong = adjust_without_wrong(block, start, ground, inner, bars, level)
    if not components or adjusted.result != RESULTS.successful:
        return adjusted, wrong, components_of(adjusted)
    known = None
    if ground is not None:
        at = np.where(wrong.control, np.nan, ground.coordinates)
        known = ground._replace(coordinates=at)
    start = adjusted.as_start
    rest = inner, wrong.rays, bars
    _, found = adjust_with_components(block, start, known, *rest)
    factors = dict.fromkeys(GROUPS, 1.0) | {n: one.factor for n, one in found.items()}
    block, ground, bars = multiply(block, ground, bars, factors)
    adjusted, wrong = adjust_without_wrong(block, start, ground, inner, bars, level)
    return adjusted, wrong, found


def leave_out(ground: Ground, rows: Bool[np.ndarray, " known"]) -> Ground:
    """The ground without what is known of some rows, which keep their numbers."""
    at = np.where(rows[:, None], np.nan, ground.coordinates)
    return ground._replace(coordinates=at)


def _read(_: Any, rejection: Rejection) -> tuple[tuple, tuple]:
    """The `Oriented` of a pair, and nothing of its points."""
    found = rejection.orientation
    return (found.pose, found.cofactor, found.usable), ()


def to_bars(block: MeasuredBlock, start: Start, bars: Bars) -> Start:
    """Approximate values in the scale of the bars: of the median of their ratios."""
    one, other = bars.numbers_in(block)
    there = (one >= 0) & (other >= 0)
    apart = start.points[one[there]] - start.points[other[there]]
    ratios = bars.length[there] / np.linalg.norm(apart, axis=1)
    scale = np.nanmedian(ratios) if np.any(np.isfinite(ratios)) else 1.0
    return start._replace(centres=start.centres * scale, points=start.points * scale)


def start_from(block: MeasuredBlock, chained: Chained) -> Start:
    """Stations as they are, points from their rays."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(chained.rotations).as_quat().T
    quaternions = np.stack([w, x, y, z], axis=1)
    return Start(quaternions, chained.centres, intersect(block, chained))
