"""The classical adjustment of independent models: a dense one in plain NumPy, errors
planted in every measurement, simulation; and what it loses."""

import numpy as np
import pytest

import jaxro
from jaxro import block
from jaxro.block import classical
from jaxro.block.adjust_chained import start_from
from jaxro.block.classical import adjust_models, deviations_of, placed
from jaxro.block.classical_comparison import (
    along_strips,
    as_text,
    compare_estimators,
)
from jaxro.block.classical_models import measure_models

STRIP_OF_TWO = block.Flight(models=2)


@pytest.fixture(scope="module")
def strip():
    """Two models with a third of the tie points left out, and their start."""
    mock = block.mock_block(3, STRIP_OF_TWO, control_every=1)
    point, control = mock.block.point, len(mock.ground.points)
    few = mock.block.without((point % 3 == 2) & (point >= control))
    mock = mock._replace(block=few)
    return mock, start_from(few, mock.photos)


@pytest.mark.slow
def test_it_is_that_of_a_dense_adjustment(strip):
    """Estimates, sigma0 and claimed deviations in plain NumPy. A model has an affine
    map of twelve numbers and five conditions that make it a similarity."""
    mock, start = strip
    models = measure_models(mock.block, *along_strips(STRIP_OF_TWO))
    sigma = np.array([0.04, 0.05, 0.1])
    found = adjust_models(models, start, mock.ground, sigma).check()
    used = np.flatnonzero(found.number >= 0)
    point = np.searchsorted(used, models.point)
    known = [mock.block.points.index(name) for name in mock.ground.points]
    known = np.searchsorted(used, known)
    ground = found.coordinates[used]

    def residuals(unknowns):
        points = unknowns[: ground.size].reshape(-1, 3)
        linear, shift = maps_of(unknowns)
        places = np.einsum("rij,rj->ri", linear[models.model], models.at)
        ties = (places + shift[models.model] - points[point]) / sigma
        control = (points[known] - mock.ground.coordinates) / mock.ground.sigma
        return np.concatenate([ties.ravel(), control.ravel()])

    def conditions(unknowns):
        linear, _ = maps_of(unknowns)
        squares = linear @ linear.transpose(0, 2, 1)
        mixed = [squares[:, 0, 1], squares[:, 0, 2], squares[:, 1, 2]]
        equal = [squares[:, k, k] - squares[:, 2, 2] for k in range(2)]
        return np.concatenate(mixed + equal)

    def maps_of(unknowns):
        maps = unknowns[ground.size :].reshape(2, 3, 4)
        return maps[:, :, :3], maps[:, :, 3]

    turns, lengths = placed(models, start)
    maps = lengths[:, None, None] * turns
    maps = np.concatenate([maps, start.centres[models.left][:, :, None]], axis=2)
    x = np.concatenate([ground.ravel(), maps.ravel()])

    def linearise(x):
        a, c = slopes(residuals, x), slopes(conditions, x)
        whole = np.block([[a.T @ a, c.T], [c, np.zeros((len(c), len(c)))]])
        return whole, np.concatenate([a.T @ residuals(x), conditions(x)])

    for _ in range(5):
        x = x - np.linalg.solve(*linearise(x))[: len(x)]
    whole, r = linearise(x)[0], residuals(x)
    np.testing.assert_allclose(ground.ravel(), x[: ground.size], atol=1e-6)
    freedom = len(r) + len(whole) - 2 * len(x)
    assert found.adjustment.degrees_of_freedom == freedom
    np.testing.assert_allclose(found.sigma0**2, r @ r / freedom, rtol=1e-6)
    q = np.diagonal(np.linalg.inv(whole))[: ground.size].reshape(-1, 3)
    claimed = found.sigma0 * np.sqrt(q)
    np.testing.assert_allclose(found.claimed[used], claimed, rtol=1e-5)


def slopes(function, x):
    """Derivatives by differences, exact for functions of the second degree."""
    steps = np.eye(len(x))
    return np.array([(function(x + e) - function(x - e)) / 2 for e in steps]).T


@pytest.mark.slow
def test_true_deviations_are_those_of_planted_errors(strip):
    """Each place and each known coordinate is changed by itself, and everything is
    computed anew, orientations included."""
    mock, start = strip
    measured, sides = mock.block, along_strips(STRIP_OF_TWO)

    def estimate(block, ground):
        models = measure_models(block, *sides)
        return adjust_models(models, start, ground, np.array([0.05, 0.05, 0.1]))

    found = estimate(measured, mock.ground)
    variances = np.zeros_like(found.coordinates)
    for name in ("x", "y"):
        for ray in range(len(measured.photo)):
            moved = measured._replace(x=measured.x.copy(), y=measured.y.copy())
            getattr(moved, name)[ray] += 1e-4
            changed = estimate(moved, mock.ground)
            slope = (changed.coordinates - found.coordinates) / 1e-4
            variances += (slope * measured.sigma[ray]) ** 2
    for at in np.ndindex(mock.ground.coordinates.shape):
        moved = mock.ground.coordinates.copy()
        moved[at] += 1e-3
        changed = estimate(measured, mock.ground._replace(coordinates=moved))
        slope = (changed.coordinates - found.coordinates) / 1e-3
        variances += (slope * mock.ground.sigma[at]) ** 2
    np.testing.assert_allclose(found.true, np.sqrt(variances), rtol=1e-3)


