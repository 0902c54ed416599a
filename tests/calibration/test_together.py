"""Several images at once: against a dense adjustment in NumPy, and published cameras."""

import numpy as np
import pytest
from oracles_calibration import gauss_newton, rays
from several_images import FEW, MANY, SIGMA, olympus, photos

from jaxro import calibration
from jaxro.calibration import Brown, Model


def rays_of(stations, points, image, point):
    """x/z, y/z of these points in these images, one after the other."""
    every = np.array([rays(station, points) for station in stations])
    return every[image, point]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("depth", "focal_sigma"),
    [
        (0.0, np.inf),
        pytest.param(2.0, np.inf, marks=pytest.mark.slow),
        pytest.param(2.0, 0.02, marks=pytest.mark.slow),
    ],
)
def test_stations_and_points_are_those_of_a_dense_adjustment(depth, focal_sigma):
    """Of a plane field of targets and of a solid one; six points are known, and the
    focal length may be."""
    rng = np.random.default_rng(4)
    points = rng.uniform([-3, -3, -depth], [3, 3, depth], (FEW, 3))
    points[[0, 2, 4, 6, 8, 10], :2] = [
        [-3, -3],
        [3, -3],
        [3, 3],
        [-3, 3],
        [0, 1],
        [1, -2],
    ]
    truth, image, point, places = photos(rng, points)
    known = np.isin(np.arange(FEW), [0, 2, 4, 6, 8, 10])
    given = np.where(known[:, None], points, np.nan)

    def residuals(unknowns):
        stations = unknowns[:24].reshape(4, 6)
        moved = points.copy()
        moved[~known] = unknowns[27:].reshape(-1, 3)
        seen = unknowns[25:27] + unknowns[24] * rays_of(stations, moved, image, point)
        misfits = (places - seen) / SIGMA
        return np.append(misfits, (unknowns[24] - 900.1) / focal_sigma)

    begin = np.concatenate([truth.ravel(), [900, 512, 384], points[~known].ravel()])
    x, q = gauss_newton(residuals, begin, 8)
    freedom = 2 * len(places) + np.isfinite(focal_sigma) - len(x)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / freedom)
    deviations = sigma0 * np.sqrt(np.diag(q))

    measured = calibration.images(*places.T, image, point, given, sigma=SIGMA)
    focal = calibration.known(
        principal=(512.0, 384.0),
        principal_sigma=np.inf,
        focal=900.1,
        focal_sigma=focal_sigma,
    )
    found = calibration.calibrate_together(measured, known=focal)
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
    np.testing.assert_allclose(left.ravel(), -SIGMA * residuals(x)[:-1], atol=1e-5)


@pytest.mark.slow
def test_a_free_network_has_the_inner_geometry_of_any_datum():
    """Focal length, its standard deviation and sigma0 are those of a dense adjustment
    whose datum is one station and a coordinate of the next; and the stations have the
    smallest variances, whose datum moves none of them as a whole."""
    rng = np.random.default_rng(6)
    points = rng.uniform([-3, -3, -1.5], [3, 3, 1.5], (FEW, 3))
    truth, image, point, places = photos(rng, points)

    def residuals(unknowns):
        stations = np.concatenate([truth[0], truth[1, :3], unknowns[:2], truth[1, 5:]])
        stations = np.concatenate([stations, unknowns[2:14]]).reshape(4, 6)
        stations[1, :3] = unknowns[17:20]
        moved = unknowns[20:].reshape(-1, 3)
        seen = unknowns[15:17] + unknowns[14] * rays_of(stations, moved, image, point)
        return ((places - seen) / SIGMA).ravel()

    inner = [900, 512, 384, *truth[1, :3]]
    begin = [*truth[1, 3:5], *truth[2:].ravel(), *inner, *points.ravel()]
    x, q = gauss_newton(residuals, np.array(begin), 8)
    freedom = 2 * len(places) - len(x)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / freedom)

    rough = points + rng.normal(0, 0.01, points.shape)
    measured = calibration.images(*places.T, image, point, rough, sigma=SIGMA)
    found = calibration.calibrate_together(measured, free_network=True)
    assert found.usable and int(found.adjustment.degrees_of_freedom) == freedom
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-6)
    np.testing.assert_allclose(found.focal[0, 0], x[14], rtol=1e-6)
    deviation = sigma0 * np.sqrt(q[14, 14])
    np.testing.assert_allclose(found.focal_deviations[0, 0], deviation, rtol=1e-3)
    held = calibration.calibrate_together(measured)
    assert np.all(found.centre_deviations < held.centre_deviations)


