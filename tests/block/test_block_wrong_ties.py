"""Blocks of five strips of ten models with wrong ties, from their pairs alone: by
simulation with known truth."""

import numpy as np
import pytest
from oracles_block import find_rays, with_wrong_rays
from scipy.stats import chi2

from jaxro import block

FLIGHT = block.Flight(strips=5, models=10)
BEYOND = 0.0027
"""The probability that a normal number is beyond three of its deviations."""


def distances(found, mock):
    """How far the stations are from the truth, in the measure of their covariance."""
    place = [mock.block.photos.index(name) for name in found.block.photos]
    apart = found.centres - mock.photos.centres[place]
    weights = np.linalg.inv(found.photo_covariances[:, 3:, 3:])
    return np.sqrt(np.einsum("pi,pij,pj->p", apart, weights, apart))


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_blocks_with_wrong_ties_are_right(share):
    """20 blocks. A block is right if it says so, with sigma0 between .95 and 1.05, and
    each station is within its deviations: at the limit that one of all stations exceeds
    with the probability of three deviations. Each single station is beyond its own
    three-deviation limit as often as chance has it."""
    right, single = [], []
    for seed in range(20):
        mock = block.mock_block(7000 + seed, FLIGHT)
        measured, bad = with_wrong_rays(mock, seed, share)
        oriented = block.orient_block(*block.pairs_of(measured, seed), mock.ground)
        found = oriented.adjusted.check()
        away = distances(found, mock)
        limit = np.sqrt(chi2.isf(BEYOND / len(away), 3))
        good = oriented.wrong.settled and 0.95 < found.sigma0 < 1.05
        right.append(good and np.all(away < limit))
        single.append(np.mean(away < np.sqrt(chi2.isf(BEYOND, 3))))
        kept = find_rays(found.block, measured, bad) & found.numbered.rays
        assert np.sum(kept) <= 1
    assert np.mean(right) >= 0.9
    assert np.mean(single) > 0.99


def with_swapped_ties(mock, seed):
    """The block with the names of a tie point and of the nearest other one exchanged on
    one photo, and the two rays."""
    measured, rng = mock.block, np.random.default_rng(seed)
    ties = np.array([name.startswith("t") for name in measured.points])
    ties &= np.bincount(measured.point, minlength=len(ties)) >= 2
    rays = np.flatnonzero(ties[measured.point])
    one = int(rng.choice(rays))
    beside = rays[(measured.photo[rays] == measured.photo[one]) & (rays != one)]
    x, y = measured.x.copy(), measured.y.copy()
    two = [one, beside[np.argmin(np.hypot(x[beside] - x[one], y[beside] - y[one]))]]
    x[two], y[two] = x[two[::-1]], y[two[::-1]]
    return measured._replace(x=x, y=y), np.array(two)


@pytest.mark.slow
def test_swapped_neighbouring_ties_are_left_out():
    """Both rays in 25 blocks, and next to no other points."""
    hits, beside = [], []
    for seed in range(25):
        mock = block.mock_block(8000 + seed, FLIGHT)
        measured, two = with_swapped_ties(mock, seed)
        oriented = block.orient_block(*block.pairs_of(measured, seed), mock.ground)
        found = oriented.adjusted.check()
        swapped = find_rays(found.block, measured, two)
        hits.append(not np.any(swapped & found.numbered.rays))
        points = found.block.point
        others = ~np.isin(points, points[swapped])
        beside.append(np.sum(oriented.wrong.rays & others))
    assert np.mean(hits) >= 0.95
    assert np.mean(np.array(beside) > 0) <= 0.15
