"""One of several images as a calibration of its own, and how well its distortion is
known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import simulated_image
from oracles_calibration import scene
from several_images import FEW, SIGMA, photos
from simulated_image import LENS

from jaxro import calibration
from jaxro.calibration.distortion import distortion_deviations
from jaxro.calibration.of_image import of_image


@pytest.mark.slow
def test_an_image_of_several_has_their_numbers():
    """Station, camera, deviations and residuals are those of the common adjustment."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-3, -3, -2], [3, 3, 2], (FEW, 3))
    _, image, point, places = photos(rng, points)
    given = np.where((np.arange(FEW) % 2 == 0)[:, None], points, np.nan)
    measured = calibration.images(*places.T, image, point, given, sigma=SIGMA)
    several = calibration.calibrate_together(measured, LENS)
    left = eqx.filter_jit(type(several).residuals)(several, places, image, point)

    @eqx.filter_jit
    def of(k, places, points):
        one = of_image(several, k)
        return one, one.misfits(places, points)

    for k in (0, 2):
        own = image == k
        one, misfits = of(jnp.asarray(k), places[own], several.points[point[own]])
        np.testing.assert_allclose(one.centre, several.centres[k], rtol=1e-9)
        deviations = several.centre_deviations[k]
        np.testing.assert_allclose(one.centre_deviations, deviations, rtol=1e-6)
        np.testing.assert_allclose(
            one.focal_deviations, several.focal_deviations[0], rtol=1e-6
        )
        np.testing.assert_allclose(one.principal, several.principal[0], rtol=1e-9)
        # the distortion changes little over a residual
        np.testing.assert_allclose(misfits, -left[own], rtol=0.01, atol=1e-3 * SIGMA)
        assert one.measured.mask.sum() == len(places)


def test_deviations_of_the_distortion_are_those_of_plain_algebra():
    """The errors of corrected places by differences of `correct`, from which the best
    shift, scale, swing and tilts are taken by least squares."""
    rng = np.random.default_rng(5)
    _, _, points, ideal = scene(rng, 40)
    places = ideal * (1 - 1e-5 * np.sum(ideal**2, axis=1, keepdims=True))
    noisy = places + rng.normal(0, simulated_image.SIGMA, places.shape)
    found = calibration.calibrate(simulated_image.image(points, noisy), LENS)
    covariance = np.asarray(found.covariance)[6:, 6:]

    def moved(k, step):
        parts = np.zeros(10)
        parts[k] = step
        camera = found.adjustment.parameters["camera"]
        new = eqx.tree_at(
            lambda c: (c.principal, c.focal, c.brown),
            camera,
            (
                camera.principal + parts[None, :2],
                camera.focal + parts[None, 2:3],
                camera.brown + parts[None, 3:],
            ),
        )
        where = lambda f: f.adjustment.parameters["camera"]
        return eqx.tree_at(where, found, new)

    half = np.asarray(found.frame.half_sides * found.frame.size)
    axis = np.linspace(-1, 1, 15)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) * half
    every = np.vstack([grid + np.asarray(found.frame.centre), noisy])
    # a change of the mean focal length scales all of them, which is taken out
    at = np.asarray(calibration.correct(found, every).places)
    columns = []
    for k in range(10):
        step = 1e-3 * np.sqrt(covariance[k, k])
        up, down = (
            np.asarray(calibration.correct(moved(k, s), every).places)
            for s in (step, -step)
        )
        columns.append(((up - down) / (2 * step)).ravel())
    x, y = at.T / np.asarray(found.frame.size)
    one, zero = np.ones_like(x), np.zeros_like(x)
    pose = np.stack(
        [
            np.stack(pair, axis=1).ravel()
            for pair in (
                *((one, zero), (zero, one), (x, y), (-y, x)),
                *((x * x, x * y), (x * y, y * y)),
            )
        ],
        axis=1,
    )
    slopes, of_grid = np.stack(columns, axis=1), 2 * len(grid)
    part = np.linalg.lstsq(pose[:of_grid], slopes[:of_grid], rcond=None)[0]
    left = (slopes - pose @ part)[of_grid:]
    expected = np.sqrt(np.einsum("ni,ij,nj->n", left, covariance, left))
    got = jax.jit(distortion_deviations)(found, jnp.asarray(noisy))
    np.testing.assert_allclose(np.asarray(got).ravel(), expected, rtol=1e-3)
