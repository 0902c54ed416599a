"""Regions and intervals by likelihood: against a search in plain NumPy, against the
deviations that they become, and against simulation with known truth."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import mock_photos
import numpy as np
import oracles
import pytest
import scipy.optimize
import scipy.stats

import jaxro
from jaxro import DependentElements, RelativePose
from jaxro.assessment import likelihood
from jaxro.assessment.sensitivity import displacement

SHORT = 0.04
"""A base over the distance of the points: 2.3°."""

PLACES, FEW = 8, 400
"""Places of the pairs, and pairs of a batch: they share programs."""


def walk(count, points, sigma, seed=1):
    """`count` pairs of nearly vertical photos with a short base, and their poses."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform((-0.5, -0.5, -1.4), (0.5, 0.5, -0.8), (count, points, 3))
    turn = np.stack([mock_photos.wolf(*t) for t in rng.normal(0, 0.05, (count, 3))])
    beyond = np.einsum("kij,knj->kni", turn, ground - np.array([SHORT, 0, 0]))
    exact = [-150 * p[..., k] / p[..., 2] for p in (ground, beyond) for k in (0, 1)]
    measured = [c + rng.normal(0, sigma, c.shape) for c in exact]
    pairs = jaxro.pair(*measured, focal=150.0, sigma=sigma)
    back = jnp.asarray(np.swapaxes(turn, 1, 2))
    matrix = tuple(tuple(back[:, i, j] for j in range(3)) for i in range(3))
    base = jnp.ones(count), jnp.zeros(count), jnp.zeros(count)
    truth = jax.vmap(lambda r, b: RelativePose.from_relative(r, b, jnp.ones(())))
    return jaxro.pad(pairs, PLACES), truth(matrix, base)


@cache
def oriented(count, points, sigma):
    """Such pairs, their true poses, and what is found of them."""
    pairs, truth = walk(count, points, sigma)
    return pairs, truth, jaxro.orient_batch(pairs)


def first(sigma=0.03):
    """A pair of seven points, its true pose, and what is found of it: with errors of
    .03 mm its deviations do not say it all."""
    return jax.tree.map(lambda a: a[3], oriented(FEW, 7, sigma))


def oracle(pair, bx):
    """The residuals g / (sigma |∇g|) as a function of the dependent elements, in plain
    NumPy."""
    used = np.asarray(pair.mask)
    measured = np.stack([np.asarray(c)[used] for c in pair.coordinates])
    focal, sigma = (float(pair.focal_left),) * 2, float(pair.sigma[0])

    def residuals(elements):
        g = lambda moved: oracles.condition(
            oracles.dependent(bx), elements, measured + moved, focal
        )
        step = 1j * oracles.STEP * np.eye(4)[:, :, None]
        gradient = [g(e).imag / oracles.STEP for e in step]
        return g(0.0) / (sigma * np.sqrt(np.sum(np.square(gradient), axis=0)))

    return residuals


@pytest.mark.slow
def test_the_ends_are_those_of_a_search():
    """At an end of the interval of an element the misfit cannot be less than the limit,
    whatever the other elements are."""
    pair, _, found = first()
    assert float(likelihood.curvature(pair, found, sigma0=1.0)) > likelihood.CURVED
    elements = jaxro.convert(found.pose, DependentElements, jnp.ones(()))
    limit = jnp.asarray(scipy.stats.chi2.ppf(0.95, 1))
    interval = likelihood.ends(pair, elements, limit, quantity=displacement)
    residuals, centre = oracle(pair, 1.0), np.array(elements.values())
    lowest = np.sum(residuals(centre) ** 2)
    for k, end in enumerate(np.stack(interval, axis=1)):
        for held in end:

            def white(others, k=k, held=held):
                return residuals(centre + np.insert(others, k, held))

            least = scipy.optimize.least_squares(
                white, np.zeros(4), x_scale=1e-3, xtol=1e-12, ftol=1e-12, gtol=1e-12
            )
            assert 2 * least.cost - lowest == pytest.approx(float(limit), rel=1e-6)


