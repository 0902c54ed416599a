"""The pairs every competitor orients."""

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from jaxro.geometry import mock_pairs

FOCAL = 150.0
"""mm"""


def aerial(
    pairs: int, points: int, *, sigma: float = 0.01, seed: int = 0
) -> tuple[NDArray[np.float64], ...]:
    """x_left, y_left, x_right, y_right (pairs, points) in mm, f = 150 mm.

    Points fill the overlap (base 90 mm, relief ± 10 % of the height); the right photo
    is turned by up to 3 degrees about each axis and lies up to 3 mm off the x axis;
    every coordinate carries normal noise `sigma`.
    """
    rng = np.random.default_rng(seed)
    base = 90.0
    shape = (pairs, points)
    height = FOCAL * (1 + rng.uniform(-0.1, 0.1, shape))
    ground = np.stack(
        [rng.uniform(0, base, shape), rng.uniform(-base, base, shape), -height], axis=-1
    )
    omega, phi, kappa = np.deg2rad(rng.uniform(-3, 3, (3, pairs)))
    one, zero = np.ones(pairs), np.zeros(pairs)
    r1 = [
        [one, zero, zero],
        [zero, np.cos(omega), np.sin(omega)],
        [zero, -np.sin(omega), np.cos(omega)],
    ]
    r2 = [
        [np.cos(phi), zero, -np.sin(phi)],
        [zero, one, zero],
        [np.sin(phi), zero, np.cos(phi)],
    ]
    r3 = [
        [np.cos(kappa), np.sin(kappa), zero],
        [-np.sin(kappa), np.cos(kappa), zero],
        [zero, zero, one],
    ]
    m = np.einsum("ijp,jkp,klp->pil", r3, r2, r1)
    station = np.stack(
        [np.full(pairs, base), rng.uniform(-3, 3, pairs), rng.uniform(-3, 3, pairs)],
        axis=-1,
    )
    right = np.einsum("pij,pnj->pni", m, ground - station[:, None])
    photos = [
        -FOCAL * image[..., axis] / image[..., 2]
        for image in (ground, right)
        for axis in (0, 1)
    ]
    return tuple(coordinate + rng.normal(0, sigma, shape) for coordinate in photos)


def any_position(
    pairs: int, points: int, *, sigma: float = 0.01, seed: int = 0
) -> tuple[NDArray[np.float64], ...]:
    """The same for photos in any position: any turn about the axes, axes up to 70°
    apart, base in any direction."""
    exact, _ = mock_pairs.random_pairs(jax.random.key(seed), pairs, points, focal=FOCAL)
    rng = np.random.default_rng(seed)
    return tuple(
        np.asarray(c) + rng.normal(0, sigma, c.shape) for c in exact.coordinates
    )


def with_wrong_points(
    coordinates: Sequence[NDArray[np.float64]],
    share: float,
    *,
    size: tuple[float, float] = (1.0, 10.0),
    seed: int = 0,
) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.bool_]]:
    """The pairs with this share of their points shifted in the right photo, by `size`
    mm in any direction; which."""
    rng = np.random.default_rng(seed)
    x_left, y_left, x_right, y_right = coordinates
    wrong = np.argsort(rng.random(x_left.shape), axis=1) < round(
        share * x_left.shape[1]
    )
    length, direction = (
        rng.uniform(*size, x_left.shape),
        rng.uniform(0, 2 * np.pi, x_left.shape),
    )
    shift = wrong * length
    return (
        x_left,
        y_left,
        x_right + shift * np.cos(direction),
        y_right + shift * np.sin(direction),
    ), wrong
