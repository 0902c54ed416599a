"""What a careful user of an adjusted block should know, in sentences."""

import numpy as np

from ..block.contradictions import stands_under_ground
from ..block.photos import find_copies
from .block_model import PHOTOS, POINTS, Done
from .control import AXES
from .pair import join_names
from .reliability import DOUBTFUL

POORLY = 0.1
"""Redundancy below which a control coordinate is said to be poorly checked."""

SHOWN = 10
"""Names that a sentence tells of a longer list."""


def sentences(done: Done) -> list[str]:
    """What a careful user should know of the result."""
    said = _of_pairs(done) + _of_photos(done)
    if done.usable:
        said += _of_side(done) + _of_fit(done) + _of_control(done) + _of_checks(done)
    if done.strange:
        names = join_names(done.strange, SHOWN)
        said.append(f"No photo shows these points of the ground: {names}.")
    if done.lonely and done.usable:
        names = join_names(done.lonely, SHOWN)
        said.append(
            f"{len(done.lonely)} points are on one photo only, or lost the places that "
            f"determined them, and have no coordinates: {names}."
        )
    if done.approximate:
        said.append(
            f"{done.approximate} approximate points are not used: no approximate values "
            "are needed."
        )
    return said


def _of_pairs(done: Done) -> list[str]:
    failed = np.flatnonzero(~done.oriented.usable)
    if not failed.size:
        return []
    names = join_names([done.pairs[k] for k in failed], SHOWN)
    return [
        f"{len(failed)} pairs could not be oriented by themselves and served as places "
        f"of points only: {names}. jaxro clean tells why."
    ]


def _of_photos(done: Done) -> list[str]:
    """Photos that came in twice, and those that one point holds."""
    said = [
        f"Photos {one} and {other} show their points at the same places: one photo under "
        "two names, whose places are no second measurements."
        for one, other in find_copies(done.adjusted.block)
    ]
    if not done.usable:
        return said
    return said + [
        f"The scale of photo {held.photo} rests on point {held.point} alone, and nothing "
        "checks it: measure more points that three photos show."
        for held in done.held[:SHOWN]
    ]


def doubts(done: Done) -> list[str]:
    """What sigma0 and the check points say against a usable block."""
    return _of_side(done) + _of_fit(done) + (_beyond(done) if done.checks.names else [])


def _of_fit(done: Done) -> list[str]:
    freedom, sigma0 = done.adjusted.degrees_of_freedom, done.adjusted.sigma0
    if freedom == 0 or done.chance >= DOUBTFUL:
        return []
    if sigma0 > 1:
        return [
            f"The residuals are {sigma0:.2f} times as large as the standard deviations "
            f"say (probability {done.chance:.1g}): these are too small, or the camera is "
            "not what was given."
        ]
    return [
        f"The residuals are {1 / sigma0:.2f} times smaller than the standard deviations "
        f"say (probability {done.chance:.1g}): these are too large."
    ]


def _of_control(done: Done) -> list[str]:
    if done.ground is None:
        scale = " and scale" if done.bars is None else ""
        named = {PHOTOS: "its stations", POINTS: "its points"}
        datum = named.get(done.datum, f"the points {done.datum.replace(',', ', ')}")
        return [
            f"Without known points the block has any position{scale}; standard "
            f"deviations refer to {datum} as a whole (inner constraints)."
        ]
    used = done.control.known & ~done.wrong_control
    poorly = used & (done.control_redundancy < POORLY)
    if not np.any(poorly):
        return []
    named = [
        f"{AXES[axis]} of {done.control.names[k]}" for k, axis in np.argwhere(poorly)
    ]
    return [
        f"Poorly checked (redundancy below {POORLY}), an error there hardly shows: "
        f"{join_names(named, SHOWN)}. Each moves the block; more control beside them "
        "would check them."
    ]


def _of_side(done: Done) -> list[str]:
    """Photos from below."""
    if not stands_under_ground(done.adjusted):
        return []
    return [
        "All photos stand under the ground: flat control fits the mirror image of a block "
        "as well. Of photos taken from above X and Y of the control are exchanged, or an "
        "axis counts the other way (y of the photos downwards: --y-down)."
    ]


def _of_checks(done: Done) -> list[str]:
    if done.ground is None:
        return []
    if not done.checks.names:
        return [
            "No check points: the residuals say how well photos and control fit "
            "together, not how accurate new points are. Give some points of the ground "
            "the role check."
        ]
    return _beyond(done)


def _beyond(done: Done) -> list[str]:
    """The check points that differ by too much."""
    sizes, limit = np.abs(done.checks.w), done.limit_of_checks
    beyond = np.flatnonzero(np.max(sizes, axis=1) > limit)
    if not beyond.size:
        return []
    names = join_names([done.checks.names[k] for k in beyond], SHOWN)
    return [
        f"Check points differ by more than their standard deviations allow: {names}."
    ]
