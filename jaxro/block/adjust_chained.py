"""A chained block adjusted on the ground: placed by its known points, without what is
wrong."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..adjustment import RESULTS
from .adjust import BlockAdjustment
from .chain import Chained, intersect
from .components import (
    GROUPS,
    Component,
    adjust_with_components,
    components_of,
    multiply,
)
from .field_choice import with_field
from .given import Given, Wrong
from .measured_block import Ground, MeasuredBlock
from .network import Start
from .place import Placed, on_ground, place
from .wrong import adjust_without_wrong, fits


class Outcome(NamedTuple):
    """The adjusted block; what was left out as wrong; the variance components, factors
    of the stated standard deviations; and how its known points fitted before the
    adjustment (None: a free network)."""

    adjusted: BlockAdjustment
    wrong: Wrong
    components: dict[str, Component]
    placed: Placed | None


def adjust_chained(
    given: Given, chained: Chained, level: float = 0.05, components: bool = False
) -> Outcome:
    """Place a chained block on the ground and adjust it without what is wrong; a network
    without known points keeps the scale of its chain, or has that of its bars.

    `components`: adjust with the standard deviations of places, known points and known
    stations as the residuals tell them. Raises `TooLittleControl`.
    """
    if given.ground is None:
        start = start_from(given.block, chained)
        return Outcome(*_adjust(given, start, level, components), None)
    placed = place(given.block, chained, given.ground)
    start = start_from(given.block, on_ground(chained, placed))
    rest = given._replace(ground=leave_out(given.ground, placed.wrong))
    adjusted, wrong, found = _adjust(rest, start, level, components)
    back = placed.wrong & fits(adjusted, given.ground, level)
    if np.any(back):
        # they stood out by the errors of the chain alone
        placed = placed._replace(wrong=placed.wrong & ~back)
        rest = given._replace(ground=leave_out(given.ground, placed.wrong))
        adjusted, wrong, found = _adjust(rest, adjusted.as_start, level, components)
    wrong = wrong._replace(control=wrong.control | placed.wrong[:, None])
    return Outcome(adjusted, wrong, found, placed)


def _adjust(
    given: Given, start: Start, level: float, components: bool
) -> tuple[BlockAdjustment, Wrong, dict[str, Component]]:
    """The adjustment without what is wrong, and its variance components; with them, if
    they are asked for, what is wrong is looked for once more."""
    given, start = with_field(given, start, level)
    adjusted, wrong = adjust_without_wrong(given, start, level)
    if not components or adjusted.result != RESULTS.successful:
        return adjusted, wrong, components_of(adjusted)
    _, found = adjust_with_components(given, adjusted.as_start, wrong)
    factors = dict.fromkeys(GROUPS, 1.0) | {n: one.factor for n, one in found.items()}
    weighted = multiply(given, factors)
    adjusted, wrong = adjust_without_wrong(weighted, adjusted.as_start, level)
    return adjusted, wrong, found


def leave_out(ground: Ground, rows: Bool[np.ndarray, " known"]) -> Ground:
    """The ground without what is known of some rows, which keep their numbers."""
    at = np.where(rows[:, None], np.nan, ground.coordinates)
    return ground._replace(coordinates=at)


def start_from(block: MeasuredBlock, chained: Chained) -> Start:
    """Stations as they are, points from their rays."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(chained.rotations).as_quat().T
    quaternions = np.stack([w, x, y, z], axis=1)
    return Start(quaternions, chained.centres, intersect(block, chained))
