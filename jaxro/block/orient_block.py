"""From pairs in any order to an adjusted block."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from ..batches.ragged import Ragged, clean_ragged
from ..batches.table_noise import estimate
from ..camera.inner import Inner
from ..geometry.pairs import Pair
from ..orientation.axes import tell_field
from ..rejection import Recommended, Rejection
from .adjust import BlockAdjustment
from .adjust_chained import Outcome, adjust_chained
from .bars import Bars, NoBar
from .chain import Chained, Oriented, Unjoined, chain, models_of
from .columns import Cause
from .components import Component
from .confusable import tell_confusable
from .contest import HARMLESS, find_cause, is_misplaced
from .contradictions import contradictions, is_suspicious, stands_under_ground
from .exchanged import tell_exchanged
from .given import Given, Wrong
from .measured_block import Ground, MeasuredBlock, from_pairs
from .place import Placed, TooLittleControl
from .wrong_photo import NEARLY_ALL, mend_photo

MOVED = 3.0
"""Deviations of a point by which a cause moves it at most, if the numbers without the
cause may be used."""

LENS = 1e-3
"""Part of the focal length that the errors of a place by unknown inner parameters are
taken for where pairs are oriented for a start."""

TOO_SMALL = 3.0
"""Ratio of the residuals to the given standard deviations from which these are the
reason why pairs are refused."""


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
    start = pairs if inner is None else without_lens(pairs)
    joined = join_pairs(block, left, right, start)
    given = Given(joined.block, ground, inner, bars)
    judged = adjust_and_judge(given, joined.chained, level, components, sigma_known)
    cause = joined.cause or judged.cause
    return OrientedBlock(*judged.outcome, joined.usable, judged.contradictions, cause)


def without_lens(pairs: Ragged) -> Ragged:
    """The pairs with standard deviations that cover what unknown inner parameters, bent
    film, or deviations that are too small do to their places."""
    focal = np.repeat(np.minimum(pairs.focal_left, pairs.focal_right), pairs.lengths)
    return pairs._replace(sigma=np.maximum(pairs.sigma, LENS * focal))


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
        # the field of the cameras is known from here on
        given = given._replace(inner=outcome.adjusted.inner)
        rest = given, outcome.adjusted, outcome.wrong
        suspicious = is_suspicious(*rest, sigma_known=sigma_known)
        of_ground = bool(np.any(outcome.wrong.control)) or stands_under_ground(
            outcome.adjusted
        )
        if not (suspicious or of_ground or is_misplaced(given, chained)):
            return Judged(outcome, cause=_of_points(given, outcome, level))
    cause, explained = _of_field(given.block), None
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
    if cause is not None and cause.name in HARMLESS and not against:
        untrue = explained is not None and _is_moved(outcome, explained)
        cause = cause._replace(is_hint=not untrue)
    if cause is None and not against:
        cause = _of_points(given, outcome, level)
    return Judged(outcome, tuple(against), cause)


def _of_points(given: Given, outcome: Outcome, level: float) -> Cause | None:
    """What is wrong with single points of a block that fits as a whole."""
    return tell_confusable(given, outcome, level) or tell_exchanged(outcome.adjusted)


def _is_moved(outcome: Outcome, explained: Outcome) -> bool:
    """Whether a point lies elsewhere once the cause is allowed for, farther than its
    deviations say."""
    found = outcome.adjusted
    off = explained.adjusted.coordinates - found.coordinates
    return bool(np.any(np.abs(off) > MOVED * found.deviations))


def _of_noise(pairs: Ragged, oriented: Oriented) -> Cause | None:
    """Standard deviations that are far smaller than the residuals of the pairs, which
    are asked for only where points were left out of them."""
    if np.sum(oriented.kept) > NEARLY_ALL * np.sum(oriented.points):
        return None
    try:
        noise = estimate(pairs)
    except ValueError:
        return None
    if noise.sigma < TOO_SMALL:
        return None
    return Cause(
        "sigma",
        f"The residuals of the pairs are {noise.sigma:.2g} times the standard deviations "
        "that are given: are sigma and the focal length in the unit of the coordinates?",
    )


def _of_field(block: MeasuredBlock) -> Cause | None:
    """A focal length in another unit than the places."""
    places = np.stack([block.x, block.y], axis=1) / block.focal[block.photo][:, None]
    told = tell_field(places, 1.0)
    if told is None:
        return None
    return Cause("out_of_field", told[0].upper() + told[1:].rstrip(".?"))


class Joined(NamedTuple):
    """The photos of a block chained by their pairs, which of these could be oriented,
    and what is wrong with a photo as a whole: the block then has it as it should be."""

    block: MeasuredBlock
    chained: Chained
    usable: Bool[np.ndarray, " pair"]
    cause: Cause | None = None


def join_pairs(
    block: MeasuredBlock, left: Sequence[str], right: Sequence[str], pairs: Ragged
) -> Joined:
    """The photos of a block, chained by their pairs without wrong points. Raises
    `Unjoined`, with the reason where it is one of the focal length or of sigma."""
    number = {name: k for k, name in enumerate(block.photos)}
    ends = [np.array([number[name] for name in side], int) for side in (left, right)]
    oriented, cause = _orient(pairs), None
    mended = mend_photo(block, *ends, oriented, _orient, without_lens)
    if mended is not None:
        block, oriented, cause = mended
    try:
        chained = chain(block, models_of(*ends, oriented))
    except Unjoined:
        chained = _chain_roughly(block, ends, pairs, oriented)
    return Joined(block, chained, np.asarray(oriented.usable), cause)


def _chain_roughly(
    block: MeasuredBlock,
    ends: list[Int[np.ndarray, " pair"]],
    pairs: Ragged,
    oriented: Oriented,
) -> Chained:
    """The photos of a block chained by pairs that are refused as well, or oriented with
    standard deviations that cover nearly all that may be wrong with a camera: approximate
    values need no verdict, and the block is judged as a whole. Raises `Unjoined`."""
    try:
        more = oriented._replace(usable=_nearly_usable(oriented))
        return chain(block, models_of(*ends, more))
    except Unjoined as error:
        refused = error
    rough = _orient(without_lens(pairs))
    try:
        return chain(block, models_of(*ends, rough))
    except Unjoined:
        reason = _of_field(block) or _of_noise(pairs, oriented)
        if reason is None:
            raise refused from None
        raise Unjoined(refused.photos, reason.sentence) from None


def _nearly_usable(oriented: Oriented) -> Bool[np.ndarray, " pair"]:
    """The pairs that may be used, and those refused although nearly all of their points
    fit a pose that has deviations."""
    told = np.all(np.isfinite(np.asarray(oriented.cofactor)), axis=(1, 2))
    fit = np.asarray(oriented.kept) > NEARLY_ALL * np.asarray(oriented.points)
    return np.asarray(oriented.usable) | (told & fit)


def _orient(pairs: Ragged) -> Oriented:
    """The pairs oriented without their wrong points."""
    return Oriented(*clean_ragged(pairs, Recommended(), read=_read)[0])


def _read(pair: Pair, rejection: Rejection) -> tuple[tuple, tuple]:
    """The `Oriented` of a pair, and nothing of its points."""
    found = rejection.orientation
    kept, points = jnp.sum(rejection.mask, axis=-1), jnp.sum(pair.mask, axis=-1)
    return (found.pose, found.cofactor, found.usable, kept, points), ()
