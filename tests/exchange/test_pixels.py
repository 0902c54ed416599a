"""Pixels with camera matrices: against projections in plain NumPy and OpenCV's own
correction of distortion."""

import json
from pathlib import Path

import numpy as np
import pixel_scene as scene
import pytest
from scipy.spatial.transform import Rotation

import jaxro
from jaxro import exchange
from jaxro.exchange import lens
from jaxro.exchange.pixels import to_photo


def both_photos(distortion=(0, 0, 0, 0, 0)):
    world = scene.points()
    return tuple(
        scene.pixels(scene.distorted(scene.rays(world, k), distortion), matrix)
        for k, matrix in enumerate((scene.K_LEFT, scene.K_RIGHT))
    )


@pytest.mark.parametrize("distortion", [None, scene.DISTORTION])
def test_exact_pixels_give_the_exact_pose(distortion):
    given = {"distortion_left": distortion, "distortion_right": distortion}
    left, right = both_photos() if distortion is None else both_photos(distortion)
    pair = exchange.pair_from_pixels(left, right, scene.K_LEFT, scene.K_RIGHT, **given)
    found = jaxro.orient(pair)
    assert bool(found.usable)
    assert max(scene.errors(found)) < 1e-9
    assert float(found.sigma0) < 1e-8


def test_photo_coordinates_are_rays_times_the_mean_focal_length():
    points = to_photo(both_photos()[0], scene.K_LEFT)
    u, v = scene.rays(scene.points(), 0).T
    assert points.focal == 801.0
    np.testing.assert_allclose(points.x, 801 * u, atol=1e-10)
    np.testing.assert_allclose(points.y, -801 * v, atol=1e-10)


def test_a_square_pixel_keeps_its_standard_deviation():
    matrix = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    left, right = both_photos()
    pair = exchange.pair_from_pixels(left, right, matrix, sigma=0.4)
    assert pair.roots is None
    np.testing.assert_array_equal(pair.sigma, 0.4)
    assert float(pair.focal_right) == 700


@pytest.mark.parametrize("distortion", [None, scene.DISTORTION])
def test_covariances_are_carried_by_the_slopes(distortion):
    """Against central differences of the coordinates themselves."""
    pixels = both_photos(scene.DISTORTION)[0]
    given = np.array([[0.5, 0.2], [0.2, 0.3]])
    covariances = np.broadcast_to(given, (len(pixels), 2, 2))
    points = to_photo(pixels, scene.K_LEFT, distortion)
    step, columns = 1e-4, []
    for along in np.eye(2):
        ends = [
            to_photo(pixels + sign * step * along, scene.K_LEFT, distortion)
            for sign in (1, -1)
        ]
        ahead, behind = (np.stack([end.x, end.y], axis=1) for end in ends)
        columns.append((ahead - behind) / (2 * step))
    slopes = np.stack(columns, axis=2)
    wanted = slopes @ covariances @ np.swapaxes(slopes, 1, 2)
    np.testing.assert_allclose(points.covariances(covariances), wanted, rtol=1e-6)


def test_every_way_to_say_the_same_accuracy():
    left, right = both_photos()
    make = lambda **given: exchange.pair_from_pixels(
        left, right, scene.K_LEFT, scene.K_RIGHT, **given
    )
    count = len(left)
    same = [
        make(sigma=0.5),
        make(sigma=np.full(count, 0.5)),
        make(sigma=np.full((count, 2), 0.5)),
        make(covariances=(0.25 * np.eye(2), np.full((count, 1, 1), 0.25) * np.eye(2))),
    ]
    for other in same[1:]:
        for a, b in zip(same[0].covariances, other.covariances, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)


def test_stretching_the_rows_with_their_focal_length_changes_nothing():
    """Twice the rows, cy, fy and deviations of rows are the same photo."""
    rng = np.random.default_rng(5)
    left, right = (p + rng.normal(0, 0.3, p.shape) for p in both_photos())
    stretch = np.diag([1.0, 2.0])
    matrices = [scene.K_LEFT.copy(), scene.K_RIGHT.copy()]
    first = jaxro.orient(exchange.pair_from_pixels(left, right, *matrices, sigma=0.3))
    for matrix in matrices:
        matrix[1] *= [1, 2, 2]
    covariance = 0.09 * stretch @ stretch
    again = jaxro.orient(
        exchange.pair_from_pixels(
            left @ stretch,
            right @ stretch,
            matrices[0],
            matrices[1],
            covariances=(covariance, covariance),
        )
    )
    # u = (c - cx - s v) / fx: the skew belongs to v, which is the same
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    rotations = [
        np.array([[float(e) for e in row] for row in o.pose.relative()[0]])
        for o in (first, again)
    ]
    np.testing.assert_allclose(rotations[0], rotations[1], atol=1e-9)


