"""The standard deviation of the noise from residuals among which many belong to wrong
points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.rejection import noise_of, pooled

SIGMA = 0.005


def residuals(
    points: int, wrong: int, near: bool, pairs: int, seed: int = 0
) -> np.ndarray:
    """(pair, point) residuals at the least-squares solution of the right points of a
    random problem of five parameters.

    Wrong points are 5 to 100 sigma off in a random direction of the photo, of which a
    residual is one component, or anywhere on a photo of 160 mm.
    """
    rng = np.random.default_rng(seed)
    right = points - wrong
    design = rng.normal(size=(pairs, right, 5))
    q, _ = np.linalg.qr(design)
    errors = SIGMA * rng.normal(size=(pairs, right, 1))
    at_right = (errors - q @ (q.transpose(0, 2, 1) @ errors))[..., 0]
    shape = pairs, wrong
    off = SIGMA * rng.uniform(5, 100, shape) * np.cos(rng.uniform(0, 2 * np.pi, shape))
    at_wrong = off if near else rng.uniform(-80, 80, shape)
    return np.concatenate([at_right, at_wrong], axis=1)


every = jax.jit(jax.vmap(noise_of))
"""The noise of every pair, of squares and of which points are used."""


def estimated(r: np.ndarray):
    """The noise of every pair."""
    return every(jnp.asarray(r**2), jnp.ones(r.shape, bool))


@pytest.mark.parametrize("points", [16, 50, 200])
def test_the_median_is_the_truth(points):
    """Nothing wrong to half of the points wrong; the deviation tells the scatter, but
    for few points, whose estimate is sometimes an accident."""
    for wrong in (0, points // 4, points // 2):
        for near in (True, False):
            found = estimated(residuals(points, wrong, near, 600))
            ratio = np.asarray(found.sigma) / SIGMA
            assert 0.9 < np.median(ratio) < 1.1, (wrong, near)
            assert abs(np.median(found.share) - 1 + wrong / points) < 0.05
            if points > 16:
                told = np.median(np.asarray(found.deviation) / np.asarray(found.sigma))
                assert (
                    0.8
                    < np.std(np.log(ratio[(ratio > 0.3) & (ratio < 3)])) / told
                    < 1.35
                ), (wrong, near)


def test_ten_right_points_of_two_hundred():
    """Wrong points anywhere on the photo do not hide the scale of ten right ones."""
    ratio = np.asarray(estimated(residuals(200, 190, False, 600)).sigma) / SIGMA
    assert 0.9 < np.median(ratio) < 1.1
    assert np.mean((ratio > 0.4) & (ratio < 2)) > 0.85


def test_the_unit_does_not_matter_and_padding_is_not_seen():
    """sigma follows the unit; masked points change nothing; the order of the points
    neither."""
    r = residuals(50, 20, True, 1)[0]
    mixed = np.random.default_rng(1).permutation(60)
    padded = np.append(r, np.full(10, 1e3))
    rows = np.stack([padded, padded / 1000, padded[mixed], np.append(r, np.zeros(10))])
    used = np.stack([np.arange(60) < 50] * 4)
    used[2] = mixed < 50
    given, metres, among, with_zeros = split(every(rows**2, used))
    found = split(every(r[None] ** 2, np.ones((1, 50), bool)))[0]
    for same in (given, among, with_zeros):
        np.testing.assert_allclose(same.sigma, found.sigma, rtol=1e-9)
    np.testing.assert_allclose(metres.sigma * 1000, found.sigma, rtol=1e-9)
    np.testing.assert_allclose(
        metres.deviation / metres.sigma, found.deviation / found.sigma, rtol=1e-9
    )


def split(batch) -> list:
    """The single results of a batch."""
    return [jax.tree.map(lambda a, i=i: a[i], batch) for i in range(len(batch.sigma))]


def test_nothing_is_known_without_redundancy():
    """Five points, no points, and errorless points: no number that looks like an
    answer."""
    squares, used = np.zeros((3, 8)), np.zeros((3, 8), bool)
    squares[0, :5], used[0, :5], used[2] = (1e-4, 2e-4, 1e-5, 3e-4, 1e-4), True, True
    for found in split(every(squares, used)):
        assert found.sigma == 0 and not found.known and np.isinf(found.deviation)


def test_pooled_is_the_truth_in_spite_of_bad_pairs():
    """A table of 40 pairs with 3 wrong poses, whose residuals are thirty times as
    large: the pooled estimate is that without them, and its deviation that of repeated
    tables."""
    tables, pairs = 100, 40
    r = residuals(50, 15, False, tables * pairs)
    squares = np.reshape(r**2, (tables, pairs, 50))
    squares[:, :3] *= 900.0
    together = jax.jit(jax.vmap(lambda s, use: pooled(jax.vmap(noise_of)(s, use))))(
        squares, np.ones(squares.shape, bool)
    )
    ratio = np.asarray(together.sigma) / SIGMA
    assert 0.98 < np.median(ratio) < 1.02
    assert (
        0.75 < np.std(ratio) / np.median(np.asarray(together.deviation) / SIGMA) < 1.3
    )
