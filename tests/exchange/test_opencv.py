"""Keypoints and matches of OpenCV: what has their attributes, and OpenCV's own."""

from types import SimpleNamespace

import numpy as np
import pixel_scene as scene
import pytest

import jaxro
from jaxro import exchange

ORDER = np.random.default_rng(1).permutation(40)


def keypoint(place, size=4.0):
    return SimpleNamespace(pt=(float(place[0]), float(place[1])), size=float(size))


def match(query, train):
    return SimpleNamespace(queryIdx=int(query), trainIdx=int(train))


@pytest.fixture(scope="module")
def measured():
    """Keypoints of both photos, those of the right one in another order, and
    matches."""
    left, right = (
        scene.pixels(scene.rays(scene.points(), k), matrix)
        for k, matrix in enumerate((scene.K_LEFT, scene.K_RIGHT))
    )
    mixed = right[ORDER]
    matches = [match(ORDER[k], k) for k in range(0, 40, 2)]
    return [keypoint(p, 3) for p in left], [keypoint(p, 6) for p in mixed], matches


def test_matches_name_their_keypoints(measured):
    pair = exchange.pair_from_opencv(*measured, scene.K_LEFT, scene.K_RIGHT, sigma=0.5)
    assert pair.x_left.shape == (20,) and pair.score is None
    assert max(scene.errors(jaxro.orient(pair))) < 1e-9


def test_objects_of_opencv_itself(measured):
    cv2 = pytest.importorskip("cv2", reason="OpenCV has keypoints")
    left, right, matches = measured
    own = lambda k: cv2.KeyPoint(float(k.pt[0]), float(k.pt[1]), float(k.size))
    pair = exchange.pair_from_opencv(
        tuple(map(own, left)),
        tuple(map(own, right)),
        [cv2.DMatch(m.queryIdx, m.trainIdx, 0.5 + k) for k, m in enumerate(matches)],
        scene.K_LEFT,
        scene.K_RIGHT,
    )
    # OpenCV keeps places in single precision
    assert max(scene.errors(jaxro.orient(pair))) < 1e-5
    # the less the farther apart
    np.testing.assert_array_equal(pair.score, -0.5 - np.arange(20))


def test_deviations_by_size_are_those_of_each_photo(measured):
    pair = exchange.pair_from_opencv(
        *measured, 800 * np.diag([1, 1, 1 / 800]), sigma_by_size=0.1
    )
    left, right = pair.covariances
    np.testing.assert_allclose(left, np.broadcast_to(0.09 * np.eye(2), left.shape))
    np.testing.assert_allclose(right, np.broadcast_to(0.36 * np.eye(2), right.shape))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"matches": []}, "no matches given"),
        ({"matches": [[match(0, 0), match(0, 1)]]}, "as knnMatch returns"),
        ({"matches": [match(0, 40)]}, "match 0 names keypoint 40 of the right photo"),
        ({"sigma": 1.0, "sigma_by_size": 0.1}, "exclude each other"),
        ({"keypoints_left": [keypoint((1, 1), 0)] * 40, "sigma_by_size": 0.1}, "sizes [0."),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told(change, told, measured):
    names = ("keypoints_left", "keypoints_right", "matches")
    given = dict(zip(names, measured, strict=True))
    with pytest.raises(ValueError) as error:
        exchange.pair_from_opencv(**(given | change), K_left=scene.K_LEFT)
    assert told in str(error.value)
