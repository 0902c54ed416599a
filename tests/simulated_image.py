"""One image of known points: simulated measurements, and the models that the tests of
calibration share. Each model is compiled once, for images of `N` points."""

import numpy as np
from oracles_calibration import scene

from jaxro import calibration
from jaxro.calibration import Brown, Model, Whole

N = 40
SIGMA = 0.006
AT = np.array([110.0, 70.0])
"""Where the principal place is measured."""

ONE = Model()
"""One focal length."""

TWO = Model(y=Whole())
"""A focal length along x, and one along y."""

STRIPS = Model(x=calibration.strips_along_x([0.0, 0.2, 0.7, 1.0]))
"""Three strips of different widths."""

TURN = 0.7
TURNED = Model(
    x=calibration.rectangles(2, 3, turn=TURN),
    y=calibration.rings(2, about_centroid=True),
)
"""Rectangles of the focal length along x, rings of that along y."""

LINEAR = Model(x=calibration.strips_along_y(2, degree=1))
"""Focal lengths that change linearly: one of their combinations imitates a tilt."""

LENS = Model(brown=Brown())
"""Brown's lens with all coefficients."""


def measured(seed, n=N, distort=lambda m: m, turn=0.0, **scene_options):
    """The truth of an image (omega, phi, kappa, X, Y, Z), its object points, and its
    measured places, in a system turned by `turn`."""
    rng = np.random.default_rng(seed)
    angles, station, points, places = scene(rng, n, **scene_options)
    errors = rng.normal(0, SIGMA, places.shape)
    c, s = np.cos(turn), np.sin(turn)
    places = (distort(places) + errors) @ np.array([[c, s], [-s, c]]) + AT
    return np.concatenate([angles, station]), points, places


def image(points, places, **options):
    """The `MeasuredImage`; y points down unless said otherwise."""
    options = {"sigma": SIGMA, "y_down": True} | options
    return calibration.image(*places.T, points, **options)


def three_strips(places):
    """The zones of `STRIPS`, by hand."""
    t = (places[:, 0] - places[:, 0].min()) / np.ptp(places[:, 0])
    return np.searchsorted([0.2, 0.7], t, side="right")


UNITS = np.array([1e-5, 1e-9, 1e-12, 1e-6, 1e-6, 1e-4, 1e-4])
"""Of Brown's coefficients k1, k2, k3, p1, p2, b1, b2."""


def corrected(about, k):
    """Places about the principal place with Brown's corrections, k in `UNITS`."""
    x, y = about.T
    k1, k2, k3, p1, p2, b1, b2 = k * UNITS
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
    dx = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y
    dy = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return about + np.column_stack([dx, dy])
