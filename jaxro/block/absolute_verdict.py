"""Every way an absolute orientation can end, with advice, and which of them it is."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values, results
from ..adjustment.bisection import Numbers
from ..adjustment.guarded import ratio
from .similarity import Points


class RESULTS(results.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How an absolute orientation ended. Where it is not `is_usable`, do not use the
    numbers."""

    no_redundancy = (
        "As many control coordinates as unknowns, seven: nothing checks the result, and "
        "sigma0 does not exist. Measure more control."
    )
    two_solutions = (
        "A second position of the model fits the control as well. The better one is "
        "returned; of two that fit exactly, the one whose z axis points further up. "
        "`solutions` returns both. Measure a further control coordinate."
    )
    too_few_coordinates = (
        "Fewer than seven independent control coordinates: an absolute orientation "
        "needs two points known in plan and three known in height, at least. `missing` "
        "tells what they leave open."
    )
    control_on_line = (
        "The control points lie on one line: the model can turn about it. Measure "
        "control away from the line, at least one coordinate across it."
    )
    undetermined = (
        "The control does not determine the model, although it has coordinates enough: "
        "the model can turn or grow a little without any residual (points in one place, "
        "a height that does not change when the model turns). Measure a further control "
        "coordinate, away from the others."
    )
    weakly_determined = (
        "The control determines the model too weakly: a turn of it has a standard "
        "deviation above 0.04 rad (2°), or the scale one above 4 %. Measure control "
        "further apart, or look for wrong control coordinates if sigma0 is larger than "
        "you expect."
    )
    mirrored = (
        "The control fits the mirror image of the model at least ten times better. "
        "Exchange X and Y of the ground if X points north (or change the sign of one "
        "axis), or look at the direction of the axes of the model."
    )
    free_of_error = (
        "A control coordinate and the model point are both said to be free of error. "
        "Give the standard deviation of one of them."
    )


WEAK = 0.04
"""Standard deviation of a turn (rad), or of the scale (relative), above which it is
not determined."""

THIN = 0.07
"""Width of control over its length below which it is nearly a line."""

MIRRORED, SUPPORT = 100.0, 3
"""Factor by which the mirror image has a smaller sum of squares, and the degrees of
freedom from which on that is no chance."""

EXACT = 1e-12
"""Part of the sum of squares about the mean that is rounding."""

CONFIDENCE = 0.95
"""A second solution counts if it does not fit significantly worse at this level."""

MOST = 1000
"""Degrees of freedom of the table of its limits."""

DATUM = ("scale", "turn", "tilt", "height", "shift")
"""What control determines: the scale, the turn about the vertical, the tilt of the
horizon, and the shift in height and in plan."""

MEASURE = {
    "scale": "scale (a second point known in plan)",
    "turn": "turn about the vertical (a second point known in plan)",
    "tilt": "tilt (heights of three points that are not on one line)",
    "height": "height (a point of known height)",
    "shift": "shift in plan (a point known in plan)",
}
"""What is missing, and what would give it."""


class Evidence(NamedTuple):
    """What the verdict on a solution rests on.

    `coordinates`: how many are known; `missing`: what of the datum; `deviations`: of
    the seven local parameters, a posteriori; `squares`: the sum of squares, that of the
    `other` solution, that of the image that is `mirrored`, and that of the control
    `about_mean`; `apart`: whether the other solution is another one; `moments`: of the
    control about its middle in the model; `exact`: whether some control has no error at
    all.
    """

    coordinates: Int[Array, ""]
    missing: Bool[Array, "5"]
    deviations: Float[Array, "7"]
    squares: Float[Array, ""]
    other: Float[Array, ""]
    mirrored: Float[Array, ""]
    about_mean: Float[Array, ""]
    apart: Bool[Array, ""]
    moments: Float[Array, "3 3"]
    exact: Bool[Array, ""]
    ended: results.RESULTS


def is_usable(result: RESULTS) -> Bool[Array, "..."]:
    """True where the numbers may be used: successful, no_redundancy or two_solutions
    (with their warnings)."""
    return (
        (result == RESULTS.successful)  # pyright: ignore[reportReturnType]
        | (result == RESULTS.no_redundancy)
        | (result == RESULTS.two_solutions)
    )


