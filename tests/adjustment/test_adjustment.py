"""The engine is general: networks, lines with errors in both coordinates, vector
conditions, any solver."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxro
from jaxro.adjustment import Term

adjust = eqx.filter_jit(jaxro.adjust)

# Levelling net of four unknown heights over one datum point (0): seven observed
# differences [m], lengths [km].
FROM = np.array([0, 1, 2, 3, 0, 4, 1])
TO = np.array([1, 2, 3, 0, 4, 2, 3])
RISE = np.array([1.245, 3.782, -2.161, -2.870, 4.101, 0.931, 1.617])
LENGTH = np.array([2.0, 1.5, 3.0, 2.5, 4.0, 1.0, 2.0])


def levelling(heights, observation):
    """h(to) - h(from) - measured = 0"""
    start, end, rise = observation
    every = jnp.concatenate([jnp.zeros(1), heights])
    return every[end] - every[start] - rise


@jax.jit
def net(rise):
    observations = (jnp.asarray(FROM), jnp.asarray(TO), rise)
    term = Term(levelling, observations, (None, None, jnp.asarray(LENGTH)))
    return jaxro.adjust(term, jnp.zeros(4))


def test_levelling_net_equals_normal_equations():
    a = np.zeros((7, 5))
    a[np.arange(7), TO] += 1
    a[np.arange(7), FROM] -= 1
    a, p = a[:, 1:], 1 / LENGTH
    n = a.T @ (p[:, None] * a)
    x = np.linalg.solve(n, a.T @ (p * RISE))
    v = a @ x - RISE
    q = np.linalg.inv(n)
    result = net(jnp.asarray(RISE))
    assert result.result == jaxro.adjustment.RESULTS.successful
    np.testing.assert_allclose(result.parameters, x, atol=1e-13)
    np.testing.assert_allclose(result.cofactor, q, atol=1e-13)
    np.testing.assert_allclose(result.normal_matrix, n, atol=1e-13)
    np.testing.assert_allclose(result.sigma0, np.sqrt(v @ (p * v) / 3), rtol=1e-12)
    np.testing.assert_allclose(result.residuals, v * np.sqrt(p), atol=1e-13)
    np.testing.assert_allclose(
        result.redundancy, 1 - np.diag(a @ q @ a.T) * p, atol=1e-13
    )
    assert int(result.degrees_of_freedom) == 3


def test_derivatives_of_a_linear_net_are_its_generalised_inverse():
    heights = lambda rise: net(rise).parameters
    both = jax.jit(lambda rise: (jax.jacfwd(heights)(rise), jax.jacrev(heights)(rise)))
    forward, reverse = both(jnp.asarray(RISE))
    at = lambda step: net(jnp.asarray(RISE + step)).parameters
    moved = np.stack([(at(d) - at(-d)) / 2e-3 for d in 1e-3 * np.eye(7)], axis=1)
    np.testing.assert_allclose(forward, moved, atol=1e-10)
    np.testing.assert_allclose(forward, reverse, atol=1e-13)


# Pearson's data with York's weights (York 1966, Can. J. Phys. 44, table II).
X = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
Y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
WX = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
WY = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500.0])


def line(parameters, observation):
    a, b = parameters
    x, y = observation
    return y - a - b * x


@pytest.mark.parametrize(
    "solver",
    [
        None,
        optx.GaussNewton(1e-11, 1e-11),
        optx.LevenbergMarquardt(1e-11, 1e-11),
        optx.Dogleg(1e-11, 1e-11),
    ],
    ids=["jaxro", "GaussNewton", "LevenbergMarquardt", "Dogleg"],
)
def test_line_with_errors_in_both_coordinates(solver):
    """York's exact solution: a = 5.47991022, b = -0.480533407, S = 11.8663532."""
    start = (jnp.asarray(5.0), jnp.asarray(-0.5))
    cofactor = (jnp.asarray(1 / WX), jnp.asarray(1 / WY))
    term = Term(line, (jnp.asarray(X), jnp.asarray(Y)), cofactor)
    result = adjust(term, start, solver=solver, max_steps=100)
    assert result.result == jaxro.adjustment.RESULTS.successful
    np.testing.assert_allclose(result.parameters, (5.47991022, -0.480533407), rtol=2e-9)
    np.testing.assert_allclose(result.sigma0**2 * 8, 11.8663532, rtol=1e-8)


