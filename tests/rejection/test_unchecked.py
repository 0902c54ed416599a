"""Wrong points that fit because nothing checks them are not kept: facades that photos
walk towards."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scenes

import jaxro
from jaxro.geometry.linear import linearise
from jaxro.rejection import OUTCOMES, Recommended
from jaxro.rejection.unchecked import find_unchecked


def pairs_of(found: scenes.Scenes) -> jaxro.Pair:
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    return jaxro.pair(*found.coordinates, focal=found.focal, sigma=sigma)


def read(rejection):
    solved = rejection.orientation
    finished = rejection.outcome == OUTCOMES.finished
    return finished & solved.usable, solved.pose, solved.covariance, rejection.mask


@cache
def cleaned(count, wrong):
    found = scenes.forward_facades(count, wrong)
    read_of = jaxro.clean_batch(pairs_of(found), Recommended(), select=read)
    return found, jax.tree.map(np.asarray, read_of)


def squared_distances(pose, covariance, found):
    """d' C⁻¹ d of the true pose of every pair from the adjusted one, for d the turn and
    the shift of the base along its tangents; in NumPy."""
    squares = []
    for k, c in enumerate(covariance):
        one = jax.tree.map(lambda a, k=k: jnp.asarray(a[k]), pose)
        rotation, base = problems.rotation_base(one)
        turn = found.rotation[k] @ rotation.T
        d = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        moved = [
            problems.rotation_base(one.move(tuple(jnp.asarray(1e-6 * np.eye(5)[i]))))
            for i in range(5)
        ]
        slopes = [
            np.append((r @ rotation.T)[[2, 0, 1], [1, 2, 0]], b) for r, b in moved
        ]
        slopes = np.stack(slopes) - np.append((0.0, 0.0, 0.0), base)
        away = np.append(np.array(d) / 2, found.base[k] - base)
        x = np.linalg.lstsq(slopes.T / 1e-6, away, rcond=None)[0]
        squares.append(x @ np.linalg.solve(c, x))
    return np.array(squares)


@pytest.mark.parametrize(
    ("wrong", "least"),
    [pytest.param(0.0, 0.9, marks=pytest.mark.slow), (0.2, 0.8)],
)
def test_the_regions_of_a_forward_facade_hold(wrong, least):
    """95 % regions of 60 pairs, nearly all of them usable; one wrong point kept without a check
    would put half of them out of theirs."""
    found, (usable, pose, covariance, mask) = cleaned(60, wrong)
    assert np.mean(usable) >= 0.95
    squares = squared_distances(pose, covariance, found)[usable]
    assert least <= np.mean(squares < 11.07)
    assert np.mean(np.sum(mask & ~found.good, axis=1)[usable]) < 0.15
    assert np.mean(np.sum(~mask & found.good, axis=1)[usable]) < 1


def by_hand(pair, pose, use, count):
    """The points of the largest leverage, one after the other, and by how much the
    variance grows along the direction that all of them carry; in NumPy."""
    linear = linearise(pair, pose)
    a = np.stack(linear.columns, axis=1) * np.sqrt(np.asarray(linear.weight))[:, None]
    left, gone, whole = np.array(use), [], a[use].T @ a[use]
    for _ in range(count):
        cofactor = np.linalg.inv(a[left].T @ a[left])
        leverage = np.where(left, np.einsum("ki,ij,kj->k", a, cofactor, a), -1)
        gone.append(int(np.argmax(leverage)))
        left[gone[-1]] = False
    grown = np.linalg.eigvals(whole @ np.linalg.inv(a[left].T @ a[left]))
    return set(gone), np.max(np.real(grown))


def with_a_pole(count):
    """A pair with a facade and `count` points on a pole near the cameras, all right but
    for a fifth; its true pose, the points in use, and those on the pole."""
    found = scenes.forward_facades(1, 0.2)[0]
    left, right = (np.stack(found.coordinates[k : k + 2], axis=1) for k in (0, 2))
    on_pole = np.arange(len(left)) >= len(left) - count
    height = np.linspace(-100, 100, count) if count > 1 else np.zeros(1)
    left[on_pole] = np.stack([700 + 0 * height, height], axis=1)
    space = scenes.rays(left[on_pole], found.focal) / found.focal * 3.0
    station = np.array(scenes.FORWARD_BASE)
    right[on_pole], _ = scenes.project(space, found.rotation, station, found.focal)
    pair = jaxro.pair(*left.T, *right.T, focal=found.focal, sigma=found.sigma)
    use = jnp.asarray(found.good)
    return pair, jaxro.orient(pair.with_mask(use)).pose, use, np.flatnonzero(on_pole)


CHANCE = 0.004


@pytest.mark.slow
def test_one_point_on_a_pole_is_unchecked_and_many_are_not():
    """One right point tells as much of the base as one of 120 wrong ones by chance;
    twenty of them tell what no accident does."""
    pair, pose, use, pole = with_a_pole(1)
    gone, growth = by_hand(pair, pose, np.asarray(use), 1)
    unchecked = find_unchecked(pair, pose, use, jnp.asarray(CHANCE))
    assert gone == set(pole) == set(np.flatnonzero(unchecked).tolist())
    assert growth > 10
    pair, pose, use, pole = with_a_pole(20)
    gone, growth = by_hand(pair, pose, np.asarray(use), 20)
    assert gone == set(pole) and growth > 10
    unchecked = find_unchecked(pair, pose, use, jnp.asarray(CHANCE))
    assert not np.any(unchecked)
