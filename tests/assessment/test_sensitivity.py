"""Exact derivatives, propagation of variance, error budgets and the influence of
points, against finite differences of the non-linear adjustment, simulation, closed
forms and an adjustment in NumPy."""

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest
from mock_photos import block, photographed

import jaxro
from jaxro import (
    DependentElements,
    GaussNewton,
    IndependentElements,
    RelativePose,
    pad,
    pair,
    stack,
)
from jaxro.adjustment import propagation
from jaxro.assessment import budget, sensitivity
from jaxro.geometry import mock_pairs
from jaxro.orientation import starts

BASE, SIGMA, POINTS, PLACES = 70.0, 0.01, 16, 18
FIELDS = ("x_left", "y_left", "x_right", "y_right", "focal_left", "focal_right")
TIGHT = GaussNewton(rtol=1e-14, atol=1e-14, max_step=0.5)
OPTIONS = {
    "elements": IndependentElements,
    "base": jnp.asarray(BASE),
    "start": starts.Vertical(),
    "solver": TIGHT,
    "max_steps": 100,
}
CASES = ("3 sigma", "blunder of 100 sigma")


def everything(orientation):
    return {
        "elements": jnp.stack(orientation.elements.values()),
        "accuracy": jnp.stack([orientation.sigma0, orientation.m_q]),
        "model": jnp.stack(orientation.model),
    }


@lru_cache
def cases():
    """Residuals of three times the usual size; a point 100 sigma off; points that are
    all the same. Two places are empty, and hold NaN."""
    bad = mock_pairs.plant(
        problems.tilted(SIGMA),
        y_right=np.where(np.arange(POINTS) == 6, 100 * SIGMA, 0.0),
    )
    nothing = pair(*(np.zeros(POINTS),) * 4, focal=BASE)
    pairs = stack(
        [pad(one, PLACES) for one in (problems.tilted(3 * SIGMA), bad, nothing)]
    )
    return eqx.tree_at(
        lambda p: p.x_right, pairs, pairs.x_right.at[:, POINTS:].set(jnp.nan)
    )


@lru_cache
def exact():
    one = lambda pair: sensitivity.derivatives(pair, everything, **OPTIONS)
    return jax.tree.map(np.asarray, problems.jit(jax.vmap(one))(cases()))


def shifted(pair, direction, t):
    """The pair with every field of `direction` added t times."""
    moved = [getattr(pair, name) + t * direction[name] for name in FIELDS]
    return eqx.tree_at(lambda p: [getattr(p, name) for name in FIELDS], pair, moved)


def directions():
    """Random ones in the coordinates, both focal lengths, and a shift of either
    principal point."""
    rng, zero, one = np.random.default_rng(0), np.zeros(PLACES), np.ones(PLACES)
    rest = dict.fromkeys(FIELDS[:4], zero) | dict.fromkeys(FIELDS[4:], 0.0)
    found = [
        rest | {name: rng.normal(size=PLACES) for name in FIELDS[:4]} for _ in range(2)
    ]
    found += [rest | {"focal_left": 1.0}, rest | {"focal_right": 1.0}]
    return [*found, rest | {"x_left": -one}, rest | {"y_right": -one}]


def along(by, direction):
    """The exact derivatives, applied to a direction."""
    parts = [
        jax.tree.map(
            lambda d, s=direction[n]: np.tensordot(d, s, np.ndim(s)), getattr(by, n)
        )
        for n in FIELDS
    ]
    return jax.tree.map(lambda *d: sum(d), *parts)


@pytest.mark.slow
def test_derivatives_are_those_of_the_nonlinear_adjustment():
    """Central differences of the converged solution, extrapolated to step zero, to
    1e-6."""
    pairs, lines = cases(), directions()
    table = {
        name: jnp.stack([jnp.asarray(line[name]) for line in lines]) for name in FIELDS
    }
    steps = 2e-4 * np.array([-2.0, -1.0, 1.0, 2.0])
    lanes = jnp.meshgrid(
        *(jnp.arange(n) for n in (len(CASES), len(lines), len(steps))), indexing="ij"
    )

    @problems.jit
    @jax.vmap
    def solved(case, line, step):
        pair, direction = (
            jax.tree.map(lambda a: a[case], pairs),
            jax.tree.map(lambda a: a[line], table),
        )
        return everything(
            jaxro.orient(shifted(pair, direction, jnp.asarray(steps)[step]), **OPTIONS)
        )

    values = solved(*(lane.ravel() for lane in lanes))
    values = jax.tree.map(
        lambda a: np.asarray(a).reshape(*lanes[0].shape, *a.shape[1:]), values
    )
    slope = lambda v: (8 * (v[2] - v[1]) - (v[3] - v[0])) / (12 * steps[2])
    for case, name in enumerate(CASES):
        by = jax.tree.map(lambda a, case=case: a[case], exact())
        assert by.usable
        for k, line in enumerate(lines):
            for what, found in along(by, line).items():
                numeric = slope(values[what][case, k])
                atol = 1e-6 * np.max(np.abs(numeric))
                np.testing.assert_allclose(
                    found, numeric, rtol=1e-6, atol=atol, err_msg=f"{what}, {name}, {k}"
                )
        for (x, y), line in (
            (by.principal_left, lines[4]),
            (by.principal_right, lines[5]),
        ):
            found = x if np.any(line["x_left"]) else y
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9),
                found,
                along(by, line),
            )


