"""The pairs every competitor orients: near-vertical aerial photographs with measuring noise."""

import numpy as np
from numpy.typing import NDArray

FOCAL = 150.0
"""mm"""


def aerial(pairs: int, points: int, *, sigma: float = 0.01, seed: int = 0) -> tuple[NDArray[np.float64], ...]:
    """x_left, y_left, x_right, y_right (pairs, points) in mm, f = 150 mm.

    Points fill the overlap (base 90 mm, relief ± 10 % of the height); the right photo is turned by up to 3 degrees
    about each axis and lies up to 3 mm off the x axis; every coordinate carries normal noise `sigma`.
    """
    rng = np.random.default_rng(seed)
    base = 90.0
    shape = (pairs, points)
    height = FOCAL * (1 + rng.uniform(-0.1, 0.1, shape))
    ground = np.stack([rng.uniform(0, base, shape), rng.uniform(-base, base, shape), -height], axis=-1)
    omega, phi, kappa = np.deg2rad(rng.uniform(-3, 3, (3, pairs)))
    one, zero = np.ones(pairs), np.zeros(pairs)
    r1 = [[one, zero, zero], [zero, np.cos(omega), np.sin(omega)], [zero, -np.sin(omega), np.cos(omega)]]
    r2 = [[np.cos(phi), zero, -np.sin(phi)], [zero, one, zero], [np.sin(phi), zero, np.cos(phi)]]
    r3 = [[np.cos(kappa), np.sin(kappa), zero], [-np.sin(kappa), np.cos(kappa), zero], [zero, zero, one]]
    m = np.einsum("ijp,jkp,klp->pil", r3, r2, r1)
    station = np.stack([np.full(pairs, base), rng.uniform(-3, 3, pairs), rng.uniform(-3, 3, pairs)], axis=-1)
    right = np.einsum("pij,pnj->pni", m, ground - station[:, None])
    photos = [-FOCAL * image[..., axis] / image[..., 2] for image in (ground, right) for axis in (0, 1)]
    return tuple(coordinate + rng.normal(0, sigma, shape) for coordinate in photos)
