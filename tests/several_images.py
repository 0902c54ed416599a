"""Several images of the same points: simulated ones, and a published calibration."""

import numpy as np
from oracles_calibration import rays, rotation

SIGMA = 0.05
FEW, MANY = 14, 50
"""How many points the tests take: each number is compiled once."""


def photos(rng, points, images=4):
    """Truth (omega, phi, kappa, X, Y, Z of each image), and places of all points with a
    focal length of 900 about (512, 384), y down; only every second point is seen in the
    last image."""
    truth, places = [], []
    for k in range(images):
        angles = np.array([0.3 * (-1) ** k, 0.25 * (k - 1.5), 0.4 * k])
        turn = rotation(*angles)
        station = turn.T @ np.array([0.0, 0.0, 9.0 + k])
        truth.append([*angles, *station])
        places.append(900 * rays(np.array(truth[-1]), points) + [512, 384])
    image = np.repeat(np.arange(images), len(points))
    point = np.tile(np.arange(len(points)), images)
    seen = (image < images - 1) | (point % 2 == 0)
    places = np.concatenate(places)[seen]
    places = places + rng.normal(0, SIGMA, places.shape)
    return np.array(truth), image[seen], point[seen], places


def olympus(data):
    """The published calibration field: images, points, places in pixels, the known
    points; stations with their deviations (see SOURCE.txt there)."""
    folder = data / "olympus_camcal"
    rows = np.loadtxt(folder / "markpts.txt", delimiter=",")
    image = rows[:, 0].astype(int) - 1
    names, point = np.unique(rows[:, 1].astype(int), return_inverse=True)
    points = np.full((len(names), 3), np.nan)
    known = np.loadtxt(folder / "camcal-fixed.txt", delimiter=",", usecols=(0, 2, 3, 4))
    points[np.searchsorted(names, known[:, 0].astype(int))] = known[:, 1:]
    columns = (1, 2, 3, 7, 8, 9)
    stations = np.loadtxt(
        folder / "published_eo.csv", delimiter=",", skiprows=1, usecols=columns
    )
    return image, point, rows[:, 2:4], points, stations
