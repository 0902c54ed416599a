"""Variance components against a dense restricted likelihood, and against the errors
that were put in."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxro import IndependentElements, orient, pad
from jaxro.assessment import variance_components as components
from jaxro.geometry import mock_pairs
from jaxro.xla.settings import COMPILE_FAST, known_settings

optimize = pytest.importorskip("scipy.optimize")

NEAR = (0.03, -0.05, 0.04, -0.02, 0.06)
CONVERGENT = (0.35, 0.02, 0.03, -0.30, -0.04)
SMALL, LARGE = 0.005, 0.012
FOCAL = BASE = 70.0
CLASSES = np.arange(16) % 3 == 0


@lru_cache
def program():
    """Noisy pairs and their orientations, from the true elements on."""

    def one(clean, true, key, sigma):
        errors = sigma * jax.random.normal(key, (4, 16), float)
        names = ("x_left", "y_left", "x_right", "y_right")
        measured = mock_pairs.plant(clean, **dict(zip(names, errors, strict=True)))
        return measured, orient(
            measured, elements=IndependentElements, base=BASE, start=true
        )

    return jax.jit(
        jax.vmap(one, in_axes=(None, None, 0, None)),
        compiler_options=known_settings(COMPILE_FAST),
    )


COUNT = 2_000
SIGMAS = {
    "by class": np.broadcast_to(np.where(CLASSES, LARGE, SMALL), (4, 16)),
    "by photo": np.repeat([[SMALL], [SMALL], [LARGE], [LARGE]], 16, axis=1),
    "1 : 3 : 9": np.broadcast_to(SMALL * 3.0 ** (np.arange(16) % 3), (4, 16)),
}
SIGMAS["few good"] = np.where(np.arange(16) < 6, SIGMAS["by photo"] / 4, 2 * LARGE)
"""Standard deviations of the coordinates, (4, 16)."""


@lru_cache
def batch(elements, sigmas, seed=0):
    """COUNT pairs of sixteen points, and their orientations."""
    true = IndependentElements(*(jnp.asarray(e) for e in elements))
    layout = mock_pairs.row_layout()
    heights = mock_pairs.relief(jax.random.key(5), layout, 10.0)
    clean = mock_pairs.mock_pair(layout, true, focal=FOCAL, base=BASE, heights=heights)
    keys = jax.random.split(jax.random.key(seed), COUNT)
    return program()(clean, true, keys, SIGMAS[sigmas])


def tables(pairs, found, count, size, groups):
    """The components of `count` tables of `size` pairs each."""
    part = lambda a: a[: count * size].reshape(count, size, *a.shape[1:])
    every = jax.tree.map(part, (pairs, found))
    return jax.jit(jax.vmap(lambda p, o: components.estimate(p, o, groups)))(*every)


def within_two(found, truth):
    for k, sigma in enumerate(truth):
        assert found.estimable[k], k
        assert abs(float(found.sigma[k]) - sigma) < 2 * float(
            found.standard_error[k]
        ), (
            k,
            found.sigma,
            found.standard_error,
        )


@pytest.mark.slow
def test_steps_do_not_run_in_a_circle():
    """Three classes 1 : 3 : 9 in thirty pairs, where the first steps make the small
    variance negative."""
    truth = np.array([0.005, 0.015, 0.045])
    found = tables(*batch(NEAR, "1 : 3 : 9"), 40, 30, (np.arange(16) % 3,) * 4)
    assert np.all(found.converged) and np.all(found.estimable[:, 1:])
    sigma = np.asarray(found.sigma)
    np.testing.assert_allclose(sigma[:, 1:], np.tile(truth[1:], (40, 1)), rtol=0.4)
    # thirty pairs tell the error of so small a variance to a third of it only
    off = (sigma[:, 0] ** 2 - truth[0] ** 2) / np.asarray(found.variance_error)[:, 0]
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.7 and np.all(np.abs(off) < 6)


@pytest.mark.slow
def test_classes_of_points_in_near_vertical_pairs():
    pairs, found = batch(NEAR, "by class")
    groups = (CLASSES.astype(int),) * 4
    result = components.estimate(pairs, found, groups)
    within_two(result, (SMALL, LARGE))
    assert bool(result.converged) and int(result.degrees_of_freedom) == 22_000
    assert np.all(result.standard_error < 2e-4)
    np.testing.assert_allclose(jnp.sum(result.redundancy), 22_000, rtol=1e-9)
    # points of zero weight and pairs that are not oriented take no part
    wide = jax.vmap(lambda p: pad(p, 18))(pairs)
    groups = (np.append(CLASSES, [True, True]).astype(int),) * 4
    again = components.estimate(wide, found, groups)
    np.testing.assert_allclose(again.sigma, result.sigma, rtol=1e-9)


@pytest.mark.slow
def test_both_photos_of_convergent_pairs():
    pairs, found = batch(CONVERGENT, "by photo")
    result = components.by_photo(pairs, found)
    within_two(result, (SMALL, LARGE))
    assert np.all(result.standard_error < 1e-3)
    np.testing.assert_allclose(result.pooled**2, (SMALL**2 + LARGE**2) / 2, rtol=0.05)


@pytest.mark.slow
def test_y_of_left_and_right_photo():
    """In convergent pairs y of both photos; x, which hardly enters, in a group of its
    own and told to be unknown."""
    pairs, found = batch(CONVERGENT, "by photo")
    result = components.estimate(pairs, found, (0, 1, 0, 2))
    assert np.all(result.estimable[1:])
    for k, sigma in ((1, SMALL), (2, LARGE)):
        assert abs(float(result.sigma[k]) - sigma) < 2 * float(result.standard_error[k])


@pytest.mark.slow
def test_what_is_not_estimable_is_told():
    """Near-vertical pairs know y of both photos only together, and nothing of x."""
    pairs, found = batch(NEAR, "by photo")
    result = components.estimate(pairs, found, (0, 1, 0, 1))
    np.testing.assert_array_equal(result.estimable, [False, True])
    assert result.sigma[0] == 0 and np.isinf(result.standard_error[0])
    assert abs(float(result.sigma[1]) ** 2 - (SMALL**2 + LARGE**2) / 2) < 2 * float(
        result.variance_error[1]
    )
    vertical = batch((0.0,) * 5, "by photo")
    result = components.estimate(*vertical, (0, 1, 0, 2))
    assert (
        not np.any(result.estimable)
        and np.all(np.isinf(result.standard_error))
        and not np.any(result.sigma)
    )
    np.testing.assert_allclose(result.pooled**2, (SMALL**2 + LARGE**2) / 2, rtol=0.1)


@pytest.mark.slow
def test_an_estimable_group_beside_others_that_are_not():
    """Few good points in vertical pairs, y of their photos not to be told apart: the
    others are estimated as well."""
    few = np.arange(16) < 6
    pairs, found = batch((0.0,) * 5, "few good")
    left, right = (np.where(few, k, 2) for k in (0, 1))
    result = components.estimate(pairs, found, (left, left, right, right))
    np.testing.assert_array_equal(result.estimable, [False, False, True])
    assert bool(result.converged)
    assert abs(float(result.sigma[2]) - 2 * LARGE) < 2 * float(result.standard_error[2])


def test_restricted_likelihood_is_largest():
    """The maximum over both variances, found by SciPy on dense matrices of all
    pairs."""
    pairs, found = jax.tree.map(lambda a: a[:120], batch(CONVERGENT, "by photo"))
    result = components.by_photo(pairs, found)
    parts = []
    for i in range(120):
        coordinates = np.stack([np.asarray(c[i]) for c in pairs.coordinates])
        at = np.array([float(v[i]) for v in found.elements.values()])
        a = oracles.jacobian(
            lambda e, c=coordinates: oracles.condition(
                oracles.independent, e, c, (FOCAL, FOCAL)
            ),
            at,
        )
        gradient = lambda k, c=coordinates, at=at: (
            oracles.condition(
                oracles.independent,
                at,
                c + 1j * oracles.STEP * np.eye(4)[k][:, None],
                (FOCAL, FOCAL),
            ).imag
            / oracles.STEP
        )
        b = np.stack([gradient(k) for k in range(4)])
        g = oracles.condition(oracles.independent, at, coordinates, (FOCAL, FOCAL))
        scale = np.sqrt(np.mean(b**2))
        parts.append(
            (
                a / scale,
                np.sum(b[:2] ** 2, axis=0) / scale**2,
                np.sum(b[2:] ** 2, axis=0) / scale**2,
                g / scale,
            )
        )

    def minus(log):
        """-2 log of the restricted likelihood, up to a constant."""
        out = 0.0
        for a, left, right, g in parts:
            d = np.exp(log[0]) * left + np.exp(log[1]) * right
            n = (a.T / d) @ a
            rest = g - a @ np.linalg.solve(n, a.T @ (g / d))
            out += np.sum(np.log(d)) + np.linalg.slogdet(n)[1] + rest @ (rest / d)
        return out

    best = optimize.minimize(
        minus,
        np.log([1e-4, 1e-4]),
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-9},
    )
    np.testing.assert_allclose(result.sigma, np.exp(best.x / 2), rtol=1e-3)


@pytest.mark.slow
def test_standard_errors_are_those_of_repetition():
    """A hundred times twenty pairs: the estimates scatter as their standard errors
    say."""
    pairs, found = batch(NEAR, "by class", seed=3)
    groups = (CLASSES.astype(int),) * 4
    many = tables(pairs, found, 100, 20, groups)
    assert np.all(many.estimable)
    for k, sigma in enumerate((SMALL, LARGE)):
        spread = np.std(np.asarray(many.sigma[:, k]) ** 2)
        error = np.mean(np.asarray(many.variance_error[:, k]))
        assert 0.78 < spread / error < 1.28, (
            spread,
            error,
        )  # three standard errors of the scatter of a hundred
        off = np.mean(np.asarray(many.sigma[:, k]) ** 2) - sigma**2
        assert abs(off) < 3 * error / 10


def test_groups_must_be_numbered():
    pairs, found = batch(NEAR, "by class")
    with pytest.raises(ValueError, match="without gaps"):
        components.estimate(pairs, found, (0, 2, 0, 2))
    with pytest.raises(ValueError, match="four groups"):
        components.estimate(pairs, found, (0, 1))
