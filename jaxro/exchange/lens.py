"""Rays free of distortion, of lenses with Brown's distortion as OpenCV and Bundler
write it.

With the ray (u, v, 1), r² = u² + v², and the coefficients (k1, k2, p1, p2, k3, k4, k5,
k6), of which the last four or three may be missing,

    R  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    u' = u R + 2 p1 u v + p2 (r² + 2 u²)
    v' = v R + p1 (r² + 2 v²) + 2 p2 u v

is the distorted one, which the photo shows. The inverse has no formula. It is unique as
far as the image does not fold: on the way from the centre to (u, v) the determinant of
d(u', v') / d(u, v) must be positive.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Rays = Float[np.ndarray, "point 2"]
Coefficients = Sequence | np.ndarray

STEPS = 50
"""Newton steps; a lens that needs them all does not invert."""

ACCURATE = 1e-12
"""Of a distorted ray, in units of the focal length."""

STEP = 1e-30
"""Of derivatives by complex numbers, which are exact to rounding for polynomials."""

WAY = np.linspace(0.0, 1.0, 33)
"""Places between the centre and a ray at which the image must not fold."""


class Inverse(NamedTuple):
    """`rays` (u, v); `slopes`, d(u, v) / d(u', v'); `found`: false where no ray is seen
    there (rays are zero then)."""

    rays: Rays
    slopes: Float[np.ndarray, "point 2 2"]
    found: Bool[np.ndarray, " point"]


def check_coefficients(coefficients: Coefficients) -> Float[np.ndarray, "8"]:
    """All coefficients, zeros for those that are not given. Raises ValueError for what
    are none."""
    given = np.ravel(np.asarray(coefficients, float))
    if len(given) not in (2, 4, 5, 8) or not np.all(np.isfinite(given)):
        raise ValueError(
            "distortion: OpenCV's coefficients (k1, k2, p1, p2), and k3, or k3, k4, k5, "
            f"k6 behind them are wanted, got {given.tolist()}; of other models undistort "
            "the points first, or give a COLMAP camera"
        )
    return np.append(given, np.zeros(8 - len(given)))


def distort(rays: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """(u', v') of rays (u, v), real or complex."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    u, v = rays[..., 0], rays[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    across = 2 * u * v
    return np.stack(
        [
            u * radial + p1 * across + p2 * (r2 + 2 * u * u),
            v * radial + p1 * (r2 + 2 * v * v) + p2 * across,
        ],
        axis=-1,
    )


def slopes(rays: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """d(u', v') / d(u, v), (..., 2, 2)."""
    along = lambda axis: np.imag(distort(rays + 1j * STEP * axis, coefficients))
    columns = [along(axis) / STEP for axis in np.eye(2)]
    return np.stack(columns, axis=-1)


def undistort(distorted: Rays, coefficients: np.ndarray) -> Inverse:
    """The rays that are seen at these places, by Newton's method from there."""
    rays = distorted.copy()
    with np.errstate(all="ignore"):  # what does not converge is told by `found`
        for _ in range(STEPS):
            off = distort(rays, coefficients) - distorted
            if np.all(np.abs(off) <= ACCURATE / 10):
                break
            rays = rays - _solve(slopes(rays, coefficients), off)
        left = np.abs(distort(rays, coefficients) - distorted)
        found = np.all(left <= ACCURATE * (1 + np.abs(distorted)), axis=-1)
        way = WAY[:, None, None] * rays[None]
        found &= np.all(_determinant(slopes(way, coefficients)) > 0, axis=0)
    rays = np.where(found[:, None], rays, 0.0)
    return Inverse(rays, np.linalg.inv(slopes(rays, coefficients)), found)


def _determinant(a: np.ndarray) -> np.ndarray:
    return a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0]


def _solve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a⁻¹ b of 2 x 2 matrices by Cramer's rule, infinite where a is singular."""
    first = a[..., 1, 1] * b[..., 0] - a[..., 0, 1] * b[..., 1]
    second = a[..., 0, 0] * b[..., 1] - a[..., 1, 0] * b[..., 0]
    return np.stack([first, second], axis=-1) / _determinant(a)[..., None]
