"""Promised deviations, intervals and regions against simulation with known truth, and
against SciPy's quantiles."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.stats

import jaxro
from jaxro import IndependentElements, losses, rejection
from jaxro.adjustment import m_estimates
from jaxro.batches.after_cleaning import Agreement, difference, repeat_cleaning
from jaxro.geometry import mock_pairs
from jaxro.orientation import planes
from jaxro.orientation.verdict import WEAK
from jaxro.reports.reliability import may_be_chance

BASE = 70.0
TRUE = IndependentElements(*(jnp.asarray(e) for e in (0.03, -0.05, 0.04, -0.02, 0.06)))


def measured(count, points, wrong=0.0, sigma=0.01):
    """Pairs of one layout with relief; a share of `wrong` points has errors five times
    as large."""
    rng = np.random.default_rng(points)
    layout = mock_pairs.row_layout()
    if points != 16:
        x, y = rng.uniform(-0.1, 1.1, points), rng.uniform(-1, 1, points)
        layout = mock_pairs.Layout(tuple(x), tuple(y), (1,) * points)
    mock = mock_pairs.mock_pair(layout, TRUE, heights=rng.uniform(-8, 8, points))
    errors = (
        sigma
        * rng.normal(size=(4, count, points))
        * np.where(rng.random((count, points)) < wrong, 5, 1)
    )
    coordinates = [
        np.asarray(c) + e for c, e in zip(mock.coordinates, errors, strict=True)
    ]
    return jaxro.pair(*coordinates, focal=70.0, sigma=sigma)


def held(count, points, loss, wrong=0.0):
    """Empirical over promised deviation, and the share of joint 95 % regions that hold
    the truth."""
    found = jaxro.orient_batch(
        measured(count, points, wrong),
        elements=IndependentElements,
        base=BASE,
        loss=loss,
    )
    good = np.asarray(found.usable)
    errors = (np.stack(found.elements.values(), axis=1) - np.array(TRUE.values()))[good]
    covariance = np.asarray(found.covariance)[good]
    promised = np.mean(np.diagonal(covariance, axis1=1, axis2=2), axis=0)
    squared = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(covariance), errors)
    inside = squared <= np.asarray(found.radius(0.95))[good] ** 2
    return np.mean(np.sqrt(np.mean(errors**2, axis=0) / promised)), np.mean(inside)


@pytest.mark.slow
@pytest.mark.parametrize(
    "loss",
    [losses.Huber(), losses.GemanMcClure()],
    ids=lambda loss: type(loss).__name__,
)
def test_regions_with_a_loss_hold_what_they_promise(loss):
    ratio, inside = held(600, 16, loss)
    assert 0.88 < ratio < 1.12 and 0.91 < inside < 0.98


@pytest.mark.slow
@pytest.mark.parametrize("points", [16, 50])
@pytest.mark.parametrize(
    "loss", [losses.Huber(), losses.SoftL1(), losses.Cauchy(), losses.Tukey()]
)
def test_deviations_with_a_loss(loss, points):
    ratio, inside = held(10_000, points, loss)
    assert abs(ratio - 1) < 0.03 and 0.94 < inside < 0.965


@pytest.mark.parametrize(
    "loss",
    [
        losses.Huber(),
        losses.Cauchy(),
        losses.Tukey(),
        losses.SoftL1(),
        losses.GemanMcClure(),
    ],
)
def test_scale_is_that_of_normal_errors(loss):
    """E rho(tau² z²) by SciPy's quadrature gives tau back, with the derivative of
    finite differences."""
    z = np.linspace(-9, 9, 200_001)
    density = scipy.stats.norm.pdf(z) * (z[1] - z[0])
    for tau in (0.3, 1.0, 2.5):
        mean = float(
            np.sum(np.asarray(loss.rho(jnp.asarray((tau * z) ** 2))) * density)
        )
        value, slope = jax.value_and_grad(lambda m: m_estimates.scale(loss, m))(
            jnp.asarray(mean)
        )
        np.testing.assert_allclose(value, tau, rtol=2e-4)
        step = 1e-5 * mean
        ends = [m_estimates.scale(loss, jnp.asarray(mean + s)) for s in (-step, step)]
        np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * step), rtol=1e-5)


def test_intervals_and_radius_are_the_quantiles_of_scipy():
    found = jaxro.orient(problems.tilted())
    deviations = np.asarray(found.deviations)
    np.testing.assert_allclose(
        found.interval(0.9), scipy.stats.t.isf(0.05, 11) * deviations, rtol=1e-8
    )
    known = 0.01 * np.sqrt(np.diagonal(found.cofactor))
    np.testing.assert_allclose(
        found.interval(0.9, sigma0=0.01), scipy.stats.norm.isf(0.05) * known, rtol=1e-8
    )
    np.testing.assert_allclose(
        found.radius(0.9), np.sqrt(5 * scipy.stats.f.isf(0.1, 5, 11)), rtol=1e-8
    )
    np.testing.assert_allclose(
        found.radius(0.9, sigma0=0.01), np.sqrt(scipy.stats.chi2.isf(0.1, 5)), rtol=1e-8
    )


@pytest.mark.slow
@pytest.mark.parametrize("points", [6, 7])
@pytest.mark.parametrize("sigma", [1e-3, 1e-2])
def test_intervals_of_few_points_called_successful(points, sigma):
    """Photos in any position, no sigma given: errors of f / 100,000 and f / 10,000."""
    count = 6000
    pairs, true = mock_pairs.random_pairs(jax.random.key(points), count, points)
    keys = jax.random.split(jax.random.key(points + 100), count)
    found = jaxro.orient_batch(
        jax.vmap(mock_pairs.noisy, in_axes=(0, 0, None))(pairs, keys, sigma)
    )
    away = np.abs(np.stack(jax.vmap(difference)(found.pose, true), axis=1))
    successful = np.asarray(found.result == jaxro.RESULTS.successful)
    inside = away[successful] <= np.asarray(found.interval(0.95))[successful]
    assert np.mean(successful) > 0.5 and 0.94 < np.mean(inside) < 0.96


def test_second_orientation_of_a_plane_has_the_same_homography():
    """Of an errorless plane scene both fit exactly, and H = Rᵀ (I - b nᵀ) is the same,
    but for its scale."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.5, 1.4, 12), rng.uniform(-0.7, 0.7, 12)
    points = np.column_stack([x, y, -1.7 + 0.1 * x - 0.2 * y])
    beyond = points - [1.0, 0.0, 0.0]
    seen = lambda p: (-100 * p[:, 0] / p[:, 2], -100 * p[:, 1] / p[:, 2])
    pair = jaxro.pair(*seen(points), *seen(beyond), focal=100.0, sigma=0.01)
    found = jaxro.orient(pair)
    assert found.result == jaxro.RESULTS.two_solutions
    two = planes.poses(pair, found)
    assert (
        bool(two.exists)
        and max(map(float, two.squares)) < 1e-12
        and max(map(float, two.behind)) == 0
    )
    homographies = []
    for pose, normal in zip(two.poses, two.normals, strict=True):
        rotation, base = problems.rotation_base(pose)
        h = rotation.T @ (np.eye(3) - np.outer(base, np.asarray(normal)))
        homographies.append(h / np.cbrt(np.linalg.det(h)))
    np.testing.assert_allclose(*homographies, atol=1e-6)
    turn, shift = problems.difference(
        two.poses[1], *problems.rotation_base(two.poses[0])
    )
    assert max(turn, shift) > 0.05


