"""What a calibration says in words: what an image needs, how accurate it is, what to
do where it failed, and what to mind."""

import numpy as np

from ..adjustment import critical_values as critical
from ..calibration.results import RESULTS
from .calibration_model import Done, Photo, describe, lens_names
from .calibration_test_words import mind_difference
from .pair import digits, join_names
from .reliability import DOUBTFUL
from .text import number

FEW = 15
"""Degrees of freedom below which a choice among models is said to rest on little."""

POORLY = 0.1
"""Redundancy below which a coordinate is said to be poorly checked."""

MOST = 6
"""Sentences of a kind that are shown."""

OPTIONS = {
    "plane_object": "Options: --principal-point X Y --principal-sigma S, or --focal F "
    "--focal-sigma S; both of them for models that stretch or shear the image (two-f, "
    "brown).",
    "weakly_determined": "Options: --model one-f, or --principal-point X Y "
    "--principal-sigma S.",
    "diverged": "Try --y-up or --y-down, --model one-f, and look for exchanged points.",
}
"""What on the command line helps where a calibration failed."""


def advice(one: Photo) -> str:
    """What to do about an image that failed."""
    return f"{RESULTS[one.found.result]} {OPTIONS.get(one.result, '')}".rstrip()


def decision(done: Done, one: Photo) -> str:
    """What the image needs, in words."""
    model, figures = one.found.model, one.figures
    what = "These images" if done.together else "This image"
    if model.field is not None:
        lens = "" if model.brown is None else " beside Brown's lens"
        need = "needs" if not done.together else "need"
        verb = need if done.chosen else "got"
        text = (
            f"{what} {verb} a displacement field{lens}: "
            f"{number(figures.in_field, 1)} effective parameters"
        )
        if not done.together:
            error = one.expected_error
            text += (
                f", expected error of a corrected place {number(error, digits(error))} "
                f"{done.unit}"
            )
        return f"{text}."
    name = _name_of(one)
    if one.name in done.few:
        return (
            f"{name[0].upper()}{name[1:]}: too few points for a choice among models "
            "without standard deviations. Measure more points, or give --sigma."
        )
    if not done.chosen:
        return f"{name[0].upper()}{name[1:]}, as asked."
    return f"{name[0].upper()}{name[1:]} {'are' if 'lengths' in name else 'is'} enough."


def _name_of(one: Photo) -> str:
    model = one.found.model
    if model.brown is not None:
        zones = "" if model.focals == 1 else f" with {describe(model).split(' + ')[0]}"
        return f"Brown's lens ({', '.join(lens_names(model))}){zones}"
    if model.focals == 1:
        return "one focal length"
    if describe(model) == "fx, fy":
        return "two focal lengths"
    return f"focal lengths by zones ({describe(model)})"


def accuracy(done: Done, one: Photo) -> str:
    """sigma0 with its unit, and its test where sigma was given."""
    sigma0, freedom = float(one.figures.sigma0), int(one.figures.degrees_of_freedom)
    plural = "s" * (freedom != 1)
    value = number(sigma0, digits(sigma0, 2))
    unit = "" if done.sigma_known else f" {done.unit}"
    text = f"sigma0 {value}{unit}, {freedom} degree{plural} of freedom"
    if done.sigma_known and freedom > 0:
        text += f", probability beside 1: {_small(chance(sigma0, freedom))}"
    return text


def chance(sigma0: float, freedom: int) -> float:
    """The probability that sigma0 differs as much from 1 by chance."""
    return float(critical.global_p(freedom * sigma0**2, freedom))


def has_doubtful_fit(done: Done) -> bool:
    """Whether residuals of an image contradict the standard deviations given."""
    found = [one.figures for one in done.photos if one.usable and done.sigma_known]
    return any(
        chance(float(f.sigma0), int(f.degrees_of_freedom)) < DOUBTFUL
        for f in found
        if int(f.degrees_of_freedom) > 0
    )