@pytest.mark.slow
def test_the_region_and_its_numbers_do_not_depend_on_the_elements():
    """Which poses are in the region, and from where to where kappa reaches, is the same
    whatever elements describe them."""
    pair, truth, found = first()
    limit = jnp.asarray(4.0)

    def kappa(centre, elements):
        pose = jaxro.to_pose(elements)
        return jaxro.convert(pose, DependentElements, jnp.ones(())).kappa[None]

    told = []
    for system in (RelativePose, DependentElements):
        elements = jaxro.convert(found.pose, system, jnp.ones(()))
        told.append(likelihood.ends(pair, elements, limit, quantity=kappa))
        other = jaxro.convert(truth, system, jnp.ones(()))
        assert bool(likelihood.region_holds(pair, found, elements, 0.01, sigma0=1.0))
        held = [
            bool(likelihood.region_holds(pair, found, other, level, sigma0=1.0))
            for level in (0.01, 0.9999)
        ]
        assert held == [False, True]
    np.testing.assert_allclose(*map(np.concatenate, told), rtol=1e-6)


@pytest.mark.slow
def test_small_errors_leave_the_deviations():
    """Of errors a thousand times smaller S is its parabola, and the interval by
    likelihood that by Student's t."""
    pair, _, found = first(3e-5)
    assert float(likelihood.curvature(pair, found)) < 1e-2
    interval, width = likelihood.interval(pair, found), found.interval()
    np.testing.assert_allclose(interval.most, width, rtol=2e-2)
    np.testing.assert_allclose(interval.least, -width, rtol=2e-2)


@pytest.mark.slow
def test_an_end_within_the_region_is_found():
    """No direction has a larger component along x than 1, and x is in the region."""
    pair, _, found = first()
    along = lambda centre, elements: elements.bx[None]
    least, most = likelihood.interval(pair, found, 0.999, quantity=along, sigma0=1.0)
    assert least[0] < found.pose.bx < most[0]
    assert most[0] == pytest.approx(1.0, abs=1e-7)


def test_what_has_no_sigma0_has_no_region():
    pair, truth, found = without_sigma0()
    assert np.isnan(likelihood.curvature(pair, found))
    assert bool(likelihood.region_holds(pair, found, truth))


@pytest.mark.slow
def test_what_has_no_sigma0_has_no_end():
    pair, _, found = without_sigma0()
    assert not np.any(np.isfinite(np.stack(likelihood.interval(pair, found))))


def without_sigma0():
    """A pair, its true pose, and an orientation without redundancy."""
    pair, truth, found = first()
    found = dataclasses.replace(
        found,
        sigma0=jnp.asarray(jnp.nan),
        degrees_of_freedom=jnp.zeros_like(found.degrees_of_freedom),
    )
    return pair, truth, found


@pytest.mark.slow
@pytest.mark.parametrize("points", [6, 7])
@pytest.mark.parametrize(
    "count", [FEW, pytest.param(4000, marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_regions_hold_as_often_as_they_say(points, count):
    """Of short bases and hardly more points than unknowns, where those by the covariance
    do not."""
    pairs, truth, found = oriented(count, points, 0.03)

    def judge(pair, orientation, pose):
        held = likelihood.region_holds(pair, orientation, pose, sigma0=1.0)
        away = displacement(orientation.pose, pose)
        squared = away @ jnp.linalg.solve(orientation.cofactor, away)
        return held, squared <= orientation.radius(sigma0=1.0) ** 2

    usable = np.asarray(found.usable)
    each = jax.jit(jax.vmap(judge))(pairs, found, truth)
    by_likelihood, by_covariance = (np.mean(np.asarray(h)[usable]) for h in each)
    assert abs(by_likelihood - 0.95) < 0.02 + 0.5 / count**0.5
    assert by_covariance < 0.92