@pytest.mark.parametrize("rational", [(), (0.05, -0.02, 0.01)], ids=["five", "eight"])
def test_distortion_is_that_of_opencv(rational):
    cv2 = pytest.importorskip("cv2", reason="OpenCV corrects distortion itself")
    pixels = both_photos(scene.DISTORTION)[0]
    distortion = (*scene.DISTORTION, *rational)
    criteria = (3, 200, 1e-15)
    told = cv2.undistortPoints(
        pixels[:, None], scene.K_LEFT, np.array(distortion), criteria=criteria
    )[:, 0]
    matrix = scene.K_LEFT.copy()
    matrix[0, 1] = 0  # OpenCV leaves the skew out
    found = to_photo(pixels, matrix, distortion)
    np.testing.assert_allclose(found.x / found.focal, told[:, 0], atol=1e-12)
    np.testing.assert_allclose(-found.y / found.focal, told[:, 1], atol=1e-12)


def test_a_lens_is_not_inverted_beyond_its_fold():
    """r (1 - 0.3 r²) grows up to r = 1.054, 0.703 distorted, and falls from there."""
    coefficients = lens.check_coefficients((-0.3, 0.0))
    radii = np.array([0.0, 0.3, 0.70, 0.71, 2.0])
    found = lens.undistort(np.stack([radii, 0 * radii], axis=1), coefficients)
    np.testing.assert_array_equal(found.found, [True, True, True, False, False])
    inside = found.rays[:3, 0]
    np.testing.assert_allclose(inside * (1 - 0.3 * inside**2), radii[:3], atol=1e-12)
    assert inside[2] < 1.054


def test_a_missing_pixel_stays_missing():
    left, right = both_photos(scene.DISTORTION)
    left[3] = np.nan
    given = {"distortion_left": scene.DISTORTION, "distortion_right": scene.DISTORTION}
    pair = exchange.pair_from_pixels(left, right, scene.K_LEFT, scene.K_RIGHT, **given)
    assert np.isnan(float(pair.x_left[3]))
    assert str(jaxro.orient(pair).result) == str(jaxro.RESULTS.non_finite_input)


TURNED = [[800.0, 0, 320], [1.0, 800, 240], [0, 0, 1]]
NEGATIVE = [[800.0, 0, 320], [0, -800, 240], [0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"points_left": np.zeros((4, 3))}, "left points have shape (4, 3)"),
        ({"points_left": np.zeros((7, 2))}, "7 left and 40 right points"),
        ({"K_left": np.eye(4)}, "K of the left photo must be"),
        ({"K_right": TURNED}, "K of the right photo must be"),
        ({"K_right": NEGATIVE}, "positive fx and fy"),
        ({"sigma": np.ones(7)}, "sigma of shape (7,); wanted one number, (40,) or"),
        ({"sigma": 1.0, "covariances": (np.eye(2), np.eye(2))}, "are given; one is"),
        ({"covariances": (np.eye(3), np.eye(2))}, "covariances of shape (3, 3)"),
        ({"distortion_left": (0.1, 0.1, 0.1)}, "OpenCV's coefficients"),
        ({"distortion_left": (-0.9, 0.0)}, "no ray is seen at pixel"),
        ({"K_right": None, "distortion_right": (0.1, 0)}, "name the right camera"),
    ],
)
def test_what_does_not_fit_is_told(change, told):
    left, right = both_photos()
    if "distortion_left" in change:
        left = left + np.array([900.0, 0])
    given = {
        "points_left": left,
        "points_right": right,
        "K_left": scene.K_LEFT,
        "K_right": scene.K_RIGHT,
    }
    with pytest.raises(ValueError) as error:
        exchange.pair_from_pixels(**(given | change))
    assert told in str(error.value)


@pytest.mark.slow
def test_matches_of_real_photographs(data):
    """Photographs with matches of a learned matcher and the true pose: eth3d, 93 % of
    193 matches good, different K left and right. PoseLib finds 0.24° and 0.22°."""
    folder = Path(data) / "photo_pairs"
    camera = json.loads((folder / "eth3d.json").read_text())
    table = np.loadtxt(folder / "eth3d.csv", delimiter=",", skiprows=1)
    pair = exchange.pair_from_pixels(
        table[:, 1:3], table[:, 3:5], camera["K_left"], camera["K_right"], sigma=1.0
    )
    found = jaxro.rejection.Recommended()(pair).orientation
    truth = np.array(camera["T_left_to_right"])
    rotation = np.array([[float(e) for e in row] for row in found.pose.relative()[0]])
    base = np.array([float(b) for b in found.pose.relative()[1]])
    true_rotation = scene.AXES @ truth[:3, :3].T @ scene.AXES
    true_base = scene.AXES @ (-truth[:3, :3].T @ truth[:3, 3])
    turn = Rotation.from_matrix(rotation @ true_rotation.T).magnitude()
    cosine = base @ true_base / np.linalg.norm(base) / np.linalg.norm(true_base)
    assert np.degrees(turn) < 0.5
    assert np.degrees(np.arccos(cosine)) < 0.5
