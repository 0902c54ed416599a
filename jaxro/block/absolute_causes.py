"""Why a model does not fit its control: whole columns that are wrong, each a hypothesis
under which the model is placed anew."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .absolute import orient_model
from .absolute_model import MeasuredModel
from .absolute_result import AbsoluteOrientation
from .absolute_verdict import RESULTS
from .columns import LEVEL, UNCERTAIN, Altered, Cause, alter, falls

FITS = 0.01
"""sigma0 over the extent of the control below which a model fits that did not fit at all
before."""

FITS_WELL = 2e-4
"""Root mean square residual over the extent of the control below which no column is
wrong: no hypothesis is tried then, which would be seven more adjustments."""

LEAST_FREEDOM = 2
"""Degrees of freedom under a cause."""


def find_cause(measured: MeasuredModel, found: AbsoluteOrientation) -> Cause | None:
    """The hypothesis about all known coordinates under which the sum of squares falls
    most, far and significantly (F test, for all that are tried). A mirror image has a
    verdict of its own."""
    if bool(found.result == RESULTS.mirrored):
        return None
    known = np.asarray(measured.known)
    if not np.any(known):
        return None
    at = np.where(known, np.asarray(measured.ground), np.nan)
    size = float(np.sqrt(np.mean(np.asarray(found.residuals)[known] ** 2)))
    if bool(found.usable) and size < FITS_WELL * _extent(at):
        return None
    tried = alter(at, np.any(known, axis=1), "control points")
    if not tried:
        return None
    extent = _extent(at)
    best, cause = np.inf, None
    for one in tried:
        sigma0 = _compare(measured, found, one, extent, len(tried))
        if sigma0 < best:
            best, cause = sigma0, Cause(one.name, one.sentence)
    return cause


def _extent(at: Float[np.ndarray, "point 3"]) -> float:
    """The largest difference of known coordinates of one axis."""
    there = np.isfinite(at)
    largest = np.max(np.where(there, at, -np.inf), axis=0)
    least = np.min(np.where(there, at, np.inf), axis=0)
    return float(np.max(np.where(np.any(there, axis=0), largest - least, 0.0)))


def _compare(
    measured: MeasuredModel,
    found: AbsoluteOrientation,
    altered: Altered,
    extent: float,
    tries: int,
) -> float:
    """sigma0 under a hypothesis; infinite where it does not fall far enough."""
    rest = orient_model(_under(measured, altered, extent))
    freedom, sigma0 = int(rest.degrees_of_freedom), float(rest.sigma0)
    if not bool(rest.usable) or freedom < LEAST_FREEDOM:
        return np.inf
    if not bool(found.usable):
        # without any fit before there is nothing to compare with
        typical = float(jnp.sqrt(jnp.median(measured.variance)))
        return sigma0 if sigma0 * typical < FITS * extent else np.inf
    before = float(found.sigma0), int(found.degrees_of_freedom)
    fits = falls(*before, sigma0, freedom) * tries < LEVEL
    return sigma0 if fits else np.inf


def _under(measured: MeasuredModel, altered: Altered, extent: float) -> MeasuredModel:
    """The model with its control under a hypothesis."""
    known = np.isfinite(altered.coordinates)
    variance = np.where(
        altered.unknown, (UNCERTAIN * extent) ** 2, np.asarray(measured.variance)
    )
    return eqx.tree_at(
        lambda m: (m.ground, m.known, m.variance),
        measured,
        (
            jnp.asarray(np.where(known, altered.coordinates, 0.0)),
            jnp.asarray(known),
            jnp.asarray(np.where(known, variance, 1.0)),
        ),
    )
