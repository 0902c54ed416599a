"""Weights that fade after cleaning are an M-estimate, with its sigma0 and covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxro
from jaxro.adjustment.losses import GemanMcClure
from jaxro.rejection.fading import FADING, Fading, fade
from jaxro.reports.model import find_intervals
from jaxro.reports.reader import report_elements

FOCAL, POINTS = 2000.0, 60


@pytest.mark.parametrize("sigma", [1.0, 0.4])
def test_the_last_solution_is_that_of_orient_with_the_loss(sigma):
    """Of a pair with long tails, whatever sigma is stated."""
    rng = np.random.default_rng(6)
    left = rng.uniform(-1, 1, (POINTS, 2)) * [900, 700]
    depth = rng.uniform(3, 6, (POINTS, 1))
    right = left + FOCAL / depth * [1, 0]
    tails = np.where(rng.random((POINTS, 1)) < 0.15, 4.0, 1.0)
    points = np.concatenate([left, right], axis=1) + tails * rng.normal(
        0, 0.4, (POINTS, 4)
    )
    pair = jaxro.pair(*points.T, focal=FOCAL, sigma=sigma)
    plain = jaxro.orient(pair)
    use = jnp.ones(POINTS, bool)
    fading = jax.jit(fade)(pair, plain.pose, use)
    assert fading.needed
    weakened = jaxro.orient(fading.weaken(pair))
    found = jax.jit(Fading.spread)(fading, pair, use, weakened)
    loss = GemanMcClure(scale=float(FADING * fading.noise))
    wanted = jaxro.orient(pair, loss=loss)
    np.testing.assert_allclose(found.pose.base, wanted.pose.base, atol=1e-5)
    np.testing.assert_allclose(found.sigma0, wanted.sigma0, rtol=1e-4)
    roots = jnp.sqrt(jnp.diagonal(wanted.covariance))
    difference = (found.covariance - wanted.covariance) / jnp.outer(roots, roots)
    np.testing.assert_allclose(difference, 0, atol=1e-4)
    # the weights taken for known ones would promise more
    assert weakened.sigma0 < 0.95 * found.sigma0
    # the intervals by likelihood have these weights: nearly linear, they are as wide as
    # the deviations of the M-estimate say
    columns = {
        "result": found.result._value,
        "pose": jnp.stack(jax.tree.leaves(found.pose)),
        "curvature": 1.0,
        **{n: getattr(found, n) for n in ("cofactor", "sigma0", "degrees_of_freedom")},
    }
    columns = {name: np.asarray(value)[None] for name, value in columns.items()}
    measured = jax.tree.map(np.asarray, jaxro.join([pair]))
    (ends,) = find_intervals(measured, columns, jaxro.RelativePose, False).values()
    told = report_elements(found.elements, found.cofactor, found.sigma0)
    value, sd = (np.stack(numbers) for numbers in told)
    half = sd * scipy.stats.t.ppf(0.975, POINTS - 5)
    for end, there in ((ends.least, value - half), (ends.most, value + half)):
        assert np.all(np.abs(end - there)[1:] < 0.05 * half[1:])
