"""Film that is deformed smoothly and unsymmetrically, as images of non-metric cameras
show it."""

import numpy as np

POWERS = [(i, j) for i in range(5) for j in range(5) if 0 < i + j <= 4]


def film(rng, places, most=0.9, half=30.0):
    """The displacements of places (about the principal place) by another deformation at
    each call: polynomials of the fourth degree, at most `most` in an image with sides of
    2 `half`."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), -1).reshape(-1, 2)
    legendre = lambda t, k: np.polynomial.legendre.Legendre.basis(k)(t)
    coefficients = rng.normal(size=(2, len(POWERS)))
    coefficients /= np.array([(i + j) ** 1.5 for i, j in POWERS])

    def moved(t):
        basis = [legendre(t[:, 0], i) * legendre(t[:, 1], j) for i, j in POWERS]
        return (coefficients @ np.array(basis)).T

    return moved(places / half) * most / np.hypot(*moved(grid).T).max()
