"""A block from its pairs alone to the adjusted block on the ground."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..batches.ragged import Ragged, clean_ragged
from ..rejection import Recommended, Rejection
from .adjust import BlockAdjustment
from .chain import Chained, Oriented, chain, intersect, models_of
from .measured_block import Ground, MeasuredBlock, from_pairs
from .network import Start
from .place import Placed, on_ground, place
from .wrong import Wrong, adjust_without_wrong


class OrientedBlock(NamedTuple):
    """The adjusted block; what was left out as wrong; how its known points fitted
    before the adjustment (None: a free network); and which pairs could be oriented."""

    adjusted: BlockAdjustment
    wrong: Wrong
    placed: Placed | None
    usable: Bool[np.ndarray, " pair"]


def orient_block(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    points: Sequence[str],
    ground: Ground | None = None,
    more: MeasuredBlock | None = None,
    level: float = 0.05,
) -> OrientedBlock:
    """Orient the pairs without their wrong points, chain them, place them on the ground,
    and adjust everything, without what is wrong.

    `left`, `right`: the photos of each pair, in any order and direction; `points`: the
    names of all rows of `pairs`; `more`: the block with further rays, such as known
    points on one photo; `level`: the probability that anything is called wrong if
    nothing is. Without `ground` the network is free, its base lengths as the
    chain has them. Raises `Unjoined` and `TooLittleControl` with what is missing.
    """
    block = from_pairs(left, right, pairs, points) if more is None else more
    number = {name: k for k, name in enumerate(block.photos)}
    oriented = Oriented(*clean_ragged(pairs, Recommended(), select=_read)[0])
    models = models_of(
        np.array([number[name] for name in left]),
        np.array([number[name] for name in right]),
        oriented,
    )
    chained = chain(block, models)
    placed = None
    if ground is not None:
        placed = place(block, chained, ground)
        chained = on_ground(chained, placed)
        at = np.where(placed.wrong[:, None], np.nan, ground.coordinates)
        ground = ground._replace(coordinates=at)
    start = start_from(block, chained)
    adjusted, wrong = adjust_without_wrong(block, start, ground, level)
    if placed is not None:
        wrong = wrong._replace(control=wrong.control | placed.wrong[:, None])
    return OrientedBlock(adjusted, wrong, placed, np.asarray(oriented.usable))


def _read(rejection: Rejection) -> tuple[tuple, tuple]:
    """The `Oriented` of a pair, and nothing of its points."""
    found = rejection.orientation
    return (found.pose, found.cofactor, found.usable), ()


def start_from(block: MeasuredBlock, chained: Chained) -> Start:
    """Stations as they are, points from their rays."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(chained.rotations).as_quat().T
    quaternions = np.stack([w, x, y, z], axis=1)
    return Start(quaternions, chained.centres, intersect(block, chained))
