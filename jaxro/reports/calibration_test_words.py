"""What the F tests of a calibration say in words: whether zones differ, whether two
images have the same distortion, and what to mind of it."""

import numpy as np

from ..adjustment import critical_values as critical
from .calibration_model import LEVEL, Done, Photo, describe
from .calibration_tests import Compared, has_zones
from .pair import digits
from .reliability import DOUBTFUL
from .text import number

ELSEWHERE = 0.05
"""Part of the longer side by which two measured areas may differ with zones."""


def zones_in_words(done: Done, one: Photo) -> str:
    """Whether the zones of an image differ; empty where it has one only."""
    tested = done.zones.get(one.name)
    if not has_zones(one.found.model):
        return ""
    if tested is None:
        return (
            "Whether the zones differ is tested of images that are calibrated alone, "
            "without --focal."
        )
    if not np.isfinite(tested.probability):
        return (
            "Whether the zones differ could not be tested: there are no degrees of "
            "freedom, or the model without zones has no usable numbers."
        )
    test = _test(tested.f, tested.above, tested.below, tested.probability)
    if tested.probability < LEVEL:
        return f"The zones differ: {test}."
    axes = "" if tested.merged.y is None else " along x and one along y"
    return (
        f"The zones do not differ visibly: {test}; one focal length{axes} fits as well."
    )


def difference_in_words(done: Done, one: Compared) -> list[str]:
    """Whether two images have the same distortion; how much it differs, and the pose
    that was taken out."""
    found = one.found
    if found is None:
        return [
            f"{one.names} are not compared: by their common model "
            f"({describe(one.model)}) {' and '.join(one.failed)} cannot be used."
        ]
    what = "distortion" if one.refocused else "distortion or focal length"
    test = _test(found.f, found.above, found.below, found.probability)
    verdict = "differ" if found.probability < LEVEL else "do not differ visibly"
    return [
        f"{one.names} {verdict} in {what}: {test}, by {describe(one.model)}.",
        f"{_largest(done, one)}.",
        f"{_taken_out(done, one)}.",
    ]


def _largest(done: Done, one: Compared) -> str:
    """The largest difference, and the largest in standard deviations."""
    found = one.found
    assert found is not None
    most, worst = one.largest(one.size), one.largest(one.in_deviations)
    deviation = float(np.median(found.deviations[one.counts]))
    decimals = digits(min(deviation, one.size[most]), 1)
    at = lambda node: "({}, {})".format(*(f"{c:.5g}" for c in found.places[node]))
    return (
        f"Largest difference {number(one.size[most], decimals)} {done.unit} at "
        f"{at(most)}; {number(one.in_deviations[worst], 1)} standard deviations at "
        f"{at(worst)}; standard deviation {number(deviation, decimals)} {done.unit} "
        "(median)"
    )


def _taken_out(done: Done, one: Compared) -> str:
    """The rotation, the shift and the change of the focal length between both."""
    found = one.found
    assert found is not None
    turns = np.degrees(found.turn)
    decimals = digits(float(np.max(np.abs(turns))), 2)
    turn = ", ".join(number(t, decimals) for t in turns)
    decimals = digits(float(np.max(np.abs(found.shift))), 1)
    shift = ", ".join(number(s, decimals) for s in found.shift)
    scale = f"; focal length times {1 + found.scale:.6g}" if one.refocused else ""
    return (
        f"Taken out: turn about x, y and the axis of the camera {turn}°; shift "
        f"{shift} {done.unit}{scale}"
    )


def _test(f: float, above: int, below: int, probability: float) -> str:
    """An F test."""
    p = f"p = {probability:.2g}" if probability > 1e-99 else "p < 1e-99"
    return f"F({above}, {below}) = {number(f, 2)}, {p}"


def mind_difference(done: Done, one: Compared) -> list[str]:
    """What a careful user should know of a comparison."""
    if one.found is None:
        return []
    said = []
    first, second = one.sigma0
    shown = f"sigma0 {first:.3g}, {second:.3g}"
    if done.sigma_known and not _fits(one):
        said.append(
            f"their model does not fit the coordinates ({shown}): what it leaves over "
            "is taken for noise, in which a difference is lost. Compare by a better "
            "model."
        )
    elif not _equally_accurate(one):
        said.append(
            f"one is measured less accurately than the other ({shown}), and the test "
            "takes both to be alike. Give the places of each image their standard "
            "deviation in a column sigma."
        )
    areas = np.abs(one.areas[0] - one.areas[1])
    side = np.max(one.areas[0, 2:] - one.areas[0, :2])
    if has_zones(one.model) and np.max(areas) > ELSEWHERE * side:
        said.append(
            "the zones are those of the measured area of each image, and these areas "
            "are not the same: compare by a lens or a field."
        )
    if done.known_has_deviations:
        said.append(
            "what is known of the camera counts as measured for each image anew, so "
            "that F is too small."
        )
    if not np.any(one.inside):
        said.append(
            "no node of the common area lies among the measured places of both: the "
            "difference is extrapolated."
        )
    return said


def _fits(one: Compared) -> bool:
    """Whether neither sigma0 is larger than sigma allows."""
    return all(
        sigma0 <= 1 or float(critical.global_p(f * sigma0**2, f)) >= DOUBTFUL
        for sigma0, f in zip(one.sigma0, one.freedom, strict=True)
    )


def _equally_accurate(one: Compared) -> bool:
    """Whether both sigma0 are the same by the F test of their squares, on both
    sides."""
    (low, below), (high, above) = sorted(zip(one.sigma0, one.freedom, strict=True))
    if not low > 0:
        return high == low
    return 2 * float(critical.fisher_p((high / low) ** 2, above, below)) >= DOUBTFUL
