"""What the errors of the points themselves add to the normal equations is taken off:
against finite differences in NumPy."""

import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxro
from jaxro.geometry.linear import linearise
from jaxro.orientation import degeneracy

FOCAL, SIGMA = 2000.0, 0.4


def facade(base, relief=0.05, points=200, seed=0):
    """Photos of a facade 20 m away, the second one moved by `base` (m)."""
    rng = np.random.default_rng(seed)
    left = rng.uniform(-1, 1, (points, 2)) * (1000, 750)
    depth = 20 * (1 + relief * rng.uniform(-1, 1, points))
    space = np.column_stack([left / FOCAL, -np.ones(points)]) * depth[:, None]
    seen = space - np.array(base)
    right = -FOCAL * seen[:, :2] / seen[:, 2:]
    noise = rng.normal(0, SIGMA, (2, points, 2))
    return jaxro.pair(
        *(left + noise[0]).T, *(right + noise[1]).T, focal=FOCAL, sigma=SIGMA
    )


def by_differences(pair, pose, cofactor, sigma0):
    """The cofactors with what the errors feign taken off, and the margin over sigma0."""
    values, vectors = np.linalg.eigh(cofactor)
    e, variance = vectors[:, -1], values[-1]

    def conditions(t, moved):
        """g of every point, where `t` e is added to the elements."""
        step = tuple(jnp.asarray(t * c) for c in e)
        rotation, base = problems.rotation_base(pose.move(step).normalise())
        x, y, z = base
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
        x_left, y_left, x_right, y_right = moved
        one = np.stack([x_left, y_left, np.full_like(x_left, -FOCAL)])
        other = np.stack([x_right, y_right, np.full_like(x_left, -FOCAL)])
        return np.sum(one * (essential @ other), axis=0)

    measured = np.stack([np.asarray(c) for c in pair.coordinates])
    along = lambda moved: (conditions(1e-5, moved) - conditions(-1e-5, moved)) / 2e-5
    units = 0.5 * np.eye(4)[:, :, None]

    def squared_gradient(function):
        """Both conditions are linear in every coordinate."""
        by_coordinate = [function(measured + u) - function(measured - u) for u in units]
        return np.sum(np.square(by_coordinate), axis=0)

    square = squared_gradient(lambda moved: conditions(0.0, moved))
    drift = squared_gradient(along)
    uncertain = 2**2 * variance * sigma0**2 * drift / square
    weight = 1 / (1 + uncertain**2) / (square * SIGMA**2)
    told = np.sum(weight * along(measured) ** 2)
    margin = np.sqrt(told / np.sum(weight * SIGMA**2 * drift)) / sigma0
    lost = np.clip(1 / margin**2 - 1 / 5**2, 0, 0.9)
    more = (1 / (1 - lost) ** 2 - 1) * variance
    return cofactor + more * np.outer(e, e), margin


@pytest.mark.slow
@pytest.mark.parametrize(
    ("base", "relief", "least", "most"),
    [
        ((0.27, 0.0, -1.0), 0.05, 1.3, 2.0),
        ((0.27, 0.0, -1.0), 0.1, 1.3, 2.0),
        ((3.0, 0.0, 0.0), 0.05, 5.0, 1e9),
    ],
)
def test_cofactors_without_what_errors_feign(base, relief, least, most):
    """From a margin of five errors on they are those of the inverse."""
    pair = facade(base, relief)
    found = jaxro.orient(pair)
    plain = np.linalg.inv(normal_matrix(pair, found.pose))
    wanted, margin = by_differences(pair, found.pose, plain, float(found.sigma0))
    assert least < margin < most
    worst = degeneracy.worst_direction(
        pair, found.pose, jnp.asarray(plain), found.sigma0
    )
    scale = np.sqrt(np.diag(wanted))
    # the worst direction is found by a few powers of the cofactors
    np.testing.assert_allclose(worst.margin / found.sigma0, margin, rtol=0.03)
    for cofactor in (worst.cofactor, found.cofactor):
        difference = (np.asarray(cofactor) - wanted) / np.outer(scale, scale)
        np.testing.assert_allclose(difference, 0, atol=0.02)
    grown = np.max(np.diag(wanted) / np.diag(plain))
    assert grown > 1.5 if margin < 2 else grown == 1


def normal_matrix(pair, pose):
    linear = linearise(pair, pose)
    a = np.stack(linear.columns, axis=1)
    return a.T @ (a * np.asarray(linear.weight)[:, None])
