"""Points from calibrated images: they, their covariances and their sums of squares are
those of one adjustment of everything, and what is wrong is named."""

import numpy as np
import pytest
from oracles_calibration import gauss_newton, rays
from simulated_image import AT, LENS, ONE, SIGMA, TWO, N, image

from jaxro import calibration
from jaxro.calibration.triangulate import RESULTS, triangulate

NEW = 10


def survey(seed, images, new=NEW):
    """Images around the object: the unknowns of each (omega, phi, kappa, station,
    principal place, focal length), all points, and their places in each image."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, -2], [3, 3, 2], (N + new, 3))
    poses, places = [], []
    for k in range(images):
        around = 2 * np.pi * k / images
        station = np.array([4 * np.cos(around), 4 * np.sin(around), 12.0])
        station = station + rng.normal(0, 0.3, 3)
        tilts = np.arctan2([station[1], -station[0]], 12) + rng.normal(0, 0.03, 2)
        pose = np.concatenate([tilts, rng.uniform(-3, 3, 1), station, AT, [60.0]])
        ideal = pose[8] * rays(pose, points) + pose[6:8]
        poses.append(pose)
        places.append(ideal + rng.normal(0, SIGMA, ideal.shape))
    return np.array(poses), points, np.array(places)


def calibrated(points, places, model=ONE):
    """Each image by its first points."""
    images = [image(points[:N], own[:N]) for own in places]
    return [calibration.calibrate(one, model) for one in images]


def test_points_are_those_of_an_adjustment_of_everything():
    """Both images, their calibration and two new points at once in NumPy."""
    poses, points, places = survey(1, 2, new=2)
    found = calibrated(points, places)
    sigmas = [SIGMA * float(one.sigma0) for one in found]

    def residuals(x):
        every = np.vstack([points[:N], x[18:].reshape(-1, 3)])
        parts = []
        for k in range(2):
            pose = x[9 * k : 9 * k + 9]
            apart = places[k] - pose[6:8] - pose[8] * rays(pose, every)
            parts.append(apart[: len(every)] / sigmas[k])
        return np.concatenate(parts).ravel()

    begin = np.concatenate([poses.ravel(), points[N:].ravel()])
    x, q = gauss_newton(residuals, begin)
    new = triangulate(found, places[:, N:])
    deviations = np.sqrt(np.diag(q))[18:].reshape(-1, 3)
    apart = np.abs(new.points - x[18:].reshape(-1, 3))
    assert np.all(apart < 2e-2 * deviations)
    np.testing.assert_allclose(new.deviations, deviations, rtol=1e-3)
    of_two = np.asarray(new.covariance_of(0, 1))
    size = np.outer(*deviations)
    np.testing.assert_allclose(of_two / size, q[18:21, 21:] / size, atol=2e-3)
    np.testing.assert_allclose(new.covariance_of(1, 1), new.covariances[1])
    # what the new points add to the sum of squares: the calibrations have 2n - 9 each
    added = np.sum(residuals(x) ** 2) - 2 * (2 * N - 9)
    np.testing.assert_allclose(np.sum(new.squares), added, rtol=1e-2)
    assert np.all(new.degrees_of_freedom == 1) and np.all(new.usable)
    assert np.all(new.freedom == 2 * (2 * N - 9))


@pytest.mark.slow
def test_what_is_wrong_is_named():
    _, points, places = survey(2, 3)
    found = calibrated(points, places)
    new = places[:, N:].copy()
    new[0, 0] = np.nan  # in two images
    new[:2, 1] = np.nan  # in one
    new[1, 2] += 20 * SIGMA * np.array([1.0, 1.0])
    met = triangulate(found, new)
    right = [0, *range(3, 10)]
    assert (met.result == RESULTS.too_few_rays)[1] and np.isnan(met.points[1]).all()
    assert np.all(met.usable[np.array(right)])
    assert met.probability[2] < 1e-6 < 1e-4 < np.min(met.probability[np.array(right)])
    np.testing.assert_array_equal(met.degrees_of_freedom[:1], [1])
    truth = points[N:][right]
    apart = np.abs(np.asarray(met.points)[right] - truth)
    assert np.all(apart < 4.5 * np.asarray(met.deviations)[right])
    # without the image in which it is wrong
    without = triangulate([found[0], found[2]], new[[0, 2]])
    assert without.probability[2] > 1e-3

    # an image and nearly the same again: rays without an angle
    same = triangulate([found[0], found[0]], places[[0, 0], N:])
    assert np.all(same.result == RESULTS.small_angle) and np.all(same.angle < 1e-6)
    # the places of each image turned by half a turn about its principal place
    turned = triangulate(found[:2], 2 * AT - places[:2, N:])
    assert np.any(turned.result == RESULTS.behind) and not np.any(turned.usable)


def test_bad_input_is_refused():
    _, points, places = survey(2, 3)
    found = calibrated(points, places)
    with pytest.raises(ValueError, match="at least two images"):
        triangulate(found[:1], places[:1])
    with pytest.raises(ValueError, match=r"shape \(3, points, 2\)"):
        triangulate(found, places[:2])


@pytest.mark.slow
@pytest.mark.parametrize("images", [2, 4])
@pytest.mark.parametrize("model", [TWO, LENS])
def test_intervals_hold_the_truth(images, model):
    """95 % intervals of ten points in each of 300 surveys, and the sum of squares."""
    held, probabilities = [], []
    for seed in range(300):
        _, points, places = survey(seed, images)
        met = triangulate(calibrated(points, places, model), places[:, N:])
        half = met.interval()[:, None] * met.deviations
        held.append(np.abs(met.points - points[N:]) <= half)
        probabilities.append(met.probability)
    assert 0.935 <= np.mean(held) <= 0.965
    assert 0.03 <= np.mean(np.array(probabilities) < 0.05) <= 0.07