@pytest.mark.slow
def test_forward_equals_reverse():
    """Of a random sum of results, which is one number, derivatives go backwards; of all
    results, forwards. (Those of the heights go backwards in the error budget.)"""
    rng = np.random.default_rng(4)
    weights = {
        name: rng.normal(size=exact().value[name].shape[1:])
        for name in ("elements", "accuracy")
    }
    added = lambda results: sum(
        (w * results[name]).sum() for name, w in weights.items()
    )
    one = lambda pair: sensitivity.derivatives(
        pair, lambda o: added(everything(o)), **OPTIONS
    )
    reverse = problems.jit(jax.vmap(one))(cases())
    for name in FIELDS:
        for case in range(2):
            forward = sum(
                np.tensordot(w, getattr(exact(), name)[what][case], 1)
                for what, w in weights.items()
            )
            found = getattr(reverse, name)[case]
            np.testing.assert_allclose(
                found,
                forward,
                rtol=1e-8,
                atol=1e-8 * np.max(np.abs(forward)),
                err_msg=name,
            )


@pytest.mark.slow
def test_masked_points_have_no_derivative():
    for name in FIELDS[:4]:
        for leaf in jax.tree.leaves(getattr(exact(), name)):
            assert np.all(leaf[..., POINTS:] == 0) and np.any(leaf[..., :POINTS])


@pytest.mark.slow
def test_unusable_orientations_have_no_derivative():
    assert exact().usable.tolist() == [True, True, False]
    assert not any(
        np.any(leaf[2])
        for name in FIELDS
        for leaf in jax.tree.leaves(getattr(exact(), name))
    )


@pytest.mark.slow
def test_steps_that_do_not_suffice_are_told():
    pair = photographed(block(), turn=(0.1, -0.1, 0.1), sigma=0.01)
    options = {"start": starts.Vertical(), "max_steps": 2}
    stopped = jaxro.orient(pair, **options)
    found = sensitivity.derivatives(pair, lambda o: o.sigma0, **options)
    assert not bool(stopped.usable) and not bool(found.usable)
    np.testing.assert_allclose(found.value, stopped.sigma0, rtol=1e-12)


@pytest.mark.slow
def test_second_order_term():
    """What the normal equations alone say, -Q Aᵀ P B, is off by far more than the
    tolerance above."""
    for case, least in enumerate((1e-3, 2e-2)):
        pair = jax.tree.map(lambda a, case=case: a[case], cases())
        l = problems.arrays(pair)
        x = exact().value["elements"][case]
        a = oracles.jacobian(
            lambda e, l=l: oracles.condition(oracles.independent, e, l, (BASE, BASE)), x
        )
        b = [
            oracles.condition(
                oracles.independent,
                x,
                l + 1j * oracles.STEP * np.eye(4)[i][:, None],
                (BASE, BASE),
            ).imag
            for i in range(4)
        ]
        b = np.array(b) / oracles.STEP
        w = 1 / np.sum(b * b, axis=0)
        linear = -np.linalg.solve((a.T * w) @ a, a.T * w)
        full = np.stack(
            [getattr(exact(), n)["elements"][case][:, :POINTS] for n in FIELDS[:4]]
        )
        wrong = np.max(np.abs(linear[None] * b[:, None, :] - full)) / np.max(
            np.abs(full)
        )
        assert least < wrong < 0.5


def test_elements_of_a_pose_are_its_local_parameters():
    """`displacement` is the inverse of `moved`, and its derivative is not zero."""
    rng = np.random.default_rng(1)
    pose = RelativePose(*jnp.asarray(rng.normal(size=7))).normalise()
    step = tuple(jnp.asarray(rng.normal(size=5) * 0.3))
    there = lambda step: sensitivity.displacement(pose, pose.move(step).normalise())
    np.testing.assert_allclose(there(step), np.array(step), atol=1e-14)
    named = IndependentElements(*jnp.asarray(rng.normal(size=5)))
    np.testing.assert_allclose(
        sensitivity.displacement(named, named.move(step)), np.array(step), atol=1e-14
    )


