"""Chaining of pairs: without errors it is exact, and a wrong pair does no harm."""

import itertools

import numpy as np
import pytest

from jaxro import block
from jaxro.block.chain import Models, chain, intersect, least_closures

MOCK = block.mock_block(1, block.Flight(strips=2, models=4, sigma=1e-9))


def exact_models():
    """All pairs of photos with eight common points or more, from the truth."""
    measured, (turns, centres) = MOCK.block, MOCK.photos
    shown = [set(measured.point[measured.photo == k]) for k in range(len(turns))]
    pairs = itertools.permutations(range(len(turns)), 2)
    pairs = [(i, j) for i, j in pairs if len(shown[i] & shown[j]) >= 8]
    # each pair in one direction, some from right to left
    pairs = [(i, j) for i, j in pairs if (i < j) == ((i + j) % 3 > 0)]
    left, right = np.array(pairs).T
    base = np.einsum("pij,pj->pi", turns[left], centres[right] - centres[left])
    return Models(
        left=left,
        right=right,
        rotation=turns[left] @ np.swapaxes(turns[right], 1, 2),
        base=base / np.linalg.norm(base, axis=1, keepdims=True),
        deviation=np.full(len(left), 1e-3),
    )


def farthest(chained):
    """From the truth after a similarity, in parts of the flying height."""
    true = MOCK.photos.centres - MOCK.photos.centres.mean(axis=0)
    own = chained.centres - chained.centres.mean(axis=0)
    u, s, v = np.linalg.svd(true.T @ own)
    fitted = np.sum(s) / np.sum(own**2) * own @ (u @ v).T
    return np.max(np.linalg.norm(fitted - true, axis=1)) / 1530


def test_right_pairs_close_their_triangles_and_are_chained_exactly():
    models = exact_models()
    photos = len(MOCK.block.photos)
    assert np.max(least_closures(models, photos)) < 1e-12
    assert farthest(chain(MOCK.block, models)) < 1e-6


@pytest.mark.parametrize("pair", [0, 5, 11])
def test_a_wrong_pair_does_no_harm(pair):
    """The most certain one by its own word."""
    models = exact_models()
    angle = 0.8
    c, s = np.cos(angle), np.sin(angle)
    models.rotation[pair] = models.rotation[pair] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    models.deviation[pair] = 1e-4
    closures = least_closures(models, len(MOCK.block.photos))
    np.testing.assert_allclose(closures[pair], 2 * np.sin(angle / 2), rtol=1e-9)
    assert np.max(np.delete(closures, pair)) < 1e-12
    assert farthest(chain(MOCK.block, models)) < 1e-6


def test_one_wrong_ray_of_several_hardly_moves_its_point():
    """A ray with the name of another point: without weights it takes the point along."""
    mock = block.mock_block(2, block.Flight(strips=2, models=4))
    given = mock.block
    rays = np.bincount(given.point)
    point = int(np.argmax(rays))
    assert rays[point] >= 4
    wrong = np.flatnonzero(given.point == point)[0]
    x = given.x.copy()
    x[wrong] += 0.3 * given.focal[given.photo[wrong]]
    found = intersect(given._replace(x=x), mock.photos)
    height = np.mean(mock.photos.centres[:, 2]) - mock.points[point, 2]
    off = np.linalg.norm(found - mock.points, axis=1)
    assert off[point] < 1e-3 * height
    others = np.arange(len(rays)) != point
    np.testing.assert_allclose(found[others], intersect(given, mock.photos)[others])
