"""Known points one of which is wrong, and nothing tells which.

Of four heights in the corners of a block one misclosure is left, its twist: each of them
explains it. So each known point that was left out is put back, and those that then stand
out as well are left out in its place, each one adjustment: where everything fits as well,
neither is accused.
"""

import numpy as np
from jaxtyping import Bool

from ..adjustment import RESULTS
from .adjust import BlockAdjustment
from .adjust_chained import Outcome
from .columns import Cause
from .given import Given, Wrong
from .place import TooLittleControl
from .wrong import adjust_rest, normalise_residuals
from .wrong_points import GAP

CLEARLY = 4 * GAP
"""By how much the sum of squares falls at least without a known point: below it the
error is so small that it hardly matters which one is left out."""

RELEVANT = 0.5
"""Part of the largest w of all known points, while the one that was left out takes part,
from which on another one may be wrong in its place."""


def tell_confusable(given: Given, outcome: Outcome, level: float) -> Cause | None:
    """The known points that cannot be told apart, in a sentence; None where there are
    none."""
    sets = find_confusable(given, outcome, level)
    if not sets:
        return None
    told = "; and one of ".join(", ".join(names) for names in sets)
    return Cause(
        "confusable",
        f"One of the known points {told} is wrong, and nothing tells which, as without "
        "any one of them everything fits: measure more of them",
    )


def find_confusable(given: Given, outcome: Outcome, level: float) -> list[list[str]]:
    """For each known point that was left out, itself or all its rays, and could be
    right: its name and those of the others without which everything fits as well."""
    if outcome.adjusted.result != RESULTS.successful:
        return []
    names = given.known.points
    found = []
    for k in np.flatnonzero(_left_out(given, outcome)).tolist():
        if others := _instead(given, outcome, k, level):
            found.append([names[k], *(names[j] for j in others)])
    return found


def _left_out(given: Given, outcome: Outcome) -> Bool[np.ndarray, " known"]:
    """The known points that were left out as wrong, themselves or all their rays."""
    ground, wrong, block = given.known, outcome.wrong, given.block
    number = ground.numbers_in(block)
    kept = np.bincount(block.point[~wrong.rays], minlength=len(block.points))
    lost = np.bincount(block.point[wrong.rays], minlength=len(block.points))
    without_rays = (kept[number] == 0) & (lost[number] > 0)
    there = (number >= 0) & ~ground.check & ~ground.station
    return there & (np.any(wrong.control, axis=1) | without_rays)


def _instead(given: Given, outcome: Outcome, k: int, level: float) -> list[int]:
    """The known points one of which may be wrong in place of the one that was left
    out."""
    ground, wrong = given.known, outcome.wrong
    control = wrong.control.copy()
    control[k] = False
    rays = wrong.rays & (given.block.point != ground.numbers_in(given.block)[k])
    back = wrong._replace(control=control, rays=rays)
    # the rays that come back have residuals, too
    most = _misfit(outcome.adjusted) + 2 * int(np.sum(wrong.rays & ~rays))
    whole = _adjust(given, outcome, back)
    if whole is None or _misfit(whole) < most + CLEARLY:
        return []
    w = np.max(np.nan_to_num(np.abs(normalise_residuals(whole).control)), axis=1)
    w[ground.check | ground.station] = 0.0
    others = np.flatnonzero(w >= RELEVANT * np.max(w))
    found = []
    for j in others[others != k].tolist():
        control = back.control.copy()
        control[j] = True
        other = _adjust(given, outcome, back._replace(control=control))
        if other is not None and _misfit(other) <= most + GAP and _fits(other, level):
            found.append(j)
    return found


def _adjust(given: Given, outcome: Outcome, wrong: Wrong) -> BlockAdjustment | None:
    """The adjustment with this left out; None where there is none."""
    try:
        found = adjust_rest(given, outcome.adjusted.as_start, wrong)
    except TooLittleControl:
        return None
    return found if found.result == RESULTS.successful else None


def _misfit(adjusted: BlockAdjustment) -> float:
    """The weighted sum of squares of all residuals."""
    return float(adjusted.sigma0**2 * adjusted.degrees_of_freedom)


def _fits(adjusted: BlockAdjustment, level: float) -> bool:
    """Whether no known point stands out."""
    tested = normalise_residuals(adjusted, level)
    return bool(np.max(np.nan_to_num(np.abs(tested.control)), initial=0) < tested.limit)