@pytest.mark.slow
def test_after_cleaning_tells_what_a_procedure_is_worth():
    """Errors of a dozen sigma are found nearly always, of four only at times; without
    any the region holds 95 %."""
    procedure = rejection.DataSnooping()
    clean = jax.tree.map(lambda a: a[0], measured(1, 16))
    wrong = mock_pairs.plant(clean, y_right=jnp.zeros(16).at[5].set(0.4))
    for pair, largest, least, most in (
        (wrong, None, 0.8, 1.0),
        (wrong, 0.03, 0.0, 0.5),
        (clean, None, 0.9, 1.0),
    ):
        rejected = procedure(pair)
        told = jaxro.after_cleaning(
            pair,
            rejected,
            procedure,
            jax.random.key(1),
            repetitions=500,
            largest=largest,
        )
        assert least <= told.exactly_right <= most
        assert told.without_wrong >= told.exactly_right
    assert told.without_wrong == 1 and 0.9 < told.coverage < 0.98
    for each in (told.intervals, told.intervals_known):
        np.testing.assert_allclose(each, 0.95, atol=0.04)


@pytest.mark.slow
@pytest.mark.parametrize(("points", "wrong"), [(8, 0), (12, 1), (16, 2), (24, 3)])
def test_the_promise_is_kept(points, wrong):
    """The share of regions that hold where as many points are rejected as are wrong,
    promised from single pairs, against the share counted over many with known truth."""
    procedure, largest, count = rejection.DataSnooping(), 0.1, 3000
    rng = np.random.default_rng(points)
    pairs = measured(count, points)
    place = np.argsort(rng.random((count, points)), axis=1) < wrong
    sizes = largest * rng.uniform(0.5, 1, (2, count, points)) * place
    x_right, y_right = sizes * rng.choice([-1, 1], sizes.shape)
    pairs = jax.vmap(lambda p, x, y: mock_pairs.plant(p, x_right=x, y_right=y))(
        pairs, jnp.asarray(x_right), jnp.asarray(y_right)
    )
    found = jaxro.clean_batch(pairs, procedure)
    photos, truth = found.orientation, jaxro.to_pose(TRUE)
    off = np.stack(jax.vmap(lambda pose: difference(truth, pose))(photos.pose), axis=1)
    decided = np.sum(~np.asarray(found.mask), axis=1) == wrong
    good = np.asarray(photos.usable & (photos.degrees_of_freedom > 0)) & decided
    cofactor = np.asarray(photos.cofactor)[good]
    squared = np.einsum("ki,kij,kj->k", off[good], np.linalg.inv(cofactor), off[good])
    counted = np.mean(squared <= scipy.stats.chi2.ppf(0.95, 5))
    each = []
    for k in np.flatnonzero(good)[:6]:
        pair, rejected = jax.tree.map(lambda a, k=k: a[k], (pairs, found))
        key = jax.random.key(k)
        told = jaxro.after_cleaning(pair, rejected, procedure, key, largest=largest)
        each.append(float(told.coverage_known))
    assert np.mean(each) == pytest.approx(counted, abs=0.02)


