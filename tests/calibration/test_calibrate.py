"""One image, against an independent solution in NumPy; laws of the measuring system."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles_calibration import gauss_newton, jacobian, rays, rotation, scene

from jaxro import calibration
from jaxro.calibration import RESULTS, Brown, Model, Whole
from jaxro.calibration.distances import adjust_distances

SIGMA = 0.006
AT = np.array([110.0, 70.0])
"""Where the principal place is measured."""


def measured(seed, n=40, distort=lambda m: m, turn=0.0, **scene_options):
    """The truth of an image (omega, phi, kappa, X, Y, Z), its object points, and its
    measured places, in a system turned by `turn`."""
    rng = np.random.default_rng(seed)
    angles, station, points, places = scene(rng, n, **scene_options)
    errors = rng.normal(0, SIGMA, places.shape)
    c, s = np.cos(turn), np.sin(turn)
    places = (distort(places) + errors) @ np.array([[c, s], [-s, c]]) + AT
    return np.concatenate([angles, station]), points, places


def found_by_calibrate(points, places, model=None, mask=None, **options):
    """All tests have 40 points, some masked: each model is compiled once."""
    image = calibration.image(*places.T, points, sigma=SIGMA, mask=mask, y_down=True)
    return calibration.calibrate(image, model, **options)


# -------------------------------------------------------------------------------------
# the zones of the oracle, written out by hand


def one(places):
    return np.zeros(len(places), int)


def two_columns_three_rows(places):
    low, high = places.min(0), places.max(0)
    t = (places - low) / (high - low)
    return np.minimum((t[:, 1] * 3).astype(int), 2) * 2 + (t[:, 0] >= 0.5)


def three_strips(places):
    t = (places[:, 0] - places[:, 0].min()) / np.ptp(places[:, 0])
    return np.searchsorted([0.2, 0.7], t, side="right")


def two_rings(places):
    radius = np.hypot(*(places - places.mean(0)).T)
    return (radius >= radius.max() / 2).astype(int)


STRIPS = calibration.strips_along_x([0.0, 0.2, 0.7, 1.0])
RECTANGLES = calibration.rectangles(2, 3)
RINGS = calibration.rings(2, about_centroid=True)
MODELS = {
    "one focal length": (Model(), one, None),
    "along x and y": (Model(y=Whole()), one, one),
    "strips": (Model(x=STRIPS), three_strips, None),
    "rectangles and a ring": (
        Model(x=RECTANGLES, y=RINGS),
        two_columns_three_rows,
        two_rings,
    ),
    "rings": (Model(x=RINGS), two_rings, None),
}


def oracle(points, places, zones_x, zones_y):
    """Residuals in units of sigma of (omega, phi, kappa, X, Y, Z, x0, y0, f ...)."""
    of_x, of_y = zones_x(places), None if zones_y is None else zones_y(places)
    count = of_x.max() + 1

    def residuals(unknowns):
        focal = unknowns[8 : 8 + count][of_x]
        along_y = focal if of_y is None else unknowns[8 + count :][of_y]
        model = np.column_stack([focal, along_y]) * rays(unknowns, points)
        return ((places - unknowns[6:8] - model) / SIGMA).ravel()

    return residuals, count + (0 if of_y is None else of_y.max() + 1)


@pytest.mark.parametrize("name", MODELS)
def test_station_and_focal_lengths_are_those_of_an_independent_solution(name):
    model, *zones = MODELS[name]
    truth, points, places = measured(3)
    residuals, count = oracle(points, places, *zones)
    begin = np.concatenate([truth, AT, np.full(count, 60.0)])
    x, q = gauss_newton(residuals, begin)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / (2 * len(points) - len(x)))
    deviations = sigma0 * np.sqrt(np.diag(q))

    found = found_by_calibrate(points, places, model).check()
    assert found.degrees_of_freedom == 2 * len(points) - len(x)
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-8)
    np.testing.assert_allclose(found.centre, x[3:6], atol=1e-4 * deviations[3:6].min())
    np.testing.assert_allclose(found.centre_deviations, deviations[3:6], rtol=1e-4)
    np.testing.assert_allclose(found.principal, x[6:8], atol=1e-6)
    np.testing.assert_allclose(found.principal_deviations, deviations[6:8], rtol=1e-4)
    np.testing.assert_allclose(found.focal, x[8:], atol=1e-6)
    np.testing.assert_allclose(found.focal_deviations, deviations[8:], rtol=1e-4)
    np.testing.assert_allclose(found.angles, x[:3], atol=1e-7)


ONE_A_ZONE = [Whole(), STRIPS, calibration.rectangles(2, 2), RINGS]
ONE_A_ZONE += [calibration.strips_along_y(2, degree=1)]


@pytest.mark.parametrize("zones", ONE_A_ZONE, ids=range(len(ONE_A_ZONE)))
def test_distances_with_their_full_cofactor_are_the_coordinates(zones):
    _, points, places = measured(3, 40)
    model = Model(x=zones)
    image = calibration.image(*places.T, points, sigma=SIGMA, y_down=True)
    by_distances = adjust_distances(image, model)
    by_coordinates = by_distances.coordinates
    deviations = np.asarray(by_coordinates.centre_deviations)
    apart = np.abs(by_distances.centre - by_coordinates.centre)
    assert np.all(apart < 0.01 * deviations)
    np.testing.assert_allclose(by_distances.sigma0, by_coordinates.sigma0, rtol=1e-4)
    assert by_distances.degrees_of_freedom == by_coordinates.degrees_of_freedom
    np.testing.assert_allclose(by_distances.centre_deviations, deviations, rtol=1e-3)


def test_distances_of_masked_points_are_refused():
    _, points, places = measured(3)
    some = calibration.image(*places.T, points, mask=np.arange(40) > 0)
    with pytest.raises(ValueError, match="leave out the points"):
        adjust_distances(some)


def test_distances_in_numpy():
    """The paper's adjustment with the pseudo-inverse of the distances' covariance."""
    truth, points, places = measured(3)
    first, second = np.triu_indices(len(points), 1)
    of = lambda p: np.hypot(*(p[first] - p[second]).T)
    j = jacobian(lambda p: of(p.reshape(-1, 2)), places.ravel())
    values, vectors = np.linalg.eigh(j @ j.T)
    kept = values > 1e-6 * values.max()
    assert np.sum(kept) == 2 * len(points) - 3
    whiten = (vectors[:, kept] / np.sqrt(values[kept])).T / SIGMA

    def residuals(unknowns):  # the swing is not among them
        angles = [*unknowns[:2], truth[2]]
        seen = rays(np.concatenate([angles, unknowns[2:5]]), points)
        return whiten @ (of(places) - of(unknowns[5] * seen))

    x, q = gauss_newton(residuals, np.concatenate([truth[:2], truth[3:], [60.0]]))
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / (2 * len(points) - 3 - 6))
    deviations = sigma0 * np.sqrt(np.diag(q))
    found = found_by_calibrate(points, places)
    assert np.all(np.abs(found.centre - x[2:5]) < 0.01 * deviations[2:5])
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-4)


def test_brown_is_that_of_an_independent_solution():
    def distort(m):
        r2 = np.sum(m**2, axis=1, keepdims=True)
        return m * (1 - 1e-5 * r2 + 3e-9 * r2**2)

    truth, points, places = measured(5, distort=distort)

    def corrected(about, k1, k2, p1, p2, b1, b2):
        x, y = about.T
        r2 = x * x + y * y
        radial = k1 * r2 + k2 * r2**2
        dx = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y + b1 * x + b2 * y
        dy = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        return about + np.column_stack([dx, dy])

    def misfit(unknowns, places):
        k = unknowns[9:] * [1e-5, 1e-9, 1e-6, 1e-6, 1e-4, 1e-4]
        return corrected(places - unknowns[6:8], *k) - unknowns[8] * rays(
            unknowns, points
        )

    def residuals(unknowns):
        """Each misfit whitened by the factor of the covariance that the errors of x and
        y give it."""
        g = misfit(unknowns, places)
        step = 1e-4
        columns = [
            (misfit(unknowns, places + e) - misfit(unknowns, places - e)) / (2 * step)
            for e in (np.array([step, 0]), np.array([0, step]))
        ]
        b = np.stack(columns, axis=2)
        factor = np.linalg.cholesky(b @ b.transpose(0, 2, 1)) * SIGMA
        return np.linalg.solve(factor, g[:, :, None]).ravel()

    begin = np.concatenate([truth, AT, [60.0, 1, -3, 0, 0, 0, 0]])
    x, q = gauss_newton(residuals, begin)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / (2 * len(points) - len(x)))
    found = found_by_calibrate(points, places, Model(brown=Brown(radial=2))).check()
    deviations = sigma0 * np.sqrt(np.diag(q))
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-5)
    assert np.all(np.abs(found.centre - x[3:6]) < 1e-3 * deviations[3:6])
    units = np.array([1e-5, 1e-9, 1e-6, 1e-6, 1e-4, 1e-4])
    own = np.delete(np.asarray(found.brown), 2)
    assert np.all(np.abs(own - x[9:] * units) < 1e-3 * deviations[9:] * units)
    own = np.delete(np.asarray(found.brown_deviations), 2)
    np.testing.assert_allclose(own, deviations[9:] * units, rtol=1e-3)


# -------------------------------------------------------------------------------------
# laws


@pytest.mark.parametrize("zones", [Whole(), calibration.rectangles(2, 2)])
def test_the_measuring_system_may_be_shifted_and_turned(zones):
    """If the axes of the zones are turned along."""
    seen = []
    for turn in (0.0, 0.7):
        _, points, places = measured(3, 40, turn=turn)
        x = zones
        if turn and isinstance(zones, calibration.Rectangles):
            x = calibration.rectangles(2, 2, turn=turn)
        found = found_by_calibrate(points, places + 1e3 * turn, Model(x=x))
        seen.append([*found.centre, *found.focal, found.sigma0, *found.angles[:2]])
    np.testing.assert_allclose(seen[1], seen[0], rtol=1e-9)


@pytest.mark.parametrize("y_down", [True, None])
def test_the_handedness_is_found_where_points_are_not_in_a_plane(y_down):
    _, points, places = measured(3)
    image = calibration.image(*places.T, points, sigma=SIGMA, y_down=y_down)
    upward = calibration.image(
        places[:, 0],
        -places[:, 1],
        points,
        sigma=SIGMA,
        y_down=None if y_down is None else False,
    )
    first, second = (calibration.calibrate(i).check() for i in (image, upward))
    np.testing.assert_allclose(second.centre, first.centre, rtol=1e-9)
    np.testing.assert_allclose(second.angles, first.angles, atol=1e-9)
    np.testing.assert_allclose(
        second.principal, first.principal * np.array([1.0, -1.0]), rtol=1e-9
    )


def test_a_stretched_film():
    """Stretched by 1 % along x of the measuring system, at any swing: fx and fy tell."""
    for seed in range(6):
        _, points, places = measured(seed, distort=lambda m: m * [1.01, 1.0])
        found = found_by_calibrate(points, places, Model(y=Whole())).check()
        wrong = np.abs(found.focal - np.array([60.6, 60.0]))
        assert np.all(wrong < 3.5 * found.focal_deviations)
        assert abs(found.sigma0 - 1) < 0.3


ZONES = [
    Model(),
    Model(y=Whole()),
    Model(x=calibration.rectangles(2, 2)),
    Model(x=calibration.strips_along_x(2, degree=1)),
    Model(brown=Brown()),
]


@pytest.mark.parametrize("model", ZONES, ids=range(len(ZONES)))
def test_a_plane_object_is_named(model):
    rng = np.random.default_rng(1)
    for _ in range(3):
        _, station, points, places = scene(rng, 40, depth=0.0)
        # the plane is turned, and seen in the same places
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        normal = turn[:, 0] + 3 * (station / np.linalg.norm(station))
        along = points - station
        points = station - along * ((station @ normal) / (along @ normal))[:, None]
        noisy = places + rng.normal(0, SIGMA, places.shape)
        found = found_by_calibrate(points, noisy, model)
        assert found.result == RESULTS.plane_object
        known = calibration.known(principal=(0.0, 0.0), principal_sigma=0.01)
        found = found_by_calibrate(points, noisy, model, known=known)
        affine = model.brown is not None  # and its affinity is unknown as well
        expected = RESULTS.plane_object if affine else RESULTS.successful
        assert found.result == expected


def test_too_little_is_named():
    _, points, places = measured(3)
    found = found_by_calibrate(points, places, mask=np.arange(40) < 4)
    assert found.result == RESULTS.too_few_points
    found = found_by_calibrate(points, places, MODELS["rings"][0], np.arange(40) < 4)
    assert found.result == RESULTS.too_few_points
    beside = np.abs(places[:, 0] - AT[0]) > 10
    gap = Model(x=calibration.strips_along_x([0.0, 0.4, 0.6, 1.0]))
    found = found_by_calibrate(points, places, gap, beside)
    assert found.result == RESULTS.empty_zone
    with pytest.raises(RuntimeError, match="A zone has no point"):
        found.check()


def test_what_is_known_counts():
    """Four points, with a known camera: eight coordinates, six unknowns."""
    truth, points, places = measured(3)
    few = np.arange(40) < 4
    known = calibration.known(
        principal=tuple(AT), principal_sigma=SIGMA, focal=60.0, focal_sigma=SIGMA
    )
    found = found_by_calibrate(points, places, mask=few, known=known)
    assert found.degrees_of_freedom == 2
    assert found.result in (RESULTS.successful, RESULTS.weakly_determined)
    assert np.all(np.abs(found.centre - truth[3:]) < 0.1)


@pytest.mark.parametrize("field", [60, 130])
def test_stereographic_rays(field):
    """Wide angles: the image that r = 2 f tan(angle / 2) makes."""
    rng = np.random.default_rng(2)
    angle, around = np.radians(rng.uniform(0, field / 2, 40)), rng.uniform(0, 6.28, 40)
    distance = rng.uniform(3, 8, (40, 1))
    across = np.column_stack([np.cos(around), np.sin(around)])
    seen = np.column_stack([np.sin(angle)[:, None] * across, np.cos(angle)]) * distance
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation(0.2, -0.1, 1.0)
    points = seen @ turn + [1.0, 2.0, 3.0]
    places = 60 * 2 * np.tan(angle / 2)[:, None] * across + AT
    places = places + rng.normal(0, SIGMA, places.shape)
    found = found_by_calibrate(points, places, Model(rays=calibration.stereographic))
    apart = np.abs(found.check().centre - np.array([1.0, 2.0, 3.0]))
    assert np.all(apart < 4 * found.centre_deviations)
    assert abs(found.focal[0] - 60) < 4 * found.focal_deviations[0]
    assert 0.7 < found.sigma0 < 1.3


def test_masked_points_change_nothing():
    _, points, places = measured(3, 40)
    mask = np.arange(40) != 7
    spoilt = places.copy()
    spoilt[7] = np.nan
    image = calibration.image(*places[mask].T, points[mask], sigma=SIGMA, y_down=True)
    few = calibration.calibrate(image, Model(brown=Brown()))
    same = found_by_calibrate(points, spoilt, Model(brown=Brown()))
    np.testing.assert_allclose(same.centre, few.centre, rtol=1e-9)
    np.testing.assert_allclose(same.brown, few.brown, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(same.sigma0, few.sigma0, rtol=1e-9)


# -------------------------------------------------------------------------------------
# what is said of the results is true


@pytest.mark.slow
@pytest.mark.parametrize("n", [20, 40, 100])
@pytest.mark.parametrize(
    "model",
    [
        Model(),
        Model(y=Whole()),
        Model(x=calibration.rectangles(2, 2)),
        Model(brown=Brown()),
    ],
    ids=["one", "two", "rectangles", "brown"],
)
def test_intervals_hold_the_truth(model, n):
    """95 % intervals of station, focal lengths and principal place in 1,000 images."""
    runs = 1000
    images, stations = [], []
    for seed in range(runs):
        truth, points, places = measured(seed, n)
        images.append(calibration.image(*places.T, points, sigma=SIGMA, y_down=True))
        stations.append(truth[3:])

    def errors(image):
        found = calibration.calibrate(image, model)
        inside = found.interval()
        return (
            (found.centre, inside * found.centre_deviations),
            (found.focal, inside * found.focal_deviations),
            (found.principal, inside * found.principal_deviations),
            found.usable,
        )

    stacked = jax.tree.map(lambda *a: jnp.stack(a), *images)
    *found, usable = jax.jit(jax.vmap(errors))(stacked)
    assert np.mean(usable) > 0.98  # a rectangle may have no point
    for (value, half), true in zip(found, (np.array(stations), 60.0, AT), strict=True):
        held = np.abs(np.asarray(value) - true) <= np.asarray(half)
        shares = held[np.asarray(usable)].mean(axis=0)
        # 93.5 to 96.5 % on the average; each with the error of 1,000 runs
        assert 0.935 < shares.mean() < 0.965
        assert np.all((shares > 0.925) & (shares < 0.975))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "most"), [(20, 0.60), (100, 0.30)])
def test_independent_distances_claim_too_much(n, most):
    held = []
    for seed in range(60):
        truth, points, places = measured(seed, n)
        image = calibration.image(*places.T, points, sigma=SIGMA, y_down=True)
        found = adjust_distances(image, independent=True)
        held.append(np.abs(found.centre - truth[3:]) < 1.96 * found.centre_deviations)
    assert np.mean(held) < most


@pytest.mark.slow
def test_a_stretched_film_is_measured_at_any_swing():
    """One axis of the film is longer by 1 %: fx / fy tells it within three standard
    deviations, and sigma0 is that of the measurements."""
    images = []
    for swing in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        rng = np.random.default_rng(len(images))
        points = rng.uniform([-4, -4, -2], [4, 4, 2], (40, 3))
        angles = np.array([0.2, -0.15, swing])
        station = rotation(*angles).T @ np.array([0.0, 0.0, 12.0])
        places = 60 * rays(np.array([*angles, *station]), points) * [1.01, 1.0]
        places = places + rng.normal(0, SIGMA, places.shape)
        images.append(calibration.image(*places.T, points, sigma=SIGMA, y_down=True))

    def stretch(image):
        found = calibration.calibrate(image, Model(y=Whole()))
        x, y = found.focal
        slopes = jnp.stack([1 / y, -x / y**2])
        covariance = found.covariance[8:10, 8:10] * found.frame.size**2
        return found.sigma0, x / y, jnp.sqrt(slopes @ covariance @ slopes)

    stacked = jax.tree.map(lambda *a: jnp.stack(a), *images)
    sigma0, ratio, deviation = map(np.asarray, jax.jit(jax.vmap(stretch))(stacked))
    assert 0.9 < np.sqrt(np.mean(sigma0**2)) < 1.1
    assert np.all(np.abs(ratio - 1.01) < 3 * deviation)