def test_a_variance_may_stand_for_many_entries():
    """A cofactor that ends above the leaves of the observation equals the one written
    out, for numbers and arrays."""
    start = (jnp.asarray(5.0), jnp.asarray(-0.5))
    x, y, variance = jnp.asarray(X), jnp.asarray(Y), jnp.asarray(1 / WX)
    both = jnp.stack([x, y], axis=1)
    variances = jnp.stack([variance, variance], axis=1)
    terms = [
        Term(line, (x, y), (variance, variance)),
        Term(line, (x, y), variance),
        Term(line, both, variance),
        Term(line, both, variances),
    ]
    every = eqx.filter_jit(lambda terms: [jaxro.adjust(t, start) for t in terms])
    written, *others = every(terms)
    for other in others:
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12),
            other,
            written,
        )


def test_vector_conditions_are_whitened_together():
    """A similarity without scale between two point sets: both coordinates of both sets
    measured, correlated in g."""
    rng = np.random.default_rng(3)
    p = rng.normal(size=(9, 2)) * 5
    c, s = np.cos(0.3), np.sin(0.3)
    q = p @ np.array([[c, s], [-s, c]]) + [2.0, -1.0] + rng.normal(size=(9, 2)) * 0.01
    var_p, var_q = np.array([1.0, 4.0]) * 1e-4, np.array([9.0, 1.0]) * 1e-4

    def motion(parameters, observation):
        angle, tx, ty = parameters
        (px, py), (qx, qy) = observation
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([c * px - s * py + tx - qx, s * px + c * py + ty - qy])

    points = lambda a: tuple(jnp.asarray(column) for column in a.T)
    cofactor = (tuple(var_p.tolist()), tuple(var_q.tolist()))
    start = (jnp.asarray(0.0), jnp.asarray(0.0), jnp.asarray(0.0))
    result = adjust(Term(motion, (points(p), points(q)), cofactor), start)

    def objective(x):
        c, s = np.cos(x[0]), np.sin(x[0])
        turn = np.array([[c, -s], [s, c]])
        g = p @ turn.T + x[1:] - q
        w = turn @ np.diag(var_p) @ turn.T + np.diag(var_q)
        return np.sum(g * (g @ np.linalg.inv(w)))

    x = np.array(result.parameters)
    lowest = objective(x)
    np.testing.assert_allclose(
        np.sum(np.asarray(result.residuals) ** 2), lowest, rtol=1e-10
    )
    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4:
        assert objective(x + step) > lowest
    np.testing.assert_allclose(
        np.sum(np.asarray(result.redundancy)), 18 - 3, rtol=1e-10
    )


def test_more_parameters_than_are_unrolled():
    """Twenty heights of a chain with cross ties, through the dense routines."""
    rng = np.random.default_rng(4)
    start, end = np.array(
        [(i, j) for i in range(21) for j in range(i + 1, min(i + 4, 21))]
    ).T
    rise = rng.normal(size=start.size)
    a = np.zeros((start.size, 21))
    a[np.arange(start.size), end] += 1
    a[np.arange(start.size), start] -= 1
    observations = jnp.asarray(start), jnp.asarray(end), jnp.asarray(rise)
    term = Term(levelling, observations, (None, None, 1.0))
    result = adjust(term, jnp.zeros(20))
    np.testing.assert_allclose(
        result.parameters, np.linalg.lstsq(a[:, 1:], rise, rcond=None)[0], atol=1e-12
    )
    np.testing.assert_allclose(
        result.cofactor, np.linalg.inv(a[:, 1:].T @ a[:, 1:]), atol=1e-12
    )
    np.testing.assert_allclose(result.normal_matrix, a[:, 1:].T @ a[:, 1:], atol=1e-12)
    np.testing.assert_allclose(
        result.residuals, a[:, 1:] @ np.asarray(result.parameters) - rise, atol=1e-12
    )
    redundancy = 1 - np.sum(a[:, 1:] * (a[:, 1:] @ np.asarray(result.cofactor)), axis=1)
    np.testing.assert_allclose(result.redundancy, redundancy, atol=1e-12)


def test_undetermined_parameter_is_reported():
    legs = jnp.asarray([0, 1, 0]), jnp.asarray([1, 2, 2]), jnp.asarray([1.0, 1.0, 2.1])
    result = adjust(Term(levelling, legs, (None, None, 1.0)), jnp.zeros(3))
    assert result.result == jaxro.adjustment.RESULTS.rank_deficient