def test_what_has_no_deviation_is_not_called_exact():
    double, ones = lambda x: 2 * x, jnp.ones(2)
    root_of = propagation.propagate(
        jnp.sqrt, jnp.array([-1.0, 4.0]), 0.01 * ones
    ).deviations
    np.testing.assert_allclose(root_of, [np.nan, 0.025])
    np.testing.assert_array_equal(
        propagation.propagate(double, ones, jnp.array([-1.0, 1.0])).deviations,
        [np.nan, 2],
    )
    np.testing.assert_array_equal(
        propagation.propagate_each(double, ones, jnp.array([np.nan, 1.0])), [np.nan, 2]
    )
    pair = problems.tilted()
    for wrong in (-1.0, np.nan):
        with pytest.raises(
            ValueError, match="'focal length' are to be finite and not negative"
        ):
            budget.error_budget(pair, {"focal length": budget.FocalLength(wrong)})
    with pytest.raises(ValueError, match="give the sources"):
        budget.error_budget(pair, {})
    for level in ({"level": 2.0}, {"power": 1.0}):
        with pytest.raises(ValueError, match="between 0 and 1"):
            jaxro.assess(pair, problems.orient(pair), **level)


def test_propagation_equals_closed_forms():
    """Height from a parallax, h = B f / p, element by element; polar coordinates with a
    full covariance."""
    rng = np.random.default_rng(2)
    base, focal, parallax = rng.uniform(1, 2, (3, 1)), 100.0, rng.uniform(5, 20, (1, 4))
    s = 0.002, 0.01, rng.uniform(0.001, 0.01, (1, 4))
    found = propagation.propagate_each(
        lambda v: v[0] * v[1] / v[2], (base, focal, parallax), s
    )
    height = base * focal / parallax
    expected = height * np.sqrt(
        (s[0] / base) ** 2 + (s[1] / focal) ** 2 + (s[2] / parallax) ** 2
    )
    np.testing.assert_allclose(found, expected, rtol=1e-14)

    root = rng.normal(size=(2, 2))
    c, r, t = root @ root.T, 3.0, 0.7
    polar = lambda v: {"x": v["r"] * jnp.cos(v["t"]), "y": v["r"] * jnp.sin(v["t"])}
    j = np.array([[np.cos(t), -r * np.sin(t)], [np.sin(t), r * np.cos(t)]])
    values = {"r": jnp.asarray(r), "t": jnp.asarray(t)}
    full = propagation.propagate(polar, values, c)
    np.testing.assert_allclose(full.covariance, j @ c @ j.T, rtol=1e-13)
    np.testing.assert_allclose(
        full.deviations["y"], np.sqrt((j @ c @ j.T)[1, 1]), rtol=1e-13
    )
    diagonal = propagation.propagate(polar, values, np.diag(c)).covariance
    np.testing.assert_allclose(diagonal, j @ np.diag(np.diag(c)) @ j.T, rtol=1e-13)
    many = jax.vmap(lambda c: propagation.propagate(polar, values, c).deviations["x"])(
        jnp.stack([c, 4 * c])
    )
    np.testing.assert_allclose(many[1], 2 * many[0], rtol=1e-13)
    with pytest.raises(ValueError, match="2 values need a covariance"):
        propagation.propagate(polar, values, np.eye(3))
    with pytest.raises(
        ValueError, match=r"symmetric, but entry \(0, 1\) is 0.5 and \(1, 0\) is 0"
    ):
        propagation.propagate(polar, values, np.array([[1.0, 0.5], [0.0, 1.0]]))


SOURCES = {
    "left": budget.LeftCoordinates(SIGMA),
    "right": budget.RightCoordinates(SIGMA),
    "focal length": budget.FocalLength(0.02),
    "principal point": budget.PrincipalPoint(0.03),
    "base": budget.Base(0.05),
    "focal of the right photo": budget.Source(
        0.01, lambda given, e: given._replace(pair=refocused(given.pair, e))
    ),
}


def refocused(pair, error):
    return eqx.tree_at(lambda p: p.focal_right, pair, pair.focal_right + error)


@lru_cache
def spent():
    """The budget of the first case, with all sources and with each left out in turn, by
    one program."""

    def one(pair, used):
        scaled = {
            name: eqx.tree_at(lambda s: s.deviation, source, source.deviation * used[i])
            for i, (name, source) in enumerate(SOURCES.items())
        }
        return budget.error_budget(pair, scaled, **OPTIONS)

    used = jnp.concatenate([jnp.ones((1, len(SOURCES))), 1 - jnp.eye(len(SOURCES))])
    first = jax.tree.map(lambda a: a[0], cases())
    return jax.tree.map(np.asarray, problems.jit(jax.vmap(one, (None, 0)))(first, used))