def _small(probability: float) -> str:
    return f"{probability:.2g}" if probability > 1e-99 else "below 1e-99"


# -------------------------------------------------------------------------------------
# what to mind


def sentences(done: Done) -> list[str]:
    """What a careful user should know of the result."""
    usable = [one for one in done.photos if one.usable]
    of_fit = [
        _of(done, one) + text
        for one in (usable[:1] if done.together else usable)
        for text in _of_fit(done, one)
    ]
    of_points = [
        _of(done, one, True) + text
        for one in sorted(usable, key=lambda one: -_excess(done, one))
        for text in _of_points(done, one)
    ]
    said = [
        *_first(of_fit, "cameras.csv of --out has sigma0 of every image"),
        *_first(of_points, "residuals.csv of --out has all"),
    ]
    for one in done.differences:
        said += [f"{one.names}: {text}" for text in mind_difference(done, one)]
    if done.sigma_known:
        return said
    weighed = {
        "object points": done.named.has_deviations,
        "known numbers of the camera": done.known_has_deviations,
    }
    for what in (name for name, has in weighed.items() if has):
        said.append(
            f"The {what} have standard deviations and the places have none: they are "
            f"taken to be 1 {done.unit}. Give --sigma."
        )
    return said


def _first(said: list[str], where: str) -> list[str]:
    """The first sentences, and where the others are found."""
    more = len(said) - MOST
    return said[:MOST] + ([f"{more} more like these: {where}."] if more > 0 else [])


def _of(done: Done, one: Photo, always: bool = False) -> str:
    several = len(done.photos) > 1 and (always or not done.together)
    return f"{one.name}: " if several else ""


def _of_fit(done: Done, one: Photo) -> list[str]:
    sigma0, freedom = float(one.figures.sigma0), int(one.figures.degrees_of_freedom)
    said = []
    if done.sigma_known and freedom > 0 and chance(sigma0, freedom) < DOUBTFUL:
        probability = _small(chance(sigma0, freedom))
        if sigma0 > 1:
            said.append(
                f"The coordinates are {sigma0:.1f} times less accurate than their sigma "
                f"says (probability {probability}): sigma is too small, points are "
                "wrong, or the image needs another model."
            )
        else:
            said.append(
                f"The coordinates are {1 / sigma0:.1f} times more accurate than their "
                f"sigma says (probability {probability}): sigma is too large."
            )
    if freedom < FEW and one.name not in done.few:
        said.append(
            f"{freedom} degree{'s' * (freedom != 1)} of freedom: few points for a "
            "choice among models. Measure more points."
        )
    return said


def _excess(done: Done, one: Photo) -> float:
    """The largest residual of an image over its limit."""
    return float(np.max(np.abs(done.w(one)))) / done.limit(one)


def _of_points(done: Done, one: Photo) -> list[str]:
    said = []
    sizes = np.max(np.abs(done.w(one)), axis=1)
    limit, k = done.limit(one), int(np.argmax(sizes))
    if sizes[k] > limit:
        w, others = "w" if done.sigma_known else "tau", int(np.sum(sizes > limit)) - 1
        also = f" ({others} more exceed the limit)" if others else ""
        said.append(
            f"Point {one.names[k]} has |{w}| = {sizes[k]:.1f} where {limit:.1f} is "
            f"allowed{also}: it is wrong in the image or in the object, or the model "
            "is not enough."
        )
    if not np.all(one.ahead):
        behind = [one.names[k] for k in np.flatnonzero(~one.ahead)]
        said.append(f"Behind the camera: {join_names(behind, 10)}.")
    poorly = np.min(one.redundancy, axis=1) < POORLY
    if np.any(poorly) and not done.together:
        names = [one.names[k] for k in np.flatnonzero(poorly)]
        said.append(
            f"Poorly checked (redundancy below {POORLY}): {join_names(names, 10)}."
        )
    return said
