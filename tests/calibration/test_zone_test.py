"""The F test of zones: its statistic is that of an independent solution, its level is
what it says, and it finds zones that differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import simulated_image
from oracles_calibration import gauss_newton, rays
from scipy import stats
from simulated_image import AT, LENS, ONE, SIGMA, STRIPS, TWO, image, three_strips

from jaxro import calibration
from jaxro.adjustment.critical_values import chi_squared_p, fisher_p
from jaxro.calibration import Model, Whole, rectangles, strips_along_x, zone_test


def four_rectangles(places):
    """The zones of `rectangles(2, 2)`."""
    low, high = places.min(0), places.max(0)
    right, below = ((places - low) / (high - low) >= 0.5).T
    return 2 * below + right


def measured(seed, step=0.0, zones=four_rectangles):
    """The truth of a photo, its object points, and its places; the focal length of the
    first zone is longer by `step`."""

    def longer(places):
        return places * (1 + step / 60 * (zones(places) == 0))[:, None]

    return simulated_image.measured(seed, distort=longer)


@pytest.mark.slow
def test_the_statistic_is_that_of_an_independent_solution():
    pose, points, places = measured(3, step=0.05, zones=three_strips)
    zone = three_strips(places)

    def squares(of_zone, count):
        def residuals(x):
            seen = x[6:8] + x[8:][of_zone][:, None] * rays(x, points)
            return ((places - seen) / SIGMA).ravel()

        begin = np.concatenate([pose, AT, np.full(count, 60.0)])
        return np.sum(residuals(gauss_newton(residuals, begin)[0]) ** 2)

    one, three = squares(0 * zone, 1), squares(zone, 3)
    f = (one - three) / 2 / (three / (80 - 11))
    found = zone_test.test_zones(image(points, places), STRIPS)
    assert found.usable and (found.above, found.below) == (2, 69)
    np.testing.assert_allclose(found.f, f, rtol=1e-6)
    np.testing.assert_allclose(found.probability, stats.f.sf(f, 2, 69), rtol=1e-6)
    assert found.probability < 1e-3


@pytest.mark.slow
def test_what_cannot_be_tested_is_refused_or_named():
    _, points, places = measured(3)
    whole = image(points, places)
    for single in (ONE, TWO, LENS):
        with pytest.raises(ValueError, match="one zone only"):
            zone_test.test_zones(whole, single)
    known = calibration.known(focal=60.0, focal_sigma=0.1)
    with pytest.raises(ValueError, match="a focal length is known"):
        zone_test.test_zones(whole, STRIPS, known)
    few = image(points, places, mask=np.arange(40) < 5)
    found = zone_test.test_zones(few, STRIPS)
    assert not found.usable and np.isnan(found.probability)


def test_probabilities_are_those_of_scipy():
    f, above, below = np.array([0.0, 0.5, 1.0, 4.0, 60.0]), 3.0, 68.0
    expected = stats.f.sf(f, above, below)
    np.testing.assert_allclose(fisher_p(f, above, below), expected, rtol=1e-9)
    expected = stats.chi2.sf(f, above)
    np.testing.assert_allclose(chi_squared_p(f, above), expected, rtol=1e-9)
    assert np.isnan(fisher_p(1.0, 0, 5)) and np.isnan(chi_squared_p(1.0, 0))


def probabilities(model, runs, step=0.0):
    """Of many simulated images, in chunks."""
    images = [image(*measured(seed, step=step)[1:]) for seed in range(runs)]
    every = jax.tree.map(lambda *a: jnp.stack(a), *images)

    def of_image(one):
        found = zone_test.test_zones(one, model)
        return found.probability, found.usable

    program = jax.jit(jax.vmap(of_image))
    chunks = (
        program(jax.tree.map(lambda a, k=k: a[k : k + 250], every))
        for k in range(0, runs, 250)
    )
    found, usable = (np.concatenate(part) for part in zip(*chunks, strict=True))
    assert usable.mean() > 0.98  # a zone may have no point
    return found[usable]


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        Model(x=rectangles(2, 2)),
        Model(x=strips_along_x(3)),
        Model(x=rectangles(2, 2), y=rectangles(2, 2)),
        Model(x=Whole(), y=strips_along_x(2)),
        Model(x=rectangles(2, 2, degree=1)),
        Model(x=rectangles(2, 2, degree=1), y=rectangles(2, 2, degree=1)),
        Model(x=calibration.strips_along_y(2, degree=2)),
        Model(x=calibration.rings(3)),
    ],
    ids=["rectangles", "strips", "two", "y", "bilinear", "two-bilinear", "2", "rings"],
)
def test_the_level_is_what_it_says(model):
    """Images without distortion: 3 to 7 % are rejected at 5 %."""
    assert 0.03 <= np.mean(probabilities(model, 1000) < 0.05) <= 0.07


@pytest.mark.slow
def test_zones_that_differ_are_found():
    model = Model(x=rectangles(2, 2))
    shares = [np.mean(probabilities(model, 250, s) < 0.05) for s in (0.01, 0.02, 0.04)]
    assert shares[0] < shares[1] < shares[2]
    assert shares[2] > 0.9
