"""Calibrated images as cameras of OpenCV."""

import numpy as np
import pytest
from oracles_calibration import rotation

from jaxro import block, calibration, exchange
from jaxro.block.adjust_chained import start_from
from jaxro.calibration import Brown, Model
from jaxro.exchange.lens import check_coefficients, distort

cv2 = pytest.importorskip("cv2")
K = np.array([[1500.0, 0, 980.0], [0, 1500.0, 620.0], [0, 0, 1]])
DISTORTION = np.array([-0.12, 0.05, 4e-4, -6e-4, -0.01])
SIGMA = 0.05


def photographed(y_down=True):
    """A photo of a field of targets by a camera of OpenCV, and its calibration."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, -2, -1], [3, 2, 1], (250, 3))
    seen = (points - [0.5, -0.3, -6.0]) @ rotation(0.1, -0.05, 0.2).T
    rays = seen[:, :2] / seen[:, 2:]
    places = distort(rays, check_coefficients(DISTORTION)) @ K[:2, :2] + K[:2, 2]
    places = places + rng.normal(0, SIGMA, places.shape)
    if not y_down:
        places = places * [1, -1]
    image = calibration.image(*places.T, points, sigma=SIGMA)
    model = Model(brown=Brown())
    return places, calibration.calibrate(image, model).check()


@pytest.mark.parametrize("y_down", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_opencv_undistorts_to_the_places_of_the_calibration(y_down):
    """Within what its coefficients cannot say, which is told; and it is near the camera
    that took the photo."""
    places, found = photographed(y_down)
    camera = exchange.opencv_camera(found)
    assert camera.rest < 0.02 and camera.largest < 0.1
    np.testing.assert_allclose(camera.matrix, K, atol=1.0)
    np.testing.assert_allclose(camera.distortion[:2], DISTORTION[:2], atol=5e-3)
    corrected = calibration.correct(found, places)
    down = places * [1, 1 if y_down else -1]
    rays = cv2.undistortPoints(down[:, None], camera.matrix, camera.distortion)[:, 0]
    ideal = rays * float(corrected.focal) * [1, -1]
    off = np.hypot(*(ideal - np.asarray(corrected.places)).T)
    assert np.max(off[corrected.inside]) < 1.5 * camera.largest


def test_what_is_not_usable_has_no_camera():
    flat = np.column_stack(
        [np.random.default_rng(1).uniform(-3, 3, (20, 2)), np.zeros(20)]
    )
    places = 900 * flat[:, :2] / 9 + [512, 384]
    found = calibration.calibrate(calibration.image(*places.T, flat, sigma=SIGMA))
    assert not bool(found.usable)
    with pytest.raises(ValueError, match="not usable"):
        exchange.opencv_camera(found)


def test_the_camera_of_a_block_goes_back_to_opencv():
    """Photos in pixels by a camera of OpenCV, whose principal point and focal length are
    given wrong: undistorted by the exported camera, places are those of the block."""
    size, given = 0.01, (11000.0, 11200.0)
    flight = block.Flight(strips=2, models=5, sideward=0.5, sigma=0.002)
    mock = block.mock_block(7, flight, control_every=2)
    true = np.array([[15300.0, 0, 11020.0], [0, 15300.0, 11230.0], [0, 0, 1]])
    ideal = np.stack([mock.block.x, -mock.block.y], axis=1) / flight.focal
    distortion = np.array([-0.02, 0.01, 2e-4, -1e-4, 0.0])
    pixels = distort(ideal, check_coefficients(distortion)) @ true[:2, :2] + true[:2, 2]
    at = (pixels - given) * size * [1, -1]
    measured = mock.block._replace(
        x=at[:, 0], y=at[:, 1], focal=np.full(len(mock.block.photos), 152.0)
    )
    inner = block.Inner(radial=2, tangential=True)
    start = start_from(mock.block, mock.photos)
    found = block.adjust_block(measured, start, mock.ground, inner).check()
    (camera,) = exchange.opencv_cameras(found).values()
    camera = camera.in_pixels(size, given, y_down=True)
    assert camera.rest < 0.05 and camera.largest < 0.3
    np.testing.assert_allclose(camera.matrix, true, atol=30.0)
    np.testing.assert_allclose(camera.distortion[:2], distortion[:2], atol=2e-3)
    rays = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.distortion)[:, 0]
    off = np.hypot(*((rays - found.ideal_places) * 15300.0).T)
    assert np.max(off) < 1.5 * camera.largest

    up = exchange.opencv_cameras(found)["1"].in_pixels(size, given, y_down=False)
    down = camera.matrix[1, 2] - given[1]
    assert up.matrix[1, 2] == pytest.approx(down - given[1])
    plain = block.adjust_block(mock.block, start, mock.ground)
    with pytest.raises(ValueError, match="no inner parameters are unknown"):
        exchange.opencv_cameras(plain)
