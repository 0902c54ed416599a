"""Several images at once: against a dense adjustment in NumPy, and published cameras."""

import numpy as np
import pytest
from oracles_calibration import gauss_newton, rays, rotation

from jaxro import calibration
from jaxro.calibration import Brown, Field, Model

SIGMA = 0.05


def photos(rng, points, images=4):
    """Truth (omega, phi, kappa, X, Y, Z of each image), and places of all points with a
    focal length of 900 about (512, 384), y down; only every second point is seen in the
    last image."""
    truth, places = [], []
    for k in range(images):
        angles = np.array([0.3 * (-1) ** k, 0.25 * (k - 1.5), 0.4 * k])
        turn = rotation(*angles)
        station = turn.T @ np.array([0.0, 0.0, 9.0 + k])
        truth.append([*angles, *station])
        places.append(900 * rays(np.array(truth[-1]), points) + [512, 384])
    image = np.repeat(np.arange(images), len(points))
    point = np.tile(np.arange(len(points)), images)
    seen = (image < images - 1) | (point % 2 == 0)
    places = np.concatenate(places)[seen]
    places = places + rng.normal(0, SIGMA, places.shape)
    return np.array(truth), image[seen], point[seen], places


@pytest.mark.parametrize("depth", [0.0, 2.0])
def test_stations_and_points_are_those_of_a_dense_adjustment(depth):
    """Of a plane field of targets and of a solid one; five points are known."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-3, -3, -depth], [3, 3, depth], (14, 3))
    points[[0, 2, 4, 6, 8, 10], :2] = [
        [-3, -3],
        [3, -3],
        [3, 3],
        [-3, 3],
        [0, 1],
        [1, -2],
    ]
    truth, image, point, places = photos(rng, points)
    known = np.isin(np.arange(14), [0, 2, 4, 6, 8, 10])
    given = np.where(known[:, None], points, np.nan)

    def residuals(unknowns):
        stations = unknowns[:24].reshape(4, 6)
        moved = points.copy()
        moved[~known] = unknowns[27:].reshape(-1, 3)
        found = [
            rays(stations[i], moved[[p]])[0] for i, p in zip(image, point, strict=True)
        ]
        return (
            (places - unknowns[25:27] - unknowns[24] * np.array(found)) / SIGMA
        ).ravel()

    begin = np.concatenate([truth.ravel(), [900, 512, 384], points[~known].ravel()])
    x, q = gauss_newton(residuals, begin, 8)
    freedom = 2 * len(places) - len(x)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / freedom)
    deviations = sigma0 * np.sqrt(np.diag(q))

    measured = calibration.images(*places.T, image, point, given, sigma=SIGMA)
    found = calibration.calibrate_together(measured)
    assert found.usable
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-6)
    stations = x[:24].reshape(4, 6)
    own = deviations[:24].reshape(4, 6)[:, 3:]
    assert np.all(np.abs(found.centres - stations[:, 3:]) < 1e-3 * own)
    np.testing.assert_allclose(found.centre_deviations, own, rtol=1e-3)
    np.testing.assert_allclose(found.focal_deviations[0, 0], deviations[24], rtol=1e-3)
    np.testing.assert_allclose(found.principal[0], x[25:27], atol=1e-3 * deviations[25])
    own = deviations[27:].reshape(-1, 3)
    apart = np.abs(np.asarray(found.points)[~known] - x[27:].reshape(-1, 3))
    assert np.all(apart < 1e-3 * own)
    np.testing.assert_allclose(
        np.asarray(found.point_deviations)[~known], own, rtol=1e-3
    )
    left = np.asarray(found.residuals(places, image, point))
    np.testing.assert_allclose(left.ravel(), -SIGMA * residuals(x), atol=1e-5)


def test_what_does_not_hang_together_is_refused():
    rng = np.random.default_rng(4)
    points = rng.uniform(-3, 3, (14, 3))
    _, image, point, places = photos(rng, points)
    nothing = np.full_like(points, np.nan)
    with pytest.raises(ValueError, match="an image needs 4 points"):
        calibration.images(*places.T, image, point, nothing)
    once = np.where(np.arange(14)[:, None] == 3, np.nan, points)
    few = (image == 0) | (point != 3)
    with pytest.raises(ValueError, match="point 3 is unknown and measured in fewer"):
        calibration.images(*places[few].T, image[few], point[few], once)
    with pytest.raises(ValueError, match="numbers 0 to 13, got 0 to 14"):
        calibration.images(*places.T, image, point + (point == 13), points)


def test_images_that_do_not_determine_their_stations_are_named():
    """A plane field of targets seen straight from above, without tilts: the distance
    and the focal length can change together."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-3, 3, (14, 2)), np.zeros(14)])
    above = [np.array([0, 0, 0.3 * k, x, 0.0, 9.0]) for k, x in enumerate((-1, 0, 1))]
    places = np.concatenate([900 * rays(one, points) + [512, 384] for one in above])
    places = places + rng.normal(0, SIGMA, places.shape)
    image, point = np.repeat(np.arange(3), 14), np.tile(np.arange(14), 3)
    found = calibration.calibrate_together(
        calibration.images(*places.T, image, point, points, sigma=SIGMA)
    )
    assert not found.usable
    with pytest.raises(RuntimeError, match="calibrate_together"):
        found.check()


