"""From pairs in any order to an adjusted block."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from ..batches.ragged import Ragged, clean_ragged
from ..orientation.axes import tell_field
from ..rejection import Recommended, Rejection
from .adjust import BlockAdjustment
from .adjust_chained import Outcome, adjust_chained
from .bars import Bars, NoBar
from .chain import Chained, Oriented, chain, models_of
from .columns import Cause
from .components import Component
from .contest import OF_MEASUREMENT, find_cause, is_misplaced
from .contradictions import contradictions, is_suspicious, stands_under_ground
from .given import Given, Wrong
from .inner import Inner
from .measured_block import Ground, MeasuredBlock, from_pairs
from .place import Placed, TooLittleControl


class OrientedBlock(NamedTuple):
    """The adjusted block; what was left out as wrong; the variance components, factors
    of the stated standard deviations; how its known points fitted before the adjustment
    (None: a free network); and which pairs could be oriented.

    `contradictions`: what of that which was given does not fit as a whole, in sentences,
    and the `cause` after which all of it fits. With either of them the numbers are not to
    be used, and what was left out is no more likely to be wrong than the rest.
    """

    adjusted: BlockAdjustment
    wrong: Wrong
    components: dict[str, Component]
    placed: Placed | None
    usable: Bool[np.ndarray, " pair"]
    contradictions: tuple[str, ...] = ()
    cause: Cause | None = None


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
    sigma_known: bool = True,
) -> OrientedBlock:
    """Orient the pairs without their wrong points, chain them, place them on the ground,
    and adjust everything, without what is wrong.

    `left`, `right`: the photos of each pair, in any order and direction; `points`: the
    names of all rows of `pairs`; `more`: the block with further rays, such as known
    points on one photo; `inner`: the inner parameters of the cameras that are unknown;
    `bars`: known distances;
    `level`: the probability that anything is called wrong if nothing is; `components`:
    adjust with the standard deviations of places, known points and known stations as
    the residuals tell them; `sigma_known`: whether sigma0 is to be 1. Without `ground`
    the network is free, its base lengths as the chain has them. Raises `Unjoined`,
    `TooLittleControl` and `NoBar` with what is missing.
    """
    block = from_pairs(left, right, pairs, points) if more is None else more
    if bars is not None and not np.any(bars.are_in(block)):
        raise NoBar("orient_block: no bar has both of its points in the block")
    chained, usable = chain_pairs(block, left, right, pairs)
    given = Given(block, ground, inner, bars)
    judged = adjust_and_judge(given, chained, level, components, sigma_known)
    return OrientedBlock(*judged.outcome, usable, judged.contradictions, judged.cause)


class Judged(NamedTuple):
    """An adjusted block, what of that which was given does not fit as a whole, and the
    cause after which all of it fits. `outcome` is that of what was given; where this
    could not be adjusted, that under the cause."""

    outcome: Outcome
    contradictions: tuple[str, ...] = ()
    cause: Cause | None = None


def adjust_and_judge(
    given: Given,
    chained: Chained,
    level: float = 0.05,
    components: bool = False,
    sigma_known: bool = True,
) -> Judged:
    """Adjust a chained block and, where much of what was given does not fit, look for
    the cause. Raises `TooLittleControl`."""
    outcome, refused, suspicious = None, None, True
    try:
        outcome = adjust_chained(given, chained, level, components)
    except TooLittleControl as error:
        refused = error
    if outcome is not None:
        rest = given, outcome.adjusted, outcome.wrong
        suspicious = is_suspicious(*rest, sigma_known=sigma_known)
        of_ground = bool(np.any(outcome.wrong.control)) or stands_under_ground(
            outcome.adjusted
        )
        if not (suspicious or of_ground or is_misplaced(given, chained)):
            return Judged(outcome)
    cause, explained = _of_field(given), None
    if cause is None:
        found = find_cause(
            given,
            chained,
            outcome,
            level,
            sigma_known=sigma_known,
            ground_alone=not suspicious,
        )
        cause, explained = (None, None) if found is None else found
    outcome = explained if outcome is None else outcome
    if outcome is None:
        assert refused is not None
        raise refused
    rest = given, outcome.adjusted, outcome.wrong
    against = contradictions(*rest, sigma_known=sigma_known)
    if cause is not None and cause.name in OF_MEASUREMENT and not against:
        cause = cause._replace(is_hint=True)
    return Judged(outcome, tuple(against), cause)


def _of_field(given: Given) -> Cause | None:
    """A focal length in another unit than the places."""
    block = given.block
    places = np.stack([block.x, block.y], axis=1) / block.focal[block.photo][:, None]
    told = tell_field(places, 1.0)
    if told is None:
        return None
    return Cause("out_of_field", told[0].upper() + told[1:].rstrip(".?"))


def chain_pairs(
    block: MeasuredBlock, left: Sequence[str], right: Sequence[str], pairs: Ragged
) -> tuple[Chained, Bool[np.ndarray, " pair"]]:
    """The photos of a block, chained by their pairs without wrong points, and which of
    the pairs could be oriented. Raises `Unjoined`."""
    number = {name: k for k, name in enumerate(block.photos)}
    oriented = Oriented(*clean_ragged(pairs, Recommended(), read=_read)[0])
    models = models_of(
        np.array([number[name] for name in left]),
        np.array([number[name] for name in right]),
        oriented,
    )
    return chain(block, models), np.asarray(oriented.usable)


def _read(_: Any, rejection: Rejection) -> tuple[tuple, tuple]:
    """The `Oriented` of a pair, and nothing of its points."""
    found = rejection.orientation
    return (found.pose, found.cofactor, found.usable), ()
