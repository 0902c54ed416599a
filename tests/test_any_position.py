"""Thousands of errorless pairs in any position: the truth is found, or the failure is reported."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro import RESULTS, orient_batch, simulation
from jaxro.results import is_usable


def errors_of_poses(found, true):
    """Angle between the rotations and between the bases, (pair,), from quaternions and unit vectors."""
    q = [np.stack([np.asarray(getattr(p, c)) for c in ("qw", "qx", "qy", "qz")], axis=-1) for p in (found, true)]
    b = [np.stack([np.asarray(getattr(p, c)) for c in ("bx", "by", "bz")], axis=-1) for p in (found, true)]
    turn = np.minimum(np.linalg.norm(q[0] - q[1], axis=-1), np.linalg.norm(q[0] + q[1], axis=-1))
    return 4 * np.arcsin(np.minimum(1.0, turn / 2)), 2 * np.arcsin(
        np.minimum(1.0, np.linalg.norm(b[0] - b[1], axis=-1) / 2)
    )


def check_random_pairs(count, seed):
    pairs, true = simulation.random_pairs(jax.random.key(seed), count, 20)
    points = jax.random.randint(jax.random.key(seed + 1), (count,), 8, 21)
    pairs = pairs.with_mask(jnp.arange(20)[None] < points[:, None])
    found = orient_batch(pairs)
    turn, shift = errors_of_poses(found.pose, true)
    right = (turn < 1e-6) & (shift < 1e-6)
    reported = ~np.asarray(is_usable(found.result)) | np.asarray(found.result == RESULTS.two_solutions)
    wrong = np.flatnonzero(~right & ~reported)
    assert wrong.size == 0, f"pairs {wrong} are wrong and said to be right"
    assert np.mean(right) >= 0.999, f"truth found in {np.mean(right):.2%}"


def test_random_pairs_in_any_position():
    check_random_pairs(1000, seed=0)


@pytest.mark.slow
def test_ten_thousand_random_pairs():
    check_random_pairs(10_000, seed=7)