def advice_of(result: RESULTS, missing: Bool[np.ndarray, "5"]) -> str:
    """What a result says, without the names of Python, and what would give what is
    `missing` of the datum."""
    text = RESULTS[result].replace(" `missing` tells what they leave open.", "")
    text = text.replace(" `solutions` returns both.", "")
    there = zip(DATUM, missing.tolist(), strict=True)
    measure = [MEASURE[name] for name, is_missing in there if is_missing]
    return f"{text} Missing: {', '.join(measure)}." if measure else text


def verdict(evidence: Evidence) -> RESULTS:
    """The first of these that holds."""
    freedom = evidence.coordinates - 7
    ended = evidence.ended
    singular = ended == results.RESULTS.rank_deficient
    few = jnp.any(evidence.missing) | (freedom < 0)
    weak = ~jnp.all(evidence.deviations[:4] <= WEAK) & (freedom > 0)
    on_line = is_thin(evidence.moments) & (singular | weak)
    table = (
        (RESULTS.too_few_coordinates, few),
        (RESULTS.free_of_error, evidence.exact),
        (RESULTS.mirrored, _is_mirrored(evidence)),
        (RESULTS.control_on_line, on_line),
        (RESULTS.undetermined, singular),
        (RESULTS.diverged, ended != results.RESULTS.successful),
        (RESULTS.weakly_determined, weak),
        (RESULTS.two_solutions, _is_double(evidence)),
        (RESULTS.no_redundancy, freedom == 0),
    )
    result = RESULTS.successful
    for name, holds in reversed(table):
        result = RESULTS.where(holds, name, result)  # pyright: ignore[reportArgumentType]
    return result  # pyright: ignore[reportReturnType]


def _is_mirrored(evidence: Evidence) -> Bool[Array, ""]:
    checked = evidence.coordinates - 7 >= SUPPORT
    rounding = EXACT * evidence.about_mean
    much = evidence.squares > MIRRORED * evidence.mirrored + rounding
    return checked & much


def _is_double(evidence: Evidence) -> Bool[Array, ""]:
    """Whether another solution fits not significantly worse, by the F test of two sums
    of squares."""
    freedom = jnp.clip(evidence.coordinates - 7, 0, MOST)
    limit = critical_values.by_count(_limit, MOST, jnp.asarray(freedom, float))
    allowed = limit * evidence.squares + EXACT * evidence.about_mean
    return evidence.apart & (evidence.other <= allowed)


def _limit(freedom: np.ndarray) -> Float[Numbers, "..."]:
    """Of the ratio of two sums of squares; without a degree of freedom zero."""
    there = freedom > 0
    safe = freedom + ~there
    return critical_values.fisher(1 - CONFIDENCE, safe, safe) * there


def is_thin(moments: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Whether points with these second moments lie nearly on a line: of the eigenvalues
    only one is not small."""
    trace = jnp.trace(moments)
    others = 1 - ratio(jnp.sum(moments**2), trace**2, trace > 0)
    return others < 2 * THIN**2


def missing(known: Bool[Array, "point 3"]) -> Bool[Array, "5"]:
    """What of the `DATUM` control leaves open however it lies: by the numbers of known
    coordinates in plan and in height."""
    plan, height = jnp.sum(known[:, :2]), jnp.sum(known[:, 2])
    return jnp.stack(
        [
            (plan < 4) & (height < 4),
            plan < 3,
            (plan + jnp.maximum(height, 1) < 7) & (height < 3),
            height == 0,
            plan < 2,
        ]
    )


def moments_of(points: Points, known: Bool[Array, "point 3"]) -> Float[Array, "3 3"]:
    """The second moments of the points with control about their mean."""
    use = jnp.any(known, axis=1)[:, None]
    number = jnp.maximum(jnp.sum(jnp.where(use, 1.0, 0.0)), 1.0)
    middle = jnp.sum(jnp.where(use, points, 0.0), axis=0) / number
    apart = jnp.where(use, points - middle[None], 0.0)
    return apart.T @ apart
