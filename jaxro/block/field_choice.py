"""How smooth the displacement fields of a block are, and how large: by the evidence.

With the coefficients b of all fields in units of the standard deviation of a place, the
sum of squares S0 of an adjustment at the strength γ0, and the normal matrix of the
coefficients, from which all other unknowns are eliminated, M = V diag(λ + 1/γ0²) Vᵀ,
any other strength γ has, with d = 1/γ² - 1/γ0² and c = Vᵀ b,

    S(γ) = S0 + Σ d c² (1 - d / (λ + 1/γ²)),
    -2 log evidence = f log S(γ) + Σ log(1 + γ² λ),    f the degrees of freedom,

all other unknowns integrated out with nothing known of them (restricted maximum
likelihood, Patterson and Thompson 1971). So one adjustment tells the evidence of all
strengths, and it is repeated until the strength rests. Without a field the second sum
is zero: lengths are compared by the same number.

An error of a measurement that is swallowed by a field makes it stronger, and a field
that is too weak makes good measurements stand out. So the choice and the search for what
is wrong take turns.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..adjustment import RESULTS
from ..camera.field import Field
from .adjust import BlockAdjustment
from .cameras import cameras_of
from .displacements import deviations_of
from .given import Given, Wrong
from .network import Start
from .wrong import adjust_rest, adjust_without_wrong

LENGTHS = (0.5, 0.8, 1.25)
"""Correlation lengths that are tried, in half sides of the measured area."""

ROUGH = 5e-4
"""The strength of the first field, in focal lengths: with it hardly a good place stands
out."""

STRENGTHS = np.geomspace(0.01, 10_000.0, 121)
"""Strengths that are told apart, in units of sigma."""

ROUNDS = 4
"""Adjustments at most by which a strength is found, and turns of choice and search."""

RESTS = 1.3
"""Ratio of two strengths that are taken for one."""


class Evidence(NamedTuple):
    """A field of the greatest evidence among those of one length, and -2 log
    evidence, the smaller the better."""

    field: Field
    score: float


def with_field(given: Given, start: Start, level: float) -> tuple[Given, Start]:
    """What is given, with the field that the evidence speaks for, and where to adjust it
    from; as it is where its field is known or there is none."""
    inner = given.inner
    if inner is None or inner.field is not True:
        return given, start
    strength = ROUGH / float(np.median(deviations_of(given.block)))
    rough = given.with_field(Field(LENGTHS[0], strength))
    adjusted, wrong = adjust_without_wrong(rough, start, level)
    for _ in range(ROUNDS):
        if adjusted.result != RESULTS.successful:
            return rough, start
        found = choose_field(rough, adjusted.as_start, wrong)
        rests = _are_alike(rough, found.field)
        rough = given.with_field(found.field)
        if rests:
            break
        adjusted, wrong = adjust_without_wrong(rough, adjusted.as_start, level)
    return rough, adjusted.as_start


def _are_alike(given: Given, field: Field) -> bool:
    """Whether a field is the given one, but for a strength that hardly differs."""
    assert given.inner is not None and isinstance(given.inner.field, Field)
    before = given.inner.field
    ratio = float(np.asarray(field.strength) / np.asarray(before.strength))
    return field.length == before.length and 1 / RESTS < ratio < RESTS


def choose_field(given: Given, start: Start, wrong: Wrong) -> Evidence:
    """The field of the greatest evidence, without what is wrong."""
    assert given.inner is not None and isinstance(given.inner.field, Field)
    strength = float(np.asarray(given.inner.field.strength))
    tried = []
    for length in LENGTHS:
        found = _of_length(given, start, wrong, length, strength)
        if found is not None:
            tried.append(found)
            strength = float(np.asarray(found.field.strength))
    if not tried:
        return Evidence(given.inner.field, np.inf)
    return min(tried, key=lambda one: one.score)


def _of_length(
    given: Given, start: Start, wrong: Wrong, length: float, strength: float
) -> Evidence | None:
    """The best strength of fields of one length, None where they cannot be adjusted."""
    # coefficients of another length are none to begin with
    begin, best = without_field(given, start), None
    for _ in range(ROUNDS):
        own = given.with_field(Field(length, strength))
        adjusted = adjust_rest(own, begin, wrong)
        if adjusted.result != RESULTS.successful:
            return best
        scores = evidence(adjusted)
        k = int(np.argmin(scores))
        before, strength = strength, float(STRENGTHS[k])
        best = Evidence(Field(length, strength), float(scores[k]))
        if 1 / RESTS < strength / before < RESTS:
            break
        begin = adjusted.as_start
    return best


def without_field(given: Given, start: Start) -> Start:
    """The start, with the coefficients of all fields zero."""
    assert given.inner is not None
    if start.inner is None:
        return start
    inner = np.array(start.inner)
    inner[:, len(given.inner.free) :] = 0.0
    return start._replace(inner=inner)


def evidence(adjusted: BlockAdjustment) -> Float[np.ndarray, " strength"]:
    """-2 log evidence of all `STRENGTHS` from one adjustment, but for a constant that is
    the same for all fields."""
    inner = adjusted.inner
    assert inner is not None and isinstance(inner.field, Field)
    parameters = np.asarray(adjusted.adjustment.parameters["camera"])
    number = cameras_of(adjusted.block).number
    of_field = np.arange(inner.count) >= len(inner.free)
    at = np.flatnonzero(np.tile(of_field, number))
    unit = np.repeat(deviations_of(adjusted.block), inner.modes)
    q = adjusted.adjustment.common_cofactor_of("camera")[np.ix_(at, at)]
    values, vectors = np.linalg.eigh(q / np.outer(unit, unit))
    b = parameters[:, of_field].ravel() / unit
    c = vectors.T @ b
    before = 1 / float(np.asarray(inner.field.strength)) ** 2
    most = np.maximum(1 / np.maximum(values, 1e-300) - before, 0.0)
    squares = sum(
        float(np.sum(np.asarray(r) ** 2)) for r in adjusted.adjustment.residuals
    )
    weight = 1 / STRENGTHS[:, None] ** 2
    more = weight - before
    s = squares + np.sum(more * c**2 * (1 - more / (most + weight)), axis=1)
    volume = np.sum(np.log1p(most / weight), axis=1)
    return adjusted.degrees_of_freedom * np.log(s) + volume