@pytest.mark.slow
def test_variance_components_of_places_and_known_points():
    """Places are twice as good as was said, control points three times as bad."""
    rng = np.random.default_rng(7)
    points = rng.uniform([-3, -3, -1.5], [3, 3, 1.5], (MANY, 3))
    _, image, point, places = photos(rng, points)
    known = np.arange(MANY) < 40
    given = np.where(known[:, None], points + rng.normal(0, 0.003, (MANY, 3)), np.nan)
    measured = calibration.images(
        *places.T, image, point, given, sigma=2 * SIGMA, point_sigma=0.001
    )
    found = calibration.estimate_components(measured)
    assert found.settled
    assert np.all(np.abs(found.factors - [0.5, 3.0]) < 3 * found.deviations)
    assert np.all(found.deviations < 0.1 * found.factors)
    np.testing.assert_allclose(found.found.sigma0, 1.0, atol=0.01)
    fixed = calibration.images(*places.T, image, point, given, sigma=SIGMA)
    with pytest.raises(ValueError, match="known points need standard deviations"):
        calibration.estimate_components(fixed)


@pytest.mark.slow
def test_cameras_of_their_own():
    """Two cameras of different focal lengths took two images each; that every image can
    have a camera of its own is tested with the command."""
    rng = np.random.default_rng(8)
    points = rng.uniform([-3, -3, -1.5], [3, 3, 1.5], (MANY, 3))
    truth, image, point, places = photos(rng, points)
    second = image >= 2
    places[second] = (places[second] - [512, 384]) * 1.2 + [500, 390]
    measured = calibration.images(
        *places.T, image, point, points, sigma=SIGMA, camera=np.array([0, 0, 1, 1])
    )
    found = calibration.calibrate_together(measured)
    assert found.usable and 0.8 < float(found.sigma0) < 1.25
    apart = np.asarray(found.focal)[:, 0] - [900, 1080]
    assert np.all(np.abs(apart) < 4 * found.focal_deviations[:, 0])
    apart = np.asarray(found.centres) - truth[:, 3:]
    assert np.all(np.abs(apart) < 4 * found.centre_deviations)


def test_what_does_not_hang_together_is_refused():
    rng = np.random.default_rng(4)
    points = rng.uniform(-3, 3, (FEW, 3))
    _, image, point, places = photos(rng, points)
    nothing = np.full_like(points, np.nan)
    with pytest.raises(ValueError, match="an image needs 4 points"):
        calibration.images(*places.T, image, point, nothing)
    once = np.where(np.arange(FEW)[:, None] == 3, np.nan, points)
    few = (image == 0) | (point != 3)
    with pytest.raises(ValueError, match="point 3 is unknown and measured in fewer"):
        calibration.images(*places[few].T, image[few], point[few], once)
    sigma = np.ones(len(places))
    sigma[7] = np.nan
    told = rf"place 7 \(point {point[7]} in image {image[7]}\) .* sigma = nan"
    with pytest.raises(ValueError, match=told):
        calibration.images(*places.T, image, point, points, sigma=sigma)
    with pytest.raises(ValueError, match="numbers 0 to 13, got 0 to 14"):
        calibration.images(*places.T, image, point + (point == 13), points)


def test_images_that_do_not_determine_their_stations_are_named():
    """A plane field of targets seen straight from above, without tilts: the distance
    and the focal length can change together."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-3, 3, (FEW, 2)), np.zeros(FEW)])
    _, image, point, _ = photos(rng, points)
    above = np.array([[0, 0, 0.3 * k, k - 1.5, 0, 9] for k in range(4)])
    places = 900 * rays_of(above, points, image, point) + [512, 384]
    places = places + rng.normal(0, SIGMA, places.shape)
    found = calibration.calibrate_together(
        calibration.images(*places.T, image, point, points, sigma=SIGMA)
    )
    assert not found.usable
    with pytest.raises(RuntimeError, match="calibrate_together"):
        found.check()


MILLIMETRES = 5.43764 / 1704  # of a pixel


@pytest.mark.slow
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