def olympus(data):
    """The published calibration field: images, points, places in pixels, the known
    points; stations with their deviations (see SOURCE.txt there)."""
    folder = data / "olympus_camcal"
    rows = np.loadtxt(folder / "markpts.txt", delimiter=",")
    image = rows[:, 0].astype(int) - 1
    names, point = np.unique(rows[:, 1].astype(int), return_inverse=True)
    points = np.full((len(names), 3), np.nan)
    known = np.loadtxt(folder / "camcal-fixed.txt", delimiter=",", usecols=(0, 2, 3, 4))
    points[np.searchsorted(names, known[:, 0].astype(int))] = known[:, 1:]
    columns = (1, 2, 3, 7, 8, 9)
    stations = np.loadtxt(
        folder / "published_eo.csv", delimiter=",", skiprows=1, usecols=columns
    )
    return image, point, rows[:, 2:4], points, stations


MILLIMETRES = 5.43764 / 1704  # of a pixel


def test_a_published_camera(data):
    """Brown with one affinity, as published: focal length and principal place within a
    standard deviation, stations within half of one (root mean square)."""
    image, point, places, points, stations = olympus(data)
    measured = calibration.images(*places.T, image, point, points, sigma=0.1)
    found = calibration.calibrate_together(measured, Model(brown=Brown(shear=False)))
    assert found.usable
    focal = float(found.focal[0, 0]) * MILLIMETRES
    assert abs(focal - 7.45700) < 0.00105
    x, y = np.asarray(found.principal[0]) * MILLIMETRES
    assert abs(x - 3.61546) < 0.00082 and abs(y - 2.61329) < 0.00098
    apart = (np.asarray(found.centres) - stations[:, :3]) / stations[:, 3:]
    assert np.sqrt(np.mean(apart**2)) < 0.5


@pytest.mark.slow
def test_a_field_predicts_places_that_were_held_out(data):
    image, point, places, points, _ = olympus(data)
    held = np.random.default_rng(0).random(len(image)) < 0.2
    errors = []
    for model in (
        Model(brown=Brown(shear=False)),
        Model(brown=Brown(), field=Field(0.5, 1.0)),
    ):
        train = places[~held].T, image[~held], point[~held]
        measured = calibration.images(*train[0], *train[1:], points, sigma=0.1)
        found = calibration.calibrate_together(measured, model)
        left = found.residuals(places[held], image[held], point[held])
        errors.append(np.sqrt(np.mean(np.asarray(left) ** 2)))
    assert errors[1] < 0.95 * errors[0]
