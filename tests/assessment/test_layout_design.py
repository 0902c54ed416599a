"""Designed layouts: standard zones, a bound of theory, an adjustment in NumPy, planted
errors, mock_pairs."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

import jaxro
from jaxro import IndependentElements
from jaxro.assessment import layout_design as design
from jaxro.geometry import mock_pairs
from jaxro.orientation import starts

SIDE, SIGMA, DELTA0 = 70.0, 0.01, 4.13
ZONES = np.array(list(mock_pairs.ZONES.values()))
LEVEL = IndependentElements(*(jnp.zeros(()),) * 5)
TILTED = IndependentElements(
    *(jnp.asarray(e) for e in (0.03, -0.05, 0.04, -0.02, 0.06))
)
CRITERIA = (
    design.Determinant(),
    design.Trace(),
    design.DetectableError(),
    design.HeightDeviation(),
)


def box(elements=LEVEL, terrain=0.0):
    """The area between the six standard zones, f = b = y."""
    return design.Overlap((0.0, SIDE), (-SIDE, SIDE), SIDE, SIDE, terrain, elements)


def hills(x, y):
    return 6.0 * jnp.sin(x / 25) * jnp.cos(y / 40)


def random_positions(seed, points=9):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(0, SIDE, points)), jnp.asarray(
        rng.uniform(-SIDE, SIDE, points)
    )


@lru_cache
def measure():
    """All four criteria of a layout on hills, photos tilted, and the gradients of their
    logarithms."""

    def logarithms(x, y):
        plan = design.plan_layout(box(TILTED, hills), (x, y), SIGMA)
        return jnp.stack([criterion.logarithm(plan, 16.0) for criterion in CRITERIA])

    return problems.jit(
        jax.vmap(
            lambda x, y: (
                logarithms(x, y),
                *jax.jacrev(logarithms, argnums=(0, 1))(x, y),
            )
        )
    )


@lru_cache
def level():
    """All four criteria of a layout in the plane, photos vertical."""

    def criteria(x, y):
        plan = design.plan_layout(box(), (x, y), SIGMA)
        return jnp.stack([criterion(plan) for criterion in CRITERIA])

    return problems.jit(criteria)


def found(criterion, points, overlap=None, **options):
    """The design, its points from below and from the left, in units of the base."""
    overlap = box() if overlap is None else overlap
    result = design.design(
        criterion, overlap, points, jax.random.key(0), sigma=SIGMA, **options
    )
    assert np.all(result.after <= result.before) and result.value == np.min(
        result.after
    )
    assert np.all((result.x >= 0) & (result.x <= SIDE) & (np.abs(result.y) <= SIDE))
    places = np.stack([result.x, result.y], axis=1) / SIDE
    return result, places[np.lexsort(np.round(places, 3).T)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "criterion",
    [CRITERIA[0], pytest.param(CRITERIA[1], marks=pytest.mark.slow)],
    ids=lambda c: type(c).__name__,
)
def test_six_points_go_to_the_standard_zones(criterion):
    result, places = found(criterion, 6)
    assert np.sum(result.converged) >= 7
    np.testing.assert_allclose(places, ZONES[np.lexsort(ZONES.T)], atol=1e-5)


@pytest.mark.slow
def test_two_more_points():
    """With the six kept the best two more lie in two outer zones, and the ellipsoid
    shrinks by an eighth."""
    six = float(level()(*(SIDE * jnp.asarray(ZONES.T)))[0])
    result, _ = found(CRITERIA[0], 2, kept=tuple(SIDE * ZONES.T))
    new = np.stack([result.x[:2], result.y[:2]], axis=1) / SIDE
    np.testing.assert_allclose(
        np.abs(new - 0.5 * np.array([[1, 0]])), [[0.5, 1]] * 2, atol=1e-5
    )
    np.testing.assert_allclose(
        [six, float(result.value)], [1.3718e-4, 1.2047e-4], rtol=1e-4
    )


@pytest.mark.slow
def test_reliability_wants_no_standard_zones():
    """Redundancy numbers add up to n - 5, so that in vertical photos the largest
    minimal detectable error is at least delta0 sigma sqrt(2n/(n - 5)). The design
    reaches that bound; the standard zones, with r = 1/12, are 41 % above."""
    bound = DELTA0 * SIGMA * np.sqrt(2 * 6)
    result, _ = found(CRITERIA[2], 6)
    np.testing.assert_allclose(result.value, bound, rtol=1e-4)
    zones = float(level()(*(SIDE * jnp.asarray(ZONES.T)))[2])
    np.testing.assert_allclose(zones, np.sqrt(2) * bound, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "criterion",
    CRITERIA[2:4],
    ids=lambda c: type(c).__name__,
)
def test_never_worse_than_the_start(criterion):
    """On hills, photos tilted, from a layout that somebody gives: the standard
    eight."""
    layout = mock_pairs.standard_layout(8)
    given = tuple(SIDE * np.array(a) for a in (layout.x, layout.y))
    overlap = box(TILTED, hills)
    result, _ = found(criterion, 8, overlap, start=given, starts=2)
    assert result.before.shape == (3,)
    there = design.plan_layout(overlap, tuple(jnp.asarray(a) for a in given), SIGMA)
    np.testing.assert_allclose(result.before[0], criterion(there), rtol=1e-12)
    assert result.value < 0.95 * result.before[0]


@pytest.mark.parametrize(
    ("criterion", "points", "kept"),
    [(design.Determinant(), 4, 0), (design.DetectableError(), 3, 2)],
)
def test_too_few_points_are_no_layout(criterion, points, kept):
    there = (np.zeros(kept), np.zeros(kept)) if kept else None
    with pytest.raises(ValueError, match="are the fewest"):
        design.design(criterion, box(), points, jax.random.key(0), kept=there)
    with pytest.raises(ValueError, match=r"y = \(10, 10\)"):
        design.design(
            criterion,
            design.Overlap((0, 70), (10, 10), SIDE, SIDE),
            8,
            jax.random.key(0),
        )


@pytest.mark.slow
def test_accuracy_is_that_of_the_textbook():
    (x, y), lanes = random_positions(1), (37, 9)
    pair = design.photograph(box(TILTED, hills), (x, y), SIGMA)
    found = oracles.gauss_helmert(
        problems.arrays(pair),
        SIDE,
        oracles.independent,
        np.array(TILTED.values()),
        sigma=SIGMA,
    ).cofactor
    expected = [np.linalg.det(found) ** 0.1, np.sqrt(np.trace(found) / 5)]
    np.testing.assert_allclose(
        np.exp(
            measure()(jnp.broadcast_to(x, lanes), jnp.broadcast_to(y, lanes))[0][0, :2]
        ),
        expected,
        rtol=1e-8,
    )


def test_gradients_are_finite_differences():
    step, places = 1e-3, random_positions(2)
    steps = step * np.concatenate([np.eye(18), -np.eye(18)])
    flat = [
        np.concatenate(places)[None] + h * np.concatenate([np.zeros((1, 18)), steps])
        for h in (1, 2)
    ]
    measured = [
        measure()(*(jnp.asarray(a) for a in np.split(part, 2, axis=1))) for part in flat
    ]
    (values, by_x, by_y), (twice, *_) = (
        jax.tree.map(np.asarray, part) for part in measured
    )
    one, two = values[1:], twice[1:]
    numeric = (8 * (one[:18] - one[18:]) - (two[:18] - two[18:])) / (12 * step)
    exact = np.concatenate([by_x[0], by_y[0]], axis=1).T
    np.testing.assert_allclose(
        exact, numeric, rtol=1e-6, atol=1e-6 * np.max(np.abs(exact))
    )


def test_symmetries():
    """Another order; the layout mirrored in the flight line, and, for vertical photos,
    in the middle of the base."""
    x, y = random_positions(3)
    order = np.random.default_rng(0).permutation(9)
    here = level()(x, y)
    np.testing.assert_allclose(level()(x[order], y[order]), here, rtol=1e-10)
    np.testing.assert_allclose(level()(x, -y), here, rtol=1e-10)
    # not the heights: they are level with the left photo
    np.testing.assert_allclose(level()(SIDE - x, y)[:3], here[:3], rtol=1e-10)


@pytest.mark.slow
def test_an_error_of_the_detectable_size_moves_its_test_by_delta0():
    """Re-adjusted with the error planted in one y coordinate of a flawless pair: |w| =
    delta0, to first order."""
    plan = design.plan_layout(box(TILTED, hills), random_positions(4), SIGMA)
    errors = jnp.stack(design.detectable_errors(plan))

    @problems.jit
    @jax.vmap
    def tested(size, point):
        bad = mock_pairs.plant(
            plan.pair, y_right=jnp.where(jnp.arange(9) == point, size, 0.0)
        )
        solved = jaxro.orient(bad, start=starts.Vertical())
        return jnp.abs(solved.residuals[point]) / jnp.sqrt(solved.redundancy[point])

    np.testing.assert_allclose(tested(errors[3], jnp.arange(9)), DELTA0, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trials", "within"),
    [(4000, 0.045), (20_000, 0.02)],
)
def test_heights_deviate_as_simulated(trials, within):
    """Standard deviations of model heights, to four standard errors."""
    plan = design.plan_layout(box(TILTED, hills), random_positions(5), SIGMA)
    told = design.height_deviations(plan, plan.pair, SIDE)
    keys = jax.random.split(jax.random.key(1), trials)
    pairs = jax.jit(jax.vmap(lambda key: mock_pairs.noisy(plan.pair, key, SIGMA)))(keys)
    heights = jaxro.orient_batch(
        pairs,
        select=lambda o: o.model[2],
        elements=IndependentElements,
        base=SIDE,
        start=starts.Vertical(),
    )
    np.testing.assert_allclose(told, np.std(heights, axis=0), rtol=within)
