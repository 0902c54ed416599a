"""Zones as weights: they add up to one, are smooth, and are those of SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from jaxro.calibration import pieces, rectangles, rings
from jaxro.camera.area import Area


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("number", [1, 3, (0.0, 1.0, 4.0, 5.0)])
def test_weights_are_b_splines(number, degree):
    one = pieces(number, degree)
    t = np.linspace(-0.2, 1.2, 57)
    found = np.asarray(one.weights(jnp.asarray(t)))
    assert found.shape == (57, one.count)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    knots = np.concatenate([np.zeros(degree), np.array(one.borders), np.ones(degree)])
    expected = BSpline(knots, np.eye(one.count), degree, extrapolate=True)(t)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("wrong", [0, (1.0, 1.0), (2.0, 1.0)])
def test_pieces_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="pieces"):
        pieces(wrong)
    with pytest.raises(ValueError, match="degree"):
        pieces(2, 4)


def test_zones_add_up_to_the_whole():
    rng = np.random.default_rng(0)
    u = jnp.asarray(rng.uniform(-1, 1, (50, 2)))
    area = Area(u, jnp.ones(50, bool), jnp.ones(2), jnp.zeros(2))
    every = rectangles(3, 2), rectangles(2, 2, 2, turn=0.3), rings(3), rings(2, 1)
    weights = jax.jit(lambda u: [zones.weights(u, area) for zones in every])
    for zones, found in zip(every, weights(u), strict=True):
        assert found.shape == (50, zones.count)
        np.testing.assert_allclose(np.sum(found, axis=1), 1, atol=1e-12)
