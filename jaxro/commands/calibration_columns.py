"""Object points of a calibration that are wrong as a whole column: heights in feet,
degrees, the coordinates of the next row."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..block.columns import EQUAL_HEIGHTS, LEVEL, Cause, alter, falls
from ..calibration import Calibration, MeasuredImage, Model, calibrate
from ..calibration.known import Known
from ..camera.condition import Rays

MISFIT = 1e-3
"""Residuals over the focal length from which on a cause is looked for."""


def find_cause(measured: MeasuredImage, rays: Rays, known: Known) -> Cause | None:
    """The hypothesis about all object points of an image under which one focal length
    explains it, where it does not by what was given. The mirror image is not tried: an
    image tells the direction of its y by itself."""
    place = lambda image: calibrate(image, Model(rays=rays), known)
    before = place(measured)
    if not _misfits(measured, before):
        return None
    used = np.asarray(measured.mask)
    points = np.asarray(measured.points)
    tried = [
        one
        for one in alter(points, used, "object points")
        if one.name not in ("mirrored", EQUAL_HEIGHTS)
    ]
    best, cause = np.inf, None
    for one in tried:
        there = used & np.all(np.isfinite(one.coordinates), axis=1)
        at = np.where(there[:, None], one.coordinates, 0.0)
        image = replace(measured, points=jnp.asarray(at), mask=jnp.asarray(there))
        found = place(image)
        if not _is_better(found, before, len(tried)) or _misfits(image, found):
            continue
        if float(found.sigma0) < best:
            best, cause = float(found.sigma0), Cause(one.name, one.sentence)
    return cause


def _misfits(measured: MeasuredImage, found: Calibration) -> bool:
    """Whether the residuals are absurd for the focal length."""
    if not bool(found.usable):
        return True
    sigma = np.asarray(measured.sigma)[np.asarray(measured.mask)]
    size = float(found.sigma0) * float(np.sqrt(np.mean(sigma**2)))
    return size > MISFIT * float(np.asarray(found.focal)[0])


def _is_better(found: Calibration, before: Calibration, tries: int) -> bool:
    """Whether sigma0 falls far, and significantly."""
    freedom = int(found.degrees_of_freedom)
    if not bool(found.usable) or freedom < 1:
        return False
    if not bool(before.usable):
        return True
    was = float(before.sigma0), int(before.degrees_of_freedom)
    return falls(*was, float(found.sigma0), freedom) * tries < LEVEL
