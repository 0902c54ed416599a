"""Thousands of errorless pairs in any position: the truth is found, or the failure is
reported."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

from jaxro import RESULTS, is_usable, orient_batch, pair, swapped
from jaxro.geometry import mock_pairs


def errors_of_poses(found, true):
    """Angle between the rotations and between the bases, (pair,), from quaternions and
    unit vectors."""
    q = [
        np.stack([np.asarray(getattr(p, c)) for c in ("qw", "qx", "qy", "qz")], axis=-1)
        for p in (found, true)
    ]
    b = [
        np.stack([np.asarray(getattr(p, c)) for c in ("bx", "by", "bz")], axis=-1)
        for p in (found, true)
    ]
    turn = np.minimum(
        np.linalg.norm(q[0] - q[1], axis=-1), np.linalg.norm(q[0] + q[1], axis=-1)
    )
    return 4 * np.arcsin(np.minimum(1.0, turn / 2)), 2 * np.arcsin(
        np.minimum(1.0, np.linalg.norm(b[0] - b[1], axis=-1) / 2)
    )


def check_random_pairs(count, seed):
    pairs, true = mock_pairs.random_pairs(jax.random.key(seed), count, 20)
    points = jax.random.randint(jax.random.key(seed + 1), (count,), 8, 21)
    pairs = pairs.with_mask(jnp.arange(20)[None] < points[:, None])
    found = orient_batch(pairs)
    turn, shift = errors_of_poses(found.pose, true)
    right = (turn < 1e-6) & (shift < 1e-6)
    reported = ~np.asarray(is_usable(found.result)) | np.asarray(
        found.result == RESULTS.two_solutions
    )
    wrong = np.flatnonzero(~right & ~reported)
    assert wrong.size == 0, f"pairs {wrong} are wrong and said to be right"
    assert np.mean(right) >= 0.999, f"truth found in {np.mean(right):.2%}"


def test_random_pairs_in_any_position():
    check_random_pairs(1000, seed=0)


@pytest.mark.slow
def test_ten_thousand_random_pairs():
    check_random_pairs(10_000, seed=7)


@pytest.fixture(scope="module")
def hundred():
    """Pairs with small errors, and their orientations."""
    pairs, _ = mock_pairs.random_pairs(jax.random.key(3), 100, 12)
    keys = jax.random.split(jax.random.key(4), 100)
    pairs = jax.vmap(mock_pairs.noisy, in_axes=(0, 0, None))(pairs, keys, 1e-3)
    return pairs, orient_batch(pairs)


def differences(found, expected):
    """Largest angle between found poses and expected (R, b), over the pairs both calls
    are sure of."""
    pairs = [
        jax.tree.map(lambda leaf, i=i: leaf[i], found.pose)
        for i in range(len(expected))
    ]
    return np.array(
        [
            max(problems.difference(pose, *e))
            for pose, e in zip(pairs, expected, strict=True)
        ]
    )


def poses(found):
    """(R, b) of every pair."""
    singles = [
        jax.tree.map(lambda leaf, i=i: leaf[i], found.pose)
        for i in range(found.sigma0.shape[0])
    ]
    return [problems.rotation_base(pose) for pose in singles]


def sure(*found):
    return np.all([np.asarray(f.result == RESULTS.successful) for f in found], axis=0)


def test_most_pairs_with_errors_are_oriented(hundred):
    assert np.mean(sure(hundred[1])) > 0.95


def test_photo_swap_in_any_position(hundred):
    pairs, one = hundred
    two = orient_batch(swapped(pairs))
    expected = [(r.T, -r.T @ b) for r, b in poses(one)]
    both = sure(one, two)
    assert np.mean(both) > 0.9 and np.max(differences(two, expected)[both]) < 1e-7


def test_point_order_in_any_position(hundred):
    pairs, one = hundred
    two = orient_batch(
        jax.tree.map(
            lambda field: field[..., ::-1] if field.ndim == 2 else field, pairs
        )
    )
    both = sure(one, two)
    assert np.mean(both) > 0.9 and np.max(differences(two, poses(one))[both]) < 1e-7
    np.testing.assert_allclose(
        two.redundancy[both][:, ::-1], one.redundancy[both], atol=1e-6
    )


def test_turn_about_the_photo_axis_in_any_position(hundred):
    """Left photo turned in its plane by 2.5 rad: R' = Q R, b' = Q b."""
    pairs, one = hundred
    turn = oracles.r3(2.5)
    x = turn[0, 0] * pairs.x_left + turn[0, 1] * pairs.y_left
    y = turn[1, 0] * pairs.x_left + turn[1, 1] * pairs.y_left
    two = orient_batch(pair(x, y, pairs.x_right, pairs.y_right, focal=pairs.focal_left))
    both = sure(one, two)
    assert np.mean(both) > 0.9
    assert (
        np.max(differences(two, [(turn @ r, turn @ b) for r, b in poses(one)])[both])
        < 1e-7
    )
