"""What in an adjusted block contradicts what was given, as a whole: most of the control,
a tenth of the places, most places of one photo, a sigma0 far from 1.

Where one entry is wrong it is left out, and the rest is as good as before. Where this
much does not fit, what was left out is more likely a victim than the cause.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..adjustment import RESULTS, critical_values
from .adjust import BlockAdjustment
from .given import Given, Wrong

FITTING = 2 / 3
"""Part of the known points, of the stations or of the bars that has to fit."""

PLACES = 0.1
"""Part of all places beyond which they are not single errors."""

OF_PHOTO, LEAST_PLACES = 0.5, 6
"""Part of the places of one photo, and how many it has at least."""

FAR, NEVER = 2.0, 1e-6
"""sigma0 of this factor beside 1 fails by far, if chance is smaller than this."""

SUSPICIOUS = 0.05
"""Part of all places from which on a cause is looked for."""

DOUBTFUL = 1e-4
"""Probability of sigma0 below which a cause is looked for."""


class Fitting(NamedTuple):
    """Of a group of what is known: how many were given, and how many fit."""

    name: str
    given: int
    fitting: int

    @property
    def contradicts(self) -> bool:
        """Whether too few fit."""
        return self.fitting < FITTING * self.given


def groups_of(given: Given, adjusted: BlockAdjustment, wrong: Wrong) -> list[Fitting]:
    """How many of the known points, stations and bars fit. Those that nothing of the
    block shows do not count; those that lost their rays do not fit."""
    ground, block = given.known, given.block
    there = (ground.numbers_in(block) >= 0) & ~ground.check
    there &= np.any(np.isfinite(ground.coordinates), axis=1)
    fits = np.zeros(len(there), bool)
    if adjusted.ground is not None:
        fits = np.any(np.isfinite(adjusted.control_residuals), axis=1)
    fits &= ~np.any(wrong.control, axis=1)
    count = lambda rows: int(np.sum(rows))
    bars = given.lengths.are_in(block)
    used = np.isfinite(adjusted.bar_residuals) & ~wrong.bars
    of_points, of_stations = there & ~ground.station, there & ground.station
    return [
        Fitting("known points", count(of_points), count(of_points & fits)),
        Fitting("known stations", count(of_stations), count(of_stations & fits)),
        Fitting("scale bars", count(bars), count(bars & used)),
    ]


def contradictions(
    given: Given, adjusted: BlockAdjustment, wrong: Wrong, *, sigma_known: bool = True
) -> list[str]:
    """Sentences on what does not fit as a whole; none of a good block."""
    said = [
        f"Only {group.fitting} of {group.given} {group.name} fit the photos."
        for group in groups_of(given, adjusted, wrong)
        if group.contradicts
    ]
    rays = wrong.rays
    if np.mean(rays) > PLACES:
        said.append(
            f"{np.sum(rays)} of {len(rays)} places ({100 * np.mean(rays):.0f} %) do not "
            "fit the others."
        )
    said += [
        f"{out} of {number} places of photo {name} do not fit the others."
        for name, number, out in _photos_out(given, rays)
    ]
    if sigma_known:
        said += tell_sigma0(adjusted.sigma0, adjusted.degrees_of_freedom)
    return said


def tell_sigma0(sigma0: float, freedom: int) -> list[str]:
    """A sentence on a sigma0 that fails by far; none of one that does not."""
    if not (sigma0 > FAR and _chance(sigma0, freedom) < NEVER):
        return []
    return [f"The residuals are {sigma0:.3g} times what the standard deviations say."]


def stands_under_ground(adjusted: BlockAdjustment) -> bool:
    """Whether all photos stand under the points that they show: the mirror image of a
    block over flat ground fits as well, from below."""
    if not adjusted.known:
        return False
    block, used = adjusted.block, adjusted.numbered.rays
    above = adjusted.centres[block.photo, 2] - adjusted.coordinates[block.point, 2]
    return bool(np.all(above[used] < 0))


def is_suspicious(
    given: Given, adjusted: BlockAdjustment, wrong: Wrong, *, sigma_known: bool = True
) -> bool:
    """Whether a cause is to be looked for."""
    if adjusted.result != RESULTS.successful or not wrong.settled:
        return True
    groups = groups_of(given, adjusted, wrong)
    # one wrong one of many is an error of its own
    known = any(
        group.given - group.fitting > max(1, group.given / 4) for group in groups
    )
    chance = _chance(adjusted.sigma0, adjusted.degrees_of_freedom)
    doubtful = sigma_known and adjusted.sigma0 > 1 and chance < DOUBTFUL
    return (
        known
        or bool(np.any(wrong.bars))
        or bool(np.mean(wrong.rays) > SUSPICIOUS)
        or doubtful
        or bool(contradictions(given, adjusted, wrong, sigma_known=sigma_known))
    )


def _photos_out(
    given: Given, rays: Bool[np.ndarray, " ray"]
) -> list[tuple[str, int, int]]:
    """The photos most of whose places are out: names, numbers of places, those out."""
    block = given.block
    number = np.bincount(block.photo, minlength=len(block.photos))
    out = np.bincount(block.photo[rays], minlength=len(block.photos))
    most = (out > OF_PHOTO * number) & (number >= LEAST_PLACES)
    return [
        (block.photos[k], int(number[k]), int(out[k])) for k in np.flatnonzero(most)
    ]


def _chance(sigma0: float, freedom: int) -> float:
    """The probability of a sigma0 that is farther from 1."""
    if freedom <= 0:
        return 1.0
    return float(critical_values.global_p(freedom * sigma0**2, freedom))
