"""Known points one of which is wrong, and nothing tells which.

Of four heights in the corners of a block one misclosure is left, its twist: each of them
explains it. So each known point that was left out is put back, and others are left out in
its place, each one adjustment: where everything fits as well, neither is accused.
"""

from itertools import islice

import numpy as np

from ..adjustment import RESULTS
from .adjust import BlockAdjustment
from .adjust_chained import Outcome
from .given import Given
from .place import TooLittleControl
from .wrong import adjust_rest, normalise_residuals
from .wrong_points import GAP

MOST_TRIES = 24
"""Adjustments at most."""


def tell_confusable(given: Given, outcome: Outcome, level: float) -> tuple[str, ...]:
    """A sentence for each set of known points that cannot be told apart."""
    return tuple(
        f"One of the known points {', '.join(names)} is wrong, and nothing tells which: "
        "without any one of them everything fits. Measure more known points."
        for names in find_confusable(given, outcome, level)
    )


def find_confusable(given: Given, outcome: Outcome, level: float) -> list[list[str]]:
    """For each known point that was left out, itself or all its rays, and could be
    right: its name and those of the others without which everything fits as well."""
    ground, adjusted, wrong = given.known, outcome.adjusted, outcome.wrong
    if adjusted.result != RESULTS.successful:
        return []
    number = ground.numbers_in(given.block)
    there = np.any(np.isfinite(ground.coordinates), axis=1) & ~ground.check
    there &= (number >= 0) & ~ground.station
    fits = np.any(np.isfinite(adjusted.control_residuals), axis=1)
    fits &= ~np.any(wrong.control, axis=1)

    def misfit(back: int, left: int) -> float:
        """The misfit with one known point put back and another one left out; infinite
        where it does not fit. The rays that come back have residuals, too."""
        control = wrong.control.copy()
        control[back], control[left] = False, True
        rays = wrong.rays & (given.block.point != number[back])
        try:
            other = adjust_rest(
                given,
                adjusted.as_start,
                wrong._replace(control=control, rays=rays),
            )
        except TooLittleControl:
            return np.inf
        expected = 2 * int(np.sum(wrong.rays & ~rays))
        return _misfit(other) - expected if _fits(other, level) else np.inf

    most = _misfit(adjusted) + GAP
    swaps = (
        (k, j)
        for k in np.flatnonzero(there & ~fits)
        for j in np.flatnonzero(there & fits)
    )
    found: dict[int, list[str]] = {}
    for k, j in islice(swaps, MOST_TRIES):
        if misfit(int(k), int(j)) <= most:
            found.setdefault(int(k), [ground.points[k]]).append(ground.points[j])
    return list(found.values())


def _misfit(adjusted: BlockAdjustment) -> float:
    """The weighted sum of squares of all residuals."""
    return float(adjusted.sigma0**2 * adjusted.degrees_of_freedom)


def _fits(adjusted: BlockAdjustment, level: float) -> bool:
    """Whether no known point stands out."""
    if adjusted.result != RESULTS.successful:
        return False
    tested = normalise_residuals(adjusted, level)
    return bool(np.max(np.nan_to_num(np.abs(tested.control)), initial=0) < tested.limit)
