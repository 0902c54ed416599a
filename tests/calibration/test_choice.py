"""Which model an image needs: the right one is found, and it predicts."""

import numpy as np
import pytest
import simulated_image
from deformed_film import film
from oracles_calibration import scene
from simulated_image import LENS, ONE, SIGMA, N

from jaxro import calibration
from jaxro.calibration import Brown, Field, Model


def images(seed, n, distort):
    """A measured image, and 100 more points of it without errors: places, points."""
    rng = np.random.default_rng(seed)
    _, _, points, places = scene(rng, n + 100)
    places = places + distort(rng, places) + [100.0, 50.0]
    noisy = places[:n] + rng.normal(0, SIGMA, (n, 2))
    return simulated_image.image(points[:n], noisy), places[n:], points[n:]


def radial(rng, places):
    return places * np.sum(places**2, axis=1, keepdims=True) / 1800 * 0.9 / 42.4


def nothing(rng, places):
    return 0 * places


def error(found, places, points):
    """Root mean square of what is wrong in new places."""
    return float(np.sqrt(np.mean(np.asarray(found.misfits(places, points)) ** 2)))


def fields(lengths):
    """Displacement fields of these lengths, alone and with Brown's lens."""
    return [
        Model(brown=lens, field=Field(length, strength))
        for lens in (None, Brown())
        for length in lengths
        for strength in (10.0, 100.0)
    ]


RADIAL = Model(brown=Brown(1, tangential=False, affinity=False, shear=False))
FEW = (ONE, RADIAL, LENS, *fields([0.8]))
MORE = (ONE, RADIAL, LENS, *fields([0.8, 1.25]))


def test_the_model_that_an_image_needs():
    expected = {
        nothing: lambda model: model == ONE,
        radial: lambda model: model == RADIAL,
        film: lambda model: model.field is not None,
    }
    for distort, right in expected.items():
        image, places, points = images(1, N, distort)
        found, compared = calibration.choose(image, FEW)
        assert right(compared.best)
        assert np.all(np.isfinite(compared.figures.score))
        own = error(found.check(), places, points)
        best = min(
            error(calibration.calibrate(image, model), places, points)
            for model in (ONE, RADIAL, LENS)
        )
        assert own < (best / 3 if distort is film else 1.1 * best)
        number = int(np.argmin(np.asarray(compared.figures.score)))
        np.testing.assert_allclose(
            compared.figures.effective[number], found.effective, rtol=1e-6
        )
        np.testing.assert_allclose(
            compared.figures.sigma0[number], found.sigma0, rtol=1e-8
        )


@pytest.mark.slow
@pytest.mark.parametrize("n", [30, 60, 200])
def test_film_that_is_deformed_by_a_millimetre(n):
    gains = []
    for seed in range(10):
        image, places, points = images(seed, n, film)
        found, _ = calibration.choose(image)
        others = (calibration.calibrate(image, model) for model in (ONE, LENS))
        own = error(found, places, points)
        gains.append([error(other, places, points) / own for other in others])
    over_one, over_brown = np.median(gains, axis=0)
    assert over_one > (4 if n == 30 else 5)
    assert over_brown > (2 if n == 30 else 2.5)


@pytest.mark.slow
@pytest.mark.parametrize("n", [40, 100])
@pytest.mark.parametrize("distort", [film, radial, nothing])
def test_the_choice_is_hardly_worse_than_the_best_model(n, distort):
    """Its error in new places over the least error of all models that were tried."""
    regrets = []
    for seed in range(7):
        image, places, points = images(seed, n, distort)
        found, _ = calibration.choose(image, MORE)
        every = (calibration.calibrate(image, model) for model in MORE)
        errors = [error(one, places, points) for one in every]
        regrets.append(error(found.check(), places, points) / np.nanmin(errors))
    assert np.median(regrets) < 1.25
