"""The difference of two distortions: nothing where there is none, the F test of an
independent adjustment, and a level that is what it says."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles_calibration import gauss_newton, rays, scene

from jaxro import calibration
from jaxro.calibration import Brown, Field, Model
from jaxro.calibration.difference import difference
from jaxro.calibration.field import functions

SIGMA = 0.006
AT = np.array([110.0, 70.0])
LENS = Model(brown=Brown())
FILM = Model(field=Field(0.8, 30.0))


def lens(rng):
    """The displacements by a lens that is not centred."""
    k1, k2, p1, p2 = rng.normal(size=4) * [1e-5, 5e-9, 1e-5, 1e-5]

    def displaced(m):
        x, y = m.T
        r2 = x * x + y * y
        radial = k1 * r2 + k2 * r2**2
        dx = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        dy = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        return np.column_stack([dx, dy])

    return displaced


def film(rng, strength=30.0):
    """A displacement field with the a priori covariance of `FILM`, over the area that
    60 points in an image of 60 x 60 fill on the average."""
    a = rng.normal(0, strength * SIGMA, (24, 2))
    half = 30.0 * 59 / 61
    return lambda m: np.asarray(functions(jnp.asarray(m / half), 0.8)) @ a


def photo(rng, n, displaced, focal=60.0, sigma=SIGMA, **options):
    """The pose and the points of another photo by the same camera, and its places."""
    angles, station, points, places = scene(rng, n, focal=focal)
    places = places + displaced(places) + rng.normal(0, sigma, places.shape) + AT
    image = calibration.image(*places.T, points, sigma=SIGMA, y_down=True)
    return np.concatenate([angles, station, AT, [focal]]), points, places, image


def compared(seed, n, model, displacement, other=None, **options):
    """The `Difference` of two photos; the second has another displacement added."""
    rng = np.random.default_rng(seed)
    first = displacement(rng)
    more = (lambda m: 0 * m) if other is None else other(rng)
    both = first, lambda m: first(m) + more(m)
    images = [photo(rng, n, displaced)[3] for displaced in both]
    return difference(*(calibration.calibrate(i, model) for i in images), **options)


def test_nothing_differs_but_the_pose():
    """Photos without errors, one refocused."""
    rng = np.random.default_rng(1)
    displaced = lens(rng)
    images = [photo(rng, 40, displaced, focal, 0.0)[3] for focal in (60.0, 60.6)]
    first, second = (calibration.calibrate(image, LENS) for image in images)
    found = difference(first, second, refocused=True)
    # the inverse of Brown's corrections is no polynomial of his
    assert np.sqrt(np.mean(found.difference**2)) < 0.05 * SIGMA
    np.testing.assert_allclose(found.scale, 60 / 60.6 - 1, atol=5e-5)
    assert np.all(np.abs(found.turn) < 1e-3)
    assert found.above == 7


def test_the_statistic_is_that_of_an_independent_adjustment():
    """Brown's coefficients in common against coefficients of each, in NumPy."""
    rng = np.random.default_rng(4)
    displaced = lens(rng)
    photos = [photo(rng, 40, displaced) for _ in range(2)]
    found = difference(
        *(calibration.calibrate(one[3], LENS) for one in photos), refocused=True
    )
    units = np.array([1e-5, 1e-9, 1e-12, 1e-6, 1e-6, 1e-4, 1e-4])

    def residuals(x, k, one):
        _, points, places, _ = one
        x0, y0 = (places - x[6:8]).T
        k1, k2, k3, p1, p2, b1, b2 = k * units
        r2 = x0 * x0 + y0 * y0
        radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
        dx = x0 * radial + p1 * (r2 + 2 * x0 * x0) + 2 * p2 * x0 * y0
        dy = y0 * radial + p2 * (r2 + 2 * y0 * y0) + 2 * p1 * x0 * y0
        dx = dx + b1 * x0 + b2 * y0
        corrected = np.column_stack([x0 + dx, y0 + dy])
        return ((corrected - x[8] * rays(x, points)) / SIGMA).ravel()

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


def test_another_film_is_found():
    same = compared(2, 60, FILM, film)
    other = compared(2, 60, FILM, film, lambda rng: film(rng, 5.0))
    assert same.probability > 0.01 and other.probability < 1e-6
    assert same.places.shape == same.in_deviations.shape == (225, 2)
    assert np.mean(np.abs(same.in_deviations) < 3) > 0.97
    assert np.max(np.abs(other.in_deviations)) > 4


def test_what_cannot_be_compared_is_refused():
    rng = np.random.default_rng(1)
    _, points, places, image = photo(rng, 40, lens(rng))
    found = calibration.calibrate(image, LENS)
    upward = calibration.image(
        places[:, 0], -places[:, 1], points, sigma=SIGMA, y_down=False
    )
    with pytest.raises(ValueError, match="y points down"):
        difference(found, calibration.calibrate(upward, LENS))
    elsewhere = calibration.image(*(places + 500).T, points, sigma=SIGMA, y_down=True)
    with pytest.raises(ValueError, match="do not overlap"):
        difference(found, calibration.calibrate(elsewhere, LENS))
    plain = calibration.calibrate(image)
    with pytest.raises(ValueError, match="no distortion"):
        difference(plain, plain, refocused=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "displacement", "n"), [(LENS, lens, 40), (FILM, film, 60)]
)
def test_the_level_is_what_it_says(model, displacement, n):
    """500 pairs with one distortion: 3 to 7 % differ at 5 %."""
    found = [compared(seed, n, model, displacement) for seed in range(500)]
    assert 0.03 <= np.mean([one.probability < 0.05 for one in found]) <= 0.07
