"""Corrected coordinates are those of an ideal camera, within their deviations."""

import numpy as np
import pytest
from oracles_calibration import rotation, scene
from simulated_image import LENS, SIGMA, TWO, N, image

import jaxro
from jaxro import calibration


def test_corrected_coordinates_are_those_of_an_ideal_camera():
    """Of a stretched and lens-distorted image, without errors."""
    rng = np.random.default_rng(2)
    _, _, points, ideal = scene(rng, 2 * N)
    r2 = np.sum(ideal**2, axis=1, keepdims=True)
    places = ideal * (1 - 1e-5 * r2) + [100.0, 50.0]
    known, new = slice(0, N), slice(N, 2 * N)
    noisy = places[known] + rng.normal(0, SIGMA, (N, 2))
    found = calibration.calibrate(image(points[known], noisy), LENS).check()
    new_places = np.vstack([places[new], [[160.0, 50.0]]])
    corrected = calibration.correct(found, new_places)
    assert not corrected.inside[-1] and corrected.inside[:-1].mean() > 0.6

    # through the camera that was found: the object points are met
    turn, centre = np.asarray(found.rotation), np.asarray(found.centre)
    seen = (points[new] - centre) @ turn.T
    met = -float(corrected.focal) * seen[:, :2] / seen[:, 2:]
    inside = corrected.inside[:-1]
    apart = (met - np.asarray(corrected.places)[:-1])[inside]
    assert np.sqrt(np.mean(apart**2)) < 1.5 * SIGMA
    assert np.all(np.asarray(corrected.deviations)[:-1][inside] < 0.2)
    np.testing.assert_allclose(corrected.sigma, found.sigma0 * SIGMA, rtol=1e-9)


@pytest.mark.slow
def test_two_corrected_photos_are_a_pair():
    """From raw coordinates of two stretched photos to their relative orientation."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-3, -3, -2], [3, 3, 2], (N, 3))
    sides, truths = [], []
    for x, angle in ((-2.0, -0.15), (2.0, 0.15)):
        turn = rotation(0.05, angle, 0.1 * x)
        seen = (points - [x, 0.0, 12.0]) @ turn.T
        ideal = -60 * seen[:, :2] / seen[:, 2:]
        places = ideal * [1.01, -1.0] + [100.0, 50.0]  # stretched, y down
        noisy = places + rng.normal(0, SIGMA, places.shape)
        found = calibration.calibrate(image(points, noisy), TWO).check()
        sides.append(calibration.correct(found, noisy))
        truths.append(turn)
    left, right = sides
    pair = jaxro.pair(
        *left.places.T,
        *right.places.T,
        focal=(left.focal, right.focal),
        sigma=SIGMA,
    )
    orientation = jaxro.orient(pair).check()
    assert 0.5 < orientation.sigma0 < 2.0
    relative, _ = orientation.pose.relative()
    expected = truths[0] @ truths[1].T
    np.testing.assert_allclose(np.array(relative), expected, atol=5e-3)
