"""Absolute orientation of one model: any position, two of them, control that is not
enough, laws and coverage."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxro.block import absolute
from jaxro.block.absolute_model import model
from jaxro.block.absolute_verdict import DATUM, RESULTS

# -------------------------------------------------------------------------------------
# any position, and two of them

FULL, PLAN, HEIGHT = [1, 1, 1], [1, 1, 0], [0, 0, 1]
MIXTURES = {
    "full": [FULL] * 3,
    "plan and height": [PLAN, PLAN, PLAN, HEIGHT, HEIGHT, HEIGHT],
    "two full, two heights": [FULL, FULL, HEIGHT, HEIGHT],
    "one full, plan, heights": [FULL, PLAN, HEIGHT, HEIGHT, HEIGHT],
}
MINIMAL = {
    "two full, one height": [FULL, FULL, HEIGHT],
    "two plan, three heights": [PLAN, PLAN, HEIGHT, HEIGHT, HEIGHT],
}
ROOM = 8


def turns(rng, number):
    """Random rotations from model to ground."""
    from scipy.spatial.transform import Rotation

    return Rotation.random(number, random_state=rng).as_matrix()


def with_control(mixture, points, ground):
    """A measured model of `ROOM` points, the first of which have this control."""
    known = np.zeros((ROOM, 3), bool)
    known[: len(mixture)] = mixture
    return model(points, np.where(known, ground, np.nan))


@pytest.mark.parametrize("count", [3, pytest.param(25, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mixture", [*MIXTURES, *MINIMAL])
def test_any_position_is_found(mixture, count):
    """Every one of many random rotations. Minimal control has two solutions, one of
    which is the truth; the first of both has the z axis of the model further up."""
    rng = np.random.default_rng(1)
    for turn in turns(rng, count):
        points = rng.uniform(-1, 1, (ROOM, 3)) * [1, 1, 0.4] + rng.normal(0, 3, 3)
        ground = rng.uniform(1, 500) * points @ turn.T + rng.normal(0, 1e4, 3)
        control = (MIXTURES | MINIMAL)[mixture]
        measured = with_control(control, points, ground)
        found = absolute.solutions(measured)
        errors = [np.max(np.abs(one.points - ground)) for one in found]
        assert min(errors) < 1e-5
        if mixture in MIXTURES:
            assert found[0].result == RESULTS.successful and errors[0] < 1e-5
            continue
        first, second = found
        assert first.result == RESULTS.two_solutions and max(errors) > 1e-3
        assert float(first.rotation[2, 2]) >= float(second.rotation[2, 2])
        for one in found:
            residuals = np.where(measured.known, one.residuals, 0.0)
            assert np.max(np.abs(residuals)) < 1e-6


# -------------------------------------------------------------------------------------
# control that is not enough

BY_COUNT = [  # control, what is missing
    ([], "scale turn tilt height shift"),
    ([FULL], "scale turn tilt"),
    ([FULL, HEIGHT, HEIGHT], "scale turn"),
    ([FULL] + [HEIGHT] * 5, "turn"),
    ([FULL, FULL], "tilt"),
    ([PLAN, PLAN, HEIGHT, HEIGHT], "tilt"),
    ([PLAN] * 5, "height"),
    ([PLAN, PLAN], "tilt height"),
    ([HEIGHT] * 3, "scale turn shift"),
    ([HEIGHT] * 7, "turn shift"),
]


def aerial(rng, noise=0.0, line=None):
    """A nearly upright model and its ground in m."""
    points = rng.uniform(-1, 1, (ROOM, 3)) * [1, 1, 0.3] + [3.0, 1.0, -4.0]
    if line is not None:
        along = np.outer(np.linspace(-1, 1, ROOM), line)
        points = np.array([3.0, 1.0, -4.0]) + along
    ground = 200 * points @ oracles.wolf(0.05, -0.03, 1.0) + [5e5, 4e5, 300.0]
    return points, ground + rng.normal(0, 1, ground.shape) * noise


@pytest.mark.parametrize(("control", "said"), BY_COUNT)
def test_too_little_control_says_which_datum_is_missing(control, said):
    control = np.array(control, bool).reshape(-1, 3)
    measured = with_control(control, *aerial(np.random.default_rng(5), 0.1))
    found = absolute.orient_model(measured)
    assert found.result == RESULTS.too_few_coordinates and not found.usable
    left = zip(DATUM, found.missing.tolist(), strict=True)
    assert " ".join(name for name, open_ in left if open_) == said
    with pytest.raises(RuntimeError, match=f"Missing: {said.split()[0]}"):
        found.check()


def test_control_that_is_not_suitable_is_named():
    """A line, exact or with errors; a mirror image; no errors at all; one place; large
    errors. Three points that are known in full are enough."""
    rng = np.random.default_rng(6)
    for line in ([1, 0.5, 0.2], [0, 0, 1.0]):
        for noise in (0.0, 0.1):
            points, ground = aerial(rng, noise, line)
            found = absolute.orient_model(with_control([FULL] * 5, points, ground))
            assert found.result == RESULTS.control_on_line

    points, ground = aerial(rng, 0.1)
    north = ground[:, [1, 0, 2]]
    found = absolute.orient_model(with_control([FULL] * 5, points, north))
    assert found.result == RESULTS.mirrored
    exact = model(points, ground, ground_sigma=0.0)
    assert absolute.orient_model(exact).result == RESULTS.free_of_error
    same = model(0 * points, ground)
    assert absolute.orient_model(same).result == RESULTS.undetermined
    noisy = ground + rng.normal(0, 40, ground.shape)
    found = absolute.orient_model(with_control([FULL] * 4, points, noisy))
    assert found.result == RESULTS.weakly_determined
    found = absolute.orient_model(with_control([FULL] * 3, points, ground))
    assert found.result == RESULTS.successful and int(found.degrees_of_freedom) == 2


def test_points_that_are_not_finite_have_no_control():
    rng = np.random.default_rng(7)
    points, ground = aerial(rng, 0.1)
    wrong = points.copy()
    wrong[2, 1] = np.inf
    found = absolute.orient_model(model(wrong, ground)).check()
    others = np.arange(ROOM) != 2
    expected = absolute.orient_model(model(points[others], ground[others]))
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-9)
    assert int(found.degrees_of_freedom) == 3 * ROOM - 10


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"ground": np.zeros((3, 3))}, "of the same points"),
        ({"sigma": 1.0, "covariance": np.zeros((12, 12))}, "one of sigma, covariance"),
        ({"covariance": np.zeros((6, 6))}, "has the shape"),
        ({"covariance": np.zeros((4, 3, 3))}, "positive definite"),
        ({"covariance": np.kron(2 - np.eye(4), np.eye(3))}, "not positive"),
    ],
)
def test_what_does_not_go_together_is_refused(arguments, said):
    given = {"points": np.zeros((4, 3)), "ground": np.zeros((4, 3))} | arguments
    with pytest.raises(ValueError, match=said):
        model(**given)


# -------------------------------------------------------------------------------------
# laws


def test_turning_the_ground_turns_the_result():
    """Another ground system (turned, shifted, in another unit) has the same model on
    it."""
    rng = np.random.default_rng(9)
    points, ground = aerial(rng, 0.3)
    given = np.where(np.arange(ROOM)[:, None] < 5, ground, np.nan)
    (turn,) = turns(rng, 1)
    here = absolute.orient_model(model(points, given))
    there = absolute.orient_model(model(points, 2.5 * given @ turn.T - 1e4))
    np.testing.assert_allclose(
        2.5 * here.points @ turn.T - 1e4, there.points, atol=1e-6
    )
    np.testing.assert_allclose(turn @ here.rotation, there.rotation, atol=1e-9)
    np.testing.assert_allclose(2.5 * here.sigma0, there.sigma0, rtol=1e-6)
    np.testing.assert_allclose(
        2.5**2 * turn @ here.point_cofactors / 2.5**2 @ turn.T,
        there.point_cofactors,
        atol=1e-9,
    )


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    """The place of a new point by a control coordinate and by a model coordinate."""
    points, ground = aerial(np.random.default_rng(10), 0.3)
    known = np.arange(ROOM)[:, None] < 4

    def height(error):
        moved = jnp.asarray(points).at[1, 0].add(error[1])
        given = jnp.where(known, jnp.asarray(ground).at[0, 2].add(error[0]), jnp.nan)
        return absolute.orient_model(model(moved, given)).points[6, 2]

    by_errors = jax.grad(height)(jnp.zeros(2))
    steps = 1e-3 * np.eye(2)
    expected = [(height(step) - height(-step)) / 2e-3 for step in steps]
    np.testing.assert_allclose(by_errors, expected, rtol=1e-4)


@pytest.mark.slow
def test_many_models_at_once_are_those_one_by_one():
    rng = np.random.default_rng(12)
    some = [with_control(MIXTURES["full"], *aerial(rng, 0.3)) for _ in range(2)]
    some.append(with_control(MINIMAL["two full, one height"], *aerial(rng)))
    together = jax.tree.map(lambda *a: jnp.stack(a), *some)
    found = jax.vmap(absolute.orient_model)(together)
    for k, measured in enumerate(some):
        one = absolute.orient_model(measured)
        np.testing.assert_allclose(found.points[k], one.points, atol=1e-6)
        np.testing.assert_allclose(found.sigma0[k], one.sigma0, rtol=1e-6)
        of_one = jax.tree.map(lambda a, k=k: a[k], found)
        assert of_one.result == one.result


@pytest.mark.slow
def test_intervals_cover():
    """95 % intervals of elements, new points and control, a posteriori, over 400
    simulated models with errors of their own and in common."""
    rng = np.random.default_rng(11)
    points, truth = aerial(rng)
    elements = absolute.orient_model(model(points, truth)).values
    root = rng.normal(size=(3 * ROOM, 3 * ROOM)) * 1e-4
    covariance = root @ root.T + 4e-8 * np.eye(3 * ROOM)
    factor = np.linalg.cholesky(covariance)
    known = np.zeros((ROOM, 3), bool)
    known[:6] = [FULL, PLAN, HEIGHT, HEIGHT, FULL, FULL]
    inside = []
    for _ in range(400):
        noisy = points + (factor @ rng.normal(size=3 * ROOM)).reshape(ROOM, 3)
        ground = np.where(known, truth + rng.normal(0, 0.2, truth.shape), np.nan)
        measured = model(noisy, ground, ground_sigma=0.2, covariance=covariance)
        found = absolute.orient_model(measured).check()
        width = float(found.interval())
        off = np.abs(found.values - elements) < width * found.deviations()
        on = np.abs(found.points - truth) < width * found.point_deviations()
        inside.append(np.concatenate([off, on.ravel()]))
    covered = np.mean(inside, axis=0)
    # 2.6 standard deviations of one share, .028
    assert np.all(np.abs(covered - 0.95) < 0.035)
    assert abs(np.mean(covered) - 0.95) < 0.01