@pytest.mark.slow
def test_what_it_loses_in_a_strip_of_ten():
    """True deviations over those of the rigorous adjustment, claimed over true ones."""
    flight = block.Flight()
    mock = block.mock_block(1, flight)
    start = start_from(mock.block, mock.photos)
    rows = compare_estimators(mock.block, start, mock.ground, *along_strips(flight))
    rigorous, equal, separate, *points_only = rows
    for row in (equal, separate):
        assert row.plan > 1.1 * rigorous.plan and row.height > 1.05 * rigorous.height
    # without projection centres models hang on hinges
    for row in points_only:
        assert row.height > 2.5 * rigorous.height
    # no kind of weights knows its own deviations
    for row in rows[1:]:
        assert row.claimed[0] < 0.75 and row.claimed[2] > 1.5
    # variances of the models taken at their word; the own sigma0 of the adjustment,
    # which is less than half, hides it in the median
    diagonal = points_only[-1]
    assert diagonal.prior > 1.5 and 0.9 < diagonal.claimed[1] < 1.1
    assert len(as_text(rows).splitlines()) == 1 + len(rows)


@pytest.mark.slow
def test_deviations_within_a_model_are_those_of_its_pair(strip):
    """`model_of_pair` has them from cofactors, without the second order of the
    residuals."""
    mock, start = strip
    measured = mock.block
    models = measure_models(measured, ["1-1"], ["1-2"])
    points = models.without_centres()
    rays = [
        [
            np.flatnonzero((measured.photo == k) & (measured.point == p))[0]
            for k in (0, 1)
        ]
        for p in points.point
    ]
    one, other = np.array(rays).T
    x, y = measured.x, measured.y
    pair = jaxro.pair(x[one], y[one], x[other], y[other], focal=153.0, sigma=0.005)
    nothing = np.full((len(one), 3), np.nan)
    made = block.model_of_pair(pair, jaxro.orient(pair), nothing)
    root = np.concatenate([np.asarray(made.own), np.asarray(made.common)], axis=2)
    turns, lengths = placed(models, start)
    of_ground = lengths[0] * np.einsum("ij,rjk->rik", turns[0], root)
    np.testing.assert_allclose(points.at, made.points, atol=1e-9)
    own = np.sqrt(np.sum(of_ground**2, axis=2))
    np.testing.assert_allclose(deviations_of(points, start), own, rtol=1e-3)
    # the left centre is held, and the length of the base
    left, right = deviations_of(models, start)[-2:]
    assert np.all(left == 0) and np.all(right > 0)


def test_what_is_missing_is_said(strip):
    """A photo, an orientation."""
    mock, _ = strip
    with pytest.raises(ValueError, match="the block has no photo '9-9'"):
        measure_models(mock.block, ["1-1"], ["9-9"])
    few = mock.block.without(mock.block.point > 3)
    with pytest.raises(ValueError, match="'1-1' and '1-2' have no usable orientation"):
        measure_models(few, ["1-1"], ["1-2"])


@pytest.mark.slow
def test_missing_control_is_said(strip, monkeypatch):
    """And room for true deviations."""
    mock, start = strip
    models = measure_models(mock.block, *along_strips(STRIP_OF_TWO))
    two = mock.ground._replace(coordinates=mock.ground.coordinates.copy())
    two.coordinates[2:] = np.nan
    with pytest.raises(ValueError, match="6 known coordinates are in models, 7 are"):
        adjust_models(models, start, two, 0.05)
    monkeypatch.setattr(classical, "MOST", 10)
    with pytest.raises(ValueError, match="computed for at most 10"):
        _ = adjust_models(models, start, mock.ground, 0.05).true


@pytest.mark.slow
def test_true_deviations_are_those_of_simulated_strips():
    """One strip measured 200 times: mean squares of errors over their expectation."""
    flight = block.Flight(models=4, sigma=1e-9)
    exact = block.mock_block(7, flight, control_sigma=1e-9)
    start = start_from(exact.block, exact.photos)
    rays = len(exact.block.x)
    sides = along_strips(flight)
    rng = np.random.default_rng(7)
    truth = np.concatenate([exact.points, exact.photos.centres])

    def square(found, deviations):
        return np.nanmean(((found.coordinates - truth) / deviations) ** 2)

    ratios = {"equal": [], "variances": [], "at their word": []}
    for _ in range(200):
        measured = exact.block._replace(
            x=exact.block.x + rng.normal(0, 0.005, rays),
            y=exact.block.y + rng.normal(0, 0.005, rays),
            sigma=np.full(rays, 0.005),
        )
        at = exact.ground.coordinates
        at = at + rng.normal(0, 0.02, at.shape)
        ground = block.ground(exact.ground.points, at, 0.02)
        models = measure_models(measured, *sides)
        points = models.without_centres()
        equal = adjust_models(models, start, ground, 0.05)
        own = adjust_models(points, start, ground, deviations_of(points, start))
        ratios["equal"].append(square(equal, equal.true))
        ratios["variances"].append(square(own, own.true))
        ratios["at their word"].append(square(own, own.claimed / own.sigma0))
    means = {name: np.mean(values) for name, values in ratios.items()}
    assert 0.93 < means["equal"] < 1.07
    assert 0.93 < means["variances"] < 1.07
    assert means["at their word"] < 0.4