@pytest.mark.slow
def test_the_promise_is_kept_where_neighbours_agree():
    """The same in a table whose errors agree by .6 over a seventh of the photo, with the
    deviations that allow for it: the intervals of single elements."""
    points, count, procedure = 16, 1000, rejection.DataSnooping()
    rng = np.random.default_rng(0)
    left = rng.uniform(-80, 80, (points, 2))
    depth = rng.uniform(135, 165, (points, 1))
    right = left - 150 / depth * [60.0, 0.0]
    exact = jaxro.pair(*left.T, *right.T, focal=150.0, sigma=0.005)
    roots = np.asarray(Agreement(0.6, 24.0).roots(exact))
    apart = np.sum((left[0] - left[1]) ** 2)
    agree = roots[0] @ roots[0].T
    np.testing.assert_allclose(np.diagonal(agree), 1)
    assert agree[0, 1] == pytest.approx(0.6 * np.exp(-apart / 24.0**2))
    noise = np.einsum("pij,kpjc->kpic", roots, rng.normal(size=(count, 2, points, 2)))
    measured = np.stack([left, right]) + 0.005 * noise
    place = np.argsort(rng.random((count, points)), axis=1) < 1
    sizes = 0.1 * rng.uniform(0.5, 1, (count, points, 2)) * place[:, :, None]
    measured[:, 1] += sizes * rng.choice([-1, 1], sizes.shape)
    four = np.moveaxis(measured, 3, 2).reshape(count, 4, points)
    pairs = jaxro.pair(*np.moveaxis(four, 1, 0), focal=150.0, sigma=0.005)
    found = jaxro.clean_batch(pairs, procedure)
    used = pairs.with_mask(found.in_use)
    photos, pattern = jaxro.table_neighbours.allow(used, found.orientation)
    assert pattern is not None and pattern.sure
    decided = np.sum(~np.asarray(found.mask), axis=1) == 1
    good = np.asarray(photos.usable) & decided
    truth = jaxro.RelativePose(*map(jnp.asarray, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)))
    off = np.stack(jax.vmap(lambda pose: difference(truth, pose))(photos.pose), axis=1)
    wide = np.asarray(photos.interval(sigma0=1.0))
    counted = np.mean((np.abs(off) <= wide)[good], axis=0)
    agreement = Agreement(float(pattern.rho), float(pattern.length))
    each = []
    for k in np.flatnonzero(good)[:6].tolist():
        pair, rejected = jax.tree.map(lambda a, k=k: a[k], (pairs, found))
        told = repeat_cleaning(
            pair,
            rejected.orientation.pose,
            rejected.mask,
            procedure,
            jax.random.key(k),
            largest=0.1,
            agreement=agreement,
        )
        each.append(np.asarray(told.intervals_known))
    assert np.mean(each) == pytest.approx(np.mean(counted), abs=0.02)


def test_a_layout_that_chance_may_have_accepted_is_told():
    """Of three degrees of freedom sigma0 is small by chance by a factor of eleven once
    in a thousand: a deviation from an eleventh of the limit on is told. Two are judged
    by what is expected."""
    factor = float(np.sqrt(3 / scipy.stats.chi2.ppf(0.001, 3)))
    assert 11 < factor < 12
    assert may_be_chance(1.01 * WEAK / factor, 3)
    assert not may_be_chance(0.99 * WEAK / factor, 3)
    assert not may_be_chance(0.9 * WEAK, 2) and not may_be_chance(WEAK / 2, 100)
