"""Thousands of errorless pairs in any position: the truth is found, or the failure is
reported."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

from jaxro import RESULTS, is_usable, orient_batch, pad, pair, swapped
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


PLACES = 20


def random_pairs(count, seed):
    """Errorless pairs of 8 to 20 points, and their true poses."""
    pairs, true = mock_pairs.random_pairs(jax.random.key(seed), count, PLACES)
    points = jax.random.randint(jax.random.key(seed + 1), (count,), 8, PLACES + 1)
    return pairs.with_mask(jnp.arange(PLACES)[None] < points[:, None]), true


THOUSAND = problems.jit(partial(random_pairs, 1000, seed=0))


def check_poses(found, true):
    turn, shift = errors_of_poses(found.pose, true)
    right = (turn < 1e-6) & (shift < 1e-6)
    reported = ~np.asarray(is_usable(found.result)) | np.asarray(
        found.result == RESULTS.two_solutions
    )
    wrong = np.flatnonzero(~right & ~reported)
    assert wrong.size == 0, f"pairs {wrong} are wrong and said to be right"
    assert np.mean(right) >= 0.999, f"truth found in {np.mean(right):.2%}"


@pytest.mark.slow
def test_ten_thousand_random_pairs():
    pairs, true = random_pairs(10_000, seed=7)
    check_poses(orient_batch(pairs), true)


TURN = oracles.r3(2.5)
POINTS = 12


def reverse(field):
    """The points in another order."""
    return field[..., ::-1] if field.ndim == 2 else field


def turned(pairs):
    """The left photo turned in its plane."""
    x = TURN[0, 0] * pairs.x_left + TURN[0, 1] * pairs.y_left
    y = TURN[1, 0] * pairs.x_left + TURN[1, 1] * pairs.y_left
    return pair(x, y, pairs.x_right, pairs.y_right, focal=pairs.focal_left)


def in_every_way():
    """A hundred pairs with small errors as they are, and in other ways that say the
    same."""
    exact, _ = mock_pairs.random_pairs(jax.random.key(3), 100, POINTS)
    keys = jax.random.split(jax.random.key(4), 100)
    hundred = jax.vmap(mock_pairs.noisy, in_axes=(0, 0, None))(exact, keys, 1e-3)
    several = {
        "hundred": hundred,
        "swapped": swapped(hundred),
        "reversed": jax.tree.map(reverse, hundred),
        "turned": turned(hundred),
    }
    return {name: pad(pairs, PLACES) for name, pairs in several.items()}


@pytest.fixture(scope="module")
def found():
    """Of one batch, so that its programs are compiled once: the orientations of a
    thousand errorless pairs, and of a hundred with small errors in every way."""
    batches = jax.tree.map(np.asarray, problems.jit(in_every_way)())
    batches["thousand"] = jax.tree.map(np.asarray, THOUSAND()[0])
    together = orient_batch(
        jax.tree.map(lambda *a: np.concatenate(a), *batches.values())
    )
    ends = np.cumsum([0, *(len(pairs.x_left) for pairs in batches.values())])
    return {
        name: jax.tree.map(lambda a, b=begin, e=end: a[b:e], together)
        for name, begin, end in zip(batches, ends, ends[1:], strict=False)
    }


@pytest.mark.slow
def test_random_pairs_in_any_position(found):
    check_poses(found["thousand"], THOUSAND()[1])


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


@pytest.mark.slow
def test_most_pairs_with_errors_are_oriented(found):
    assert np.mean(sure(found["hundred"])) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ("swapped", lambda r, b: (r.T, -r.T @ b)),
        ("reversed", lambda r, b: (r, b)),
        ("turned", lambda r, b: (TURN @ r, TURN @ b)),
    ],
)
def test_the_same_pairs_said_in_another_way(found, other, expected):
    """Photos exchanged: R' = Rᵀ, b' = -Rᵀ b. The left one turned in its plane: R' = Q R,
    b' = Q b. Points in another order: no change."""
    one, two = found["hundred"], found[other]
    both = sure(one, two)
    assert np.mean(both) > 0.9
    away = differences(two, [expected(*pose) for pose in poses(one)])
    assert np.max(away[both]) < 1e-7
    if other == "reversed":
        np.testing.assert_allclose(
            two.redundancy[both][:, :POINTS][:, ::-1],
            one.redundancy[both][:, :POINTS],
            atol=1e-6,
        )
