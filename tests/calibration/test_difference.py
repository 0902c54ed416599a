"""The difference of two distortions: nothing where there is none, the F test of an
independent adjustment, and a level that is what it says."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles_calibration import gauss_newton, rays, scene
from simulated_image import AT, LENS, SIGMA, N, corrected, image

from jaxro import calibration
from jaxro.calibration import Field, Model
from jaxro.calibration.difference import difference
from jaxro.camera.field import functions

FILM = Model(field=Field(0.8, 30.0))


def lens(rng):
    """The displacements by a lens that is not centred."""
    k1, k2, p1, p2 = rng.normal(size=4) * [1, 5, 10, 10]
    k = np.array([k1, k2, 0, p1, p2, 0, 0])
    return lambda m: corrected(m, k) - m


def film(rng, strength=30.0):
    """A displacement field with the a priori covariance of `FILM`, over the area that
    the points of an image of 60 x 60 fill on the average."""
    a = rng.normal(0, strength * SIGMA, (24, 2))
    half = 30.0 * (N - 1) / (N + 1)
    return lambda m: np.asarray(functions(jnp.asarray(m / half), 0.8)) @ a


def photo(rng, displaced, focal=60.0, sigma=SIGMA):
    """The pose and the points of another photo by the same camera, its places, and the
    measured image."""
    angles, station, points, places = scene(rng, N, focal=focal)
    places = places + displaced(places) + rng.normal(0, sigma, places.shape) + AT
    pose = np.concatenate([angles, station, AT, [focal]])
    return pose, points, places, image(points, places)


def compared(seed, model, displacement, other=None):
    """The `Difference` of two photos; the second has another displacement added."""
    rng = np.random.default_rng(seed)
    first = displacement(rng)
    more = (lambda m: 0 * m) if other is None else other(rng)
    both = first, lambda m: first(m) + more(m)
    images = [photo(rng, displaced)[3] for displaced in both]
    return difference(*(calibration.calibrate(i, model) for i in images))


@pytest.mark.slow
def test_nothing_differs_but_the_pose():
    """Photos without errors, one refocused."""
    rng = np.random.default_rng(1)
    displaced = lens(rng)
    images = [photo(rng, displaced, focal, 0.0)[3] for focal in (60.0, 60.6)]
    first, second = (calibration.calibrate(one, LENS) for one in images)
    found = difference(first, second, refocused=True)
    # the inverse of Brown's corrections is no polynomial of his
    assert np.sqrt(np.mean(found.difference**2)) < 0.05 * SIGMA
    np.testing.assert_allclose(found.scale, 60 / 60.6 - 1, atol=5e-5)
    assert np.all(np.abs(found.turn) < 1e-3)
    assert found.above == 7


@pytest.mark.slow
def test_the_statistic_is_that_of_an_independent_adjustment():
    """Brown's coefficients in common against coefficients of each, in NumPy."""
    rng = np.random.default_rng(4)
    displaced = lens(rng)
    photos = [photo(rng, displaced) for _ in range(2)]
    found = difference(
        *(calibration.calibrate(one[3], LENS) for one in photos), refocused=True
    )

    def residuals(x, k, one):
        _, points, places, _ = one
        about = corrected(places - x[6:8], k)
        return ((about - x[8] * rays(x, points)) / SIGMA).ravel()

    def own(x):
        parts = (
            residuals(x[16 * k :], x[16 * k + 9 : 16 * k + 16], photos[k])
            for k in (0, 1)
        )
        return np.concatenate(list(parts))

    def common(x):
        parts = (residuals(x[9 * k :], x[18:], photos[k]) for k in (0, 1))
        return np.concatenate(list(parts))

    zeros, poses = np.zeros(7), [one[0] for one in photos]
    begin = np.concatenate([poses[0], zeros, poses[1], zeros])
    separate = np.sum(own(gauss_newton(own, begin)[0]) ** 2)
    begin = np.concatenate([*poses, zeros])
    together = np.sum(common(gauss_newton(common, begin)[0]) ** 2)
    assert (found.above, found.below) == (7, 160 - 32)
    f = (together - separate) / 7 / (separate / 128)
    np.testing.assert_allclose(found.f, f, rtol=0.03)


@pytest.mark.slow
def test_another_film_is_found():
    same = compared(2, FILM, film)
    other = compared(2, FILM, film, lambda rng: film(rng, 5.0))
    assert same.probability > 0.01 and other.probability < 1e-6
    assert same.places.shape == same.in_deviations.shape == (225, 2)
    assert np.mean(np.abs(same.in_deviations) < 3) > 0.97
    assert np.max(np.abs(other.in_deviations)) > 4


def test_what_cannot_be_compared_is_refused():
    rng = np.random.default_rng(1)
    _, points, places, whole = photo(rng, lens(rng))
    found = calibration.calibrate(whole, LENS)
    upward = image(points, places * [1, -1], y_down=False)
    with pytest.raises(ValueError, match="y points down"):
        difference(found, calibration.calibrate(upward, LENS))
    elsewhere = calibration.calibrate(image(points, places + 500), LENS)
    with pytest.raises(ValueError, match="do not overlap"):
        difference(found, elsewhere)
    plain = calibration.calibrate(whole)
    with pytest.raises(ValueError, match="no distortion"):
        difference(plain, plain, refocused=True)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "displacement"), [(LENS, lens), (FILM, film)])
def test_the_level_is_what_it_says(model, displacement):
    """500 pairs with one distortion: 3 to 7 % differ at 5 %."""
    found = [compared(seed, model, displacement) for seed in range(500)]
    assert 0.03 <= np.mean([one.probability < 0.05 for one in found]) <= 0.07
