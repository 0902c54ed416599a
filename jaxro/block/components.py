"""Variance components of a block: by which factors the stated standard deviations of
places, known points, known stations and scale bars are to be multiplied, so that each group agrees
with its own residuals.

    s² = Σ v² / sigma² / Σ r    over the group, r the redundancy numbers

(Förstner 1979), repeated with the standard deviations multiplied by s until all s are
1: then these are the estimates of restricted maximum likelihood.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .adjust import BlockAdjustment
from .given import Given, Wrong, nothing_wrong
from .network import Start
from .wrong import adjust_rest

ROUNDS = 30
"""Adjustments at most."""

RESTS = 1e-3
"""Change of the factors at which they are found."""

LEAST = 1.0
"""Redundancy of a group that tells its factor; with less it keeps what was stated."""

GROUPS = ("places", "control", "stations", "bars")


class Component(NamedTuple):
    """The factor of a group; its standard deviation, 1 / sqrt(2 r) of it for normal
    errors; and the redundancy r that tells it."""

    factor: float
    deviation: float
    redundancy: float

    def times(self, factor: float) -> "Component":
        """The same, of standard deviations that were multiplied before."""
        factors = self.factor * factor, self.deviation * factor
        return Component(*factors, self.redundancy)


def components_of(adjusted: BlockAdjustment) -> dict[str, Component]:
    """The factor of each group that takes part, from its residuals in one
    adjustment."""
    kinds = ["stations" if part.station[0] else "control" for part in adjusted.known]
    found = adjusted.adjustment
    has_fields = adjusted.inner is not None and adjusted.inner.modes > 0
    names = ["places", *kinds, *(("fields",) if has_fields else ())]
    names += ["ties", "bars"] if len(adjusted.bar_rows) else []
    groups = zip(names, found.residuals, found.redundancy, strict=True)
    return {name: _component(v, r) for name, v, r in groups if name in GROUPS}


def _component(white: np.ndarray, redundancy: np.ndarray) -> Component:
    r = float(np.sum(redundancy))
    if r < LEAST:
        return Component(1.0, np.inf, r)
    factor = float(np.sqrt(np.sum(white**2) / r))
    return Component(factor, factor / float(np.sqrt(2 * r)), r)


def adjust_with_components(
    given: Given, start: Start, wrong: Wrong | None = None
) -> tuple[BlockAdjustment, dict[str, Component]]:
    """The adjustment with the standard deviations of each group as its residuals tell
    them, and the factors that lead there from what was stated. What is `wrong` is to be
    found before."""
    wrong = nothing_wrong(given) if wrong is None else wrong
    factors: dict[str, float] = dict.fromkeys(GROUPS, 1.0)
    silent: set[str] = set()
    adjusted = adjust_rest(given, start, wrong)
    found = components_of(adjusted)
    for _ in range(ROUNDS):
        # a group without redundancy would shrink to nothing: it stays as stated
        lost = {n for n, one in found.items() if one.redundancy < LEAST} - silent
        told = {n: one for n, one in found.items() if n not in silent | lost}
        if not lost and all(abs(one.factor - 1) < RESTS for one in told.values()):
            break
        silent |= lost
        factors |= {name: factors[name] * one.factor for name, one in told.items()}
        factors |= dict.fromkeys(lost, 1.0)
        adjusted = adjust_rest(multiply(given, factors), adjusted.as_start, wrong)
        found = components_of(adjusted)
    of = lambda name, one: (
        Component(1.0, np.inf, one.redundancy)
        if name in silent
        else one.times(factors[name])
    )
    return adjusted, {name: of(name, one) for name, one in found.items()}


def multiply(given: Given, factors: Mapping[str, float]) -> Given:
    """Everything with the standard deviations of each group multiplied."""
    block, ground, inner, bars = given
    block = block._replace(sigma=block.sigma * factors["places"])
    if bars is not None:
        bars = bars._replace(sigma=bars.sigma * factors["bars"])
    if ground is not None:
        of_rows = np.where(ground.station, factors["stations"], factors["control"])
        ground = ground._replace(sigma=ground.sigma * of_rows[:, None])
    return Given(block, ground, inner, bars)
