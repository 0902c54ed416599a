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
from jaxtyping import Bool

from .adjust import BlockAdjustment, adjust_block
from .bars import Bars
from .inner import Inner
from .measured_block import Ground, MeasuredBlock
from .network import Start

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
    names = ["places", *kinds, *(() if adjusted.bars is None else ("ties", "bars"))]
    groups = zip(names, found.residuals, found.redundancy, strict=True)
    return {name: _component(v, r) for name, v, r in groups if name != "ties"}


def _component(white: np.ndarray, redundancy: np.ndarray) -> Component:
    r = float(np.sum(redundancy))
    if r < LEAST:
        return Component(1.0, np.inf, r)
    factor = float(np.sqrt(np.sum(white**2) / r))
    return Component(factor, factor / float(np.sqrt(2 * r)), r)


def adjust_with_components(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None = None,
    inner: Inner | None = None,
    left_out: Bool[np.ndarray, " ray"] | None = None,
    bars: Bars | None = None,
) -> tuple[BlockAdjustment, dict[str, Component]]:
    """The adjustment with the standard deviations of each group as its residuals tell
    them, and the factors that lead there from what was stated. Wrong places (`left_out`)
    and wrong known coordinates, which are NaN, are to be found before."""
    factors: dict[str, float] = dict.fromkeys(GROUPS, 1.0)
    silent: set[str] = set()
    adjusted = adjust_block(block, start, ground, inner, left_out, bars)
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
        places, known, lengths = multiply(block, ground, bars, factors)
        begin = adjusted.as_start
        adjusted = adjust_block(places, begin, known, inner, left_out, lengths)
        found = components_of(adjusted)
    of = lambda name, one: (
        Component(1.0, np.inf, one.redundancy)
        if name in silent
        else one.times(factors[name])
    )
    return adjusted, {name: of(name, one) for name, one in found.items()}


def multiply(
    block: MeasuredBlock,
    ground: Ground | None,
    bars: Bars | None,
    factors: Mapping[str, float],
) -> tuple[MeasuredBlock, Ground | None, Bars | None]:
    """Everything with the standard deviations of each group multiplied."""
    block = block._replace(sigma=block.sigma * factors["places"])
    if bars is not None:
        bars = bars._replace(sigma=bars.sigma * factors["bars"])
    if ground is not None:
        of_rows = np.where(ground.station, factors["stations"], factors["control"])
        ground = ground._replace(sigma=ground.sigma * of_rows[:, None])
    return block, ground, bars
