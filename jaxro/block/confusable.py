"""Known points one of which is wrong, and nothing tells which.

Of four heights in the corners of a block one misclosure is left, its twist: each of them
explains it. So what was left out of the known points is put back, and those that then
stand out are left out in its place, each one adjustment: where everything fits as well,
neither is accused.
"""

import numpy as np

from ..adjustment import RESULTS
from .adjust import BlockAdjustment
from .adjust_chained import Outcome
from .columns import Cause
from .given import Given, Wrong
from .place import TooLittleControl
from .wrong import adjust_rest, normalise_residuals
from .wrong_points import GAP

PART = 0.5
"""Part of what the best omission takes off the sum of squares that another one may leave
in it, up to `GAP`."""

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
    """Sets of known points of which one is wrong, and nothing tells which: those of all
    that lost anything, in place of a single one that is wrong; else those of each point
    that was left out."""
    if outcome.adjusted.result != RESULTS.successful:
        return []
    names = given.known.points
    out, touched = _left_out(given, outcome)
    if not len(out):
        return []
    if len(touched) > 1:
        alone = _alone(given, outcome, touched, level)
        if len(alone) > 1:
            return [[names[j] for j in alone]]
    found = [_alone(given, outcome, [k], level) for k in out]
    return [[names[j] for j in alone] for alone in found if len(alone) > 1]


def _left_out(given: Given, outcome: Outcome) -> tuple[list[int], list[int]]:
    """The known points that were left out as wrong, themselves or all their rays; and
    those that lost anything."""
    ground, wrong, block = given.known, outcome.wrong, given.block
    number = ground.numbers_in(block)
    kept = np.bincount(block.point[~wrong.rays], minlength=len(block.points))[number]
    lost = np.bincount(block.point[wrong.rays], minlength=len(block.points))[number]
    there = (number >= 0) & ~ground.check & ~ground.station
    itself = np.any(wrong.control, axis=1)
    out = there & (itself | ((kept == 0) & (lost > 0)))
    touched = there & (itself | (lost > 0))
    return np.flatnonzero(out).tolist(), np.flatnonzero(touched).tolist()


def _alone(given: Given, outcome: Outcome, back: list[int], level: float) -> list[int]:
    """The known points without any one of which everything fits, where those that were
    left out are put back and fit no more; those first."""
    ground, wrong = given.known, outcome.wrong
    control = wrong.control.copy()
    control[back] = False
    numbers = ground.numbers_in(given.block)[back]
    rays = wrong.rays & ~np.isin(given.block.point, numbers)
    together = wrong._replace(control=control, rays=rays)
    # the rays that come back have residuals, too
    most = _misfit(outcome.adjusted) + 2 * int(np.sum(wrong.rays & ~rays))
    whole = _adjust(given, outcome, together)
    if whole is None or _misfit(whole) < most + GAP:
        return []
    gap = min(GAP, PART * (_misfit(whole) - most))
    w = np.max(np.nan_to_num(np.abs(normalise_residuals(whole).control)), axis=1)
    w[ground.check | ground.station] = 0.0
    others = np.flatnonzero(w >= RELEVANT * np.max(w)).tolist()
    found = []
    for j in dict.fromkeys([*back, *others]):
        if back == [j]:
            found.append(j)
            continue
        control = together.control.copy()
        control[j] = True
        other = _adjust(given, outcome, together._replace(control=control))
        if other is not None and _misfit(other) <= most + gap and _fits(other, level):
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
