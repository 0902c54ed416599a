"""Variance components of several images: how much larger, or smaller, the standard
deviations of the measured places and of the known points are than was said.

    s² = Σ (v / sigma)² / Σ r        of each group

with the redundancy numbers r (Förstner 1979). The standard deviations are multiplied
with s, and the adjustment is repeated until both s are 1.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .measured_images import MeasuredImages
from .models import Model
from .together import Together, calibrate_together

ROUNDS = 30
"""Adjustments at most."""

AT_REST = 1e-3
"""Change of a factor that is nothing."""


class Components(NamedTuple):
    """The adjustment with the standard deviations that were found; by which factors
    those of places and of known points were multiplied, the standard deviations of
    these factors, and whether they came to rest."""

    found: Together
    factors: Float[np.ndarray, "2"]
    deviations: Float[np.ndarray, "2"]
    settled: bool


def estimate_components(
    measured: MeasuredImages, model: Model | None = None
) -> Components:
    """The `Components` of places and known points.

    Raises ValueError where known points are without error: nothing could be said of
    them.
    """
    known = np.all(np.isfinite(measured.point_sigma), axis=1)
    if not np.all(np.asarray(measured.point_sigma)[known] > 0):
        raise ValueError(
            "estimate_components: known points need standard deviations (point_sigma)"
        )
    factors, settled = np.ones(2), False
    for _ in range(ROUNDS):
        found = calibrate_together(_scaled(measured, factors), model)
        squares, redundancy = _sums(found)
        change = np.sqrt(squares / redundancy)
        factors = factors * change
        if settled := bool(np.all(np.abs(change - 1) < AT_REST)):
            break
    deviations = factors / np.sqrt(2 * redundancy)
    return Components(found, factors, deviations, settled)


def _scaled(measured: MeasuredImages, factors: np.ndarray) -> MeasuredImages:
    return dataclasses.replace(
        measured,
        sigma=measured.sigma * factors[0],
        point_sigma=measured.point_sigma * factors[1],
    )


def _sums(found: Together) -> tuple[np.ndarray, np.ndarray]:
    """Σ v² and Σ r of the places and of the known points."""
    of_both = lambda groups: np.array([np.sum(a) for a in groups[:2]])
    squares = of_both([np.asarray(v) ** 2 for v in found.adjustment.residuals])
    return squares, of_both(found.adjustment.redundancy)
