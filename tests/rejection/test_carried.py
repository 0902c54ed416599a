"""A base that a few points alone carry is never called successful."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import jaxro
from jaxro.geometry.elements import vertical
from jaxro.geometry.linear import linearise
from jaxro.rejection import OUTCOMES, Recommended
from jaxro.rejection.carried import carriers

POINTS = 50


def pairs_of(found: scenes.Scenes) -> jaxro.Pair:
    sigma = np.broadcast_to(found.sigma[:, None], found.good.shape)
    return jaxro.pair(*found.coordinates, focal=found.focal, sigma=sigma)


def read(rejection):
    solved = rejection.orientation
    fine = solved.result == jaxro.RESULTS.successful
    settled = (rejection.outcome == OUTCOMES.finished) | (
        rejection.outcome == OUTCOMES.undecided
    )
    believed = rejection.outcome == OUTCOMES.not_oriented
    still = believed & (solved.result == jaxro.RESULTS.zero_base)
    return fine & settled, still, rejection.mask, solved.pose.relative()


def cleaned(found: scenes.Scenes):
    return jax.tree.map(
        np.asarray, jaxro.clean_batch(pairs_of(found), Recommended(), select=read)
    )


@pytest.mark.slow
def test_photos_that_only_turn_have_no_base_whatever_wrong_points_say():
    """Of 24 pairs with three in ten points wrong none is successful. Where the rotation
    is told, it is that of all right points."""
    found = scenes.weak_bases("rotation", 24, POINTS, 0.3)
    successful, still, mask, _ = cleaned(found)
    assert not np.any(successful)
    assert np.mean(still) > 0.7
    right = found.good[still]
    assert np.mean(mask[still][right]) > 0.995


@pytest.mark.slow
def test_points_in_space_carry_their_base():
    successful, _, _, (_, base) = cleaned(scenes.weak_bases("space", 24, POINTS, 0.3))
    assert np.sum(successful) >= 23
    assert np.all(np.isfinite(base[0]))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*scenes.WITHOUT_BASE, "plane"])
def test_what_is_successful_is_right(kind):
    """Of 200 pairs of each share of wrong points one may be grossly wrong."""
    for share in (0.0, 0.2, 0.4):
        found = scenes.weak_bases(kind, 200, POINTS, share)
        successful, _, _, (rotation, base) = cleaned(found)
        turned = np.moveaxis(np.array(rotation), (0, 1), (-2, -1))
        off = np.linalg.norm(turned - found.rotation, axis=(1, 2)) / np.sqrt(2)
        apart = np.linalg.norm(np.moveaxis(np.array(base), 0, -1) - found.base, axis=1)
        gross = (off > np.deg2rad(2)) | (apart > np.deg2rad(10)) | ~found.common
        assert np.sum(successful & gross) <= 1


def test_carriers_are_those_of_plain_algebra():
    """Points far away and three near ones: these carry the base. In NumPy: what leaves
    the smallest eigenvalue of the normal matrix smallest, one point after the other."""
    rng = np.random.default_rng(3)
    left = rng.uniform([-500, -400], [500, 400], (16, 2))
    depth = np.where(np.arange(16) < 3, 4.0, 1e5)
    space = np.column_stack([left / 1000, -np.ones(16)]) * depth[:, None]
    right = space - [1.0, 0.0, 0.0]
    right = -1000 * right[:, :2] / right[:, 2:]
    measured = np.hstack([left, right]) + rng.normal(0, 0.2, (16, 4))
    pair = jaxro.pair(*measured.T, focal=1000.0, sigma=0.2)
    pose = vertical(jnp.zeros(()))
    needed, found = carriers(pair, pose, pair.mask, jnp.ones(()))
    linear = linearise(pair, pose)
    design = np.stack(linear.columns, axis=1) * np.sqrt(linear.weight)[:, None]
    left_over, taken = np.arange(16), []
    for _ in range(int(np.sum(needed))):
        _, vectors = np.linalg.eigh(design[left_over].T @ design[left_over])
        largest = np.argmax((design[left_over] @ vectors[:, 0]) ** 2)
        taken.append(left_over[largest])
        left_over = np.delete(left_over, largest)
    assert bool(found)
    assert set(np.flatnonzero(needed)) == set(taken) <= {0, 1, 2}


def test_the_rotation_has_its_deviations():
    """Of 40 pairs without errors but noise: the squared deviation from the truth in
    units of its covariance is chi-square with three degrees of freedom."""
    found = scenes.weak_bases("rotation", 40, 16, 0.0)
    distances = []
    for k in range(40):
        own = [c[k] for c in found.coordinates]
        sigma, focal = float(found.sigma[k]), float(found.focal[k])
        turned = jaxro.orient_rotation(jaxro.pair(*own, focal=focal, sigma=sigma))
        small = np.asarray(turned.rotation) @ found.rotation[k].T
        apart = np.array(
            [
                small[2, 1] - small[1, 2],
                small[0, 2] - small[2, 0],
                small[1, 0] - small[0, 1],
            ]
        )
        distances.append(apart / 2 @ np.linalg.solve(turned.cofactor, apart / 2))
        assert int(turned.degrees_of_freedom) == 29
    assert abs(np.mean(distances) - 3) < 3 * np.sqrt(6 / 40)