@pytest.mark.slow
def test_error_budget_adds_up():
    full = jax.tree.map(lambda a: a[0], spent())
    real = np.arange(PLACES) < POINTS
    np.testing.assert_allclose(
        sum(full.shares.values()), np.where(real, 1.0, 0.0), atol=1e-14
    )
    for i, name in enumerate(SOURCES):
        left_over = full.deviations**2 * (1 - full.shares[name])
        np.testing.assert_allclose(
            spent().deviations[1 + i] ** 2,
            left_over,
            rtol=1e-10,
            atol=1e-16,
            err_msg=name,
        )
        assert np.all(spent().shares[name][1 + i] == 0) and np.all(
            full.shares[name][:POINTS] > 0
        )


@pytest.mark.slow
def test_error_budget_is_made_of_the_derivatives():
    """Σ (dh/dl)² s²; one error of both focal lengths counts once; the base scales the
    model."""
    full = jax.tree.map(lambda a: a[0], spent())
    z = lambda tree: tree["model"][0][2]
    by = exact()
    expected = {
        "left": sum(np.sum(z(getattr(by, n)) ** 2, axis=-1) for n in FIELDS[:2])
        * SIGMA**2,
        "focal length": (z(by.focal_left) + z(by.focal_right)) ** 2 * 0.02**2,
        "principal point": sum(
            (z(a) + z(b)) ** 2
            for a, b in zip(by.principal_left, by.principal_right, strict=True)
        )
        * 0.03**2,
        "base": (z(by.value) / BASE * 0.05) ** 2,
        "focal of the right photo": z(by.focal_right) ** 2 * 0.01**2,
    }
    for name, variance in expected.items():
        np.testing.assert_allclose(
            full.variances[name], variance, rtol=1e-8, atol=1e-16, err_msg=name
        )
    with pytest.raises(ValueError, match="give base="):
        budget.error_budget(
            problems.dewitt(), {"base": budget.Base(0.1)}, start=starts.Vertical()
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trials", "within"),
    [(4000, 0.045), (20_000, 0.02)],
)
def test_propagation_equals_simulation(trials, within):
    """Standard deviations of elements and heights of simulated pairs, to four standard
    errors."""
    flawless = problems.tilted(0.0)
    keys = jax.random.split(jax.random.key(3), trials)
    pairs = jax.jit(jax.vmap(lambda key: mock_pairs.noisy(flawless, key, SIGMA)))(keys)
    found = jaxro.orient_batch(
        pairs,
        select=lambda o: (jnp.stack(o.elements.values()), o.model[2]),
        **{name: OPTIONS[name] for name in ("elements", "base", "start")},
    )
    elements, heights = (np.std(a, axis=0) for a in found)
    at = jaxro.orient(flawless, **OPTIONS)
    told = propagation.propagate_adjusted(lambda e: jnp.stack(e.values()), at, SIGMA)
    np.testing.assert_allclose(told.deviations, elements, rtol=within)
    np.testing.assert_allclose(
        told.deviations, SIGMA * np.sqrt(np.diag(at.cofactor)), rtol=1e-12
    )
    # the second budget leaves only coordinates: of errorless coordinates, but for the
    # three sigma of the case
    coordinates = (
        spent().variances["left"][0][:POINTS] + spent().variances["right"][0][:POINTS]
    )
    np.testing.assert_allclose(np.sqrt(coordinates), heights, rtol=within)


@pytest.mark.slow
def test_influence_and_leave_one_out():
    """Dewitt's six points: the refits are exact solutions of five conditions. With five
    points none can be left out."""
    measured = pad(problems.dewitt(), 7)
    found = sensitivity.point_influence(
        measured, elements=DependentElements, start=starts.Vertical()
    )
    found = jax.tree.map(np.asarray, found)
    assert found.testable.tolist() == [True] * 6 + [False]
    placed = oracles.dependent(float(np.mean(problems.DEWITT[0] - problems.DEWITT[2])))
    judge = lambda rows: oracles.gauss_helmert(
        rows, problems.DEWITT_FOCAL, placed, (0.0,) * 5
    )
    whole = judge(problems.DEWITT)
    shifts = np.array(
        [
            judge(np.delete(problems.DEWITT, i, axis=1)).elements - whole.elements
            for i in range(6)
        ]
    )
    size = np.max(np.abs(shifts), axis=0)
    np.testing.assert_allclose(found.leave_one_out[:6] / size, shifts / size, atol=2e-5)
    # to first order all is linear here, where the residuals are 4 µm
    np.testing.assert_allclose(found.predicted[:6] / size, shifts / size, atol=2e-3)
    r = whole.redundancy[:, None]
    np.testing.assert_allclose(found.influence[:6] / size, r * shifts / size, atol=2e-3)
    assert not np.any(found.influence[6]) and not np.any(found.leave_one_out[6])

    five = measured.with_mask(jnp.arange(7) < 5)
    nothing = sensitivity.point_influence(
        five, elements=DependentElements, start=starts.Vertical()
    )
    assert not any(np.any(field) for field in nothing)
