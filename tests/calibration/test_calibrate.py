"""One image, against an independent solution in NumPy; laws of the measuring system."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles_calibration import gauss_newton, jacobian, rays, rotation, scene
from simulated_image import (
    AT,
    LENS,
    LINEAR,
    ONE,
    SIGMA,
    STRIPS,
    TURN,
    TURNED,
    TWO,
    UNITS,
    N,
    corrected,
    image,
    measured,
    three_strips,
)

from jaxro import calibration
from jaxro.calibration import RESULTS, Model
from jaxro.calibration.distances import adjust_distances

FEW = np.arange(N) < 4


def found_by_calibrate(points, places, model=ONE, mask=None, **options):
    """All images have `N` points, some of them masked."""
    return calibration.calibrate(image(points, places, mask=mask), model, **options)


# -------------------------------------------------------------------------------------
# the zones of the oracle, written out by hand


def one(places):
    return np.zeros(len(places), int)


def two_columns_three_rows(places):
    """Of a system that is turned by `TURN`."""
    c, s = np.cos(TURN), np.sin(TURN)
    turned = places @ np.array([[c, -s], [s, c]])
    low, high = turned.min(0), turned.max(0)
    t = (turned - low) / (high - low)
    return np.minimum((t[:, 1] * 3).astype(int), 2) * 2 + (t[:, 0] >= 0.5)


def two_rings(places):
    radius = np.hypot(*(places - places.mean(0)).T)
    return (radius >= radius.max() / 2).astype(int)


MODELS = {
    "one focal length": (ONE, one, None),
    "along x and y": (TWO, one, one),
    "strips": (STRIPS, three_strips, None),
    "turned rectangles and rings": (TURNED, two_columns_three_rows, two_rings),
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "strips" else pytest.mark.slow)
        for name in MODELS
    ],
)
def test_station_and_focal_lengths_are_those_of_an_independent_solution(name):
    """Two of the places are not finite: that is told, and they change nothing."""
    model, *zones = MODELS[name]
    truth, points, places = measured(3)
    spoilt = places.copy()
    spoilt[[7, 23]] = np.nan
    found = found_by_calibrate(points, spoilt, model)
    assert found.result == RESULTS.non_finite_input and not found.usable

    points, places = (np.delete(a, [7, 23], axis=0) for a in (points, places))
    residuals, count = oracle(points, places, *zones)
    begin = np.concatenate([truth, AT, np.full(count, 60.0)])
    x, q = gauss_newton(residuals, begin)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / (2 * len(points) - len(x)))
    deviations = sigma0 * np.sqrt(np.diag(q))
    assert found.degrees_of_freedom == 2 * len(points) - len(x)
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-8)
    np.testing.assert_allclose(found.centre, x[3:6], atol=1e-4 * deviations[3:6].min())
    np.testing.assert_allclose(found.centre_deviations, deviations[3:6], rtol=1e-4)
    np.testing.assert_allclose(found.principal, x[6:8], atol=1e-6)
    np.testing.assert_allclose(found.principal_deviations, deviations[6:8], rtol=1e-4)
    np.testing.assert_allclose(found.focal, x[8:], atol=1e-6)
    np.testing.assert_allclose(found.focal_deviations, deviations[8:], rtol=1e-4)
    np.testing.assert_allclose(found.angles, x[:3], atol=1e-7)


@pytest.mark.slow
def test_what_masked_points_hold_changes_nothing():
    """Bit for bit, with a lens; that they do not count is among the claims above."""
    _, points, places = measured(3)
    mask, seen = np.arange(N) != 7, []
    for rubbish in (0.0, np.nan, 1e6):
        spoilt = places.copy()
        spoilt[7] = rubbish
        seen.append(found_by_calibrate(points, spoilt, LENS, mask))
    for other in seen[1:]:
        jax.tree.map(np.testing.assert_array_equal, other, seen[0])


def slow(model):
    return pytest.param(model, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        ONE,
        LINEAR,
        STRIPS,
        Model(x=calibration.rectangles(2, 2)),
        Model(x=TURNED.y),
    ],
    ids=["one", "linear", "strips", "rectangles", "rings"],
)
def test_distances_with_their_full_cofactor_are_the_coordinates(model):
    _, points, places = measured(3)
    by_distances = adjust_distances(image(points, places), model)
    by_coordinates = by_distances.coordinates
    deviations = np.asarray(by_coordinates.centre_deviations)
    apart = np.abs(by_distances.centre - by_coordinates.centre)
    assert np.all(apart < 0.01 * deviations)
    np.testing.assert_allclose(by_distances.sigma0, by_coordinates.sigma0, rtol=1e-4)
    assert by_distances.degrees_of_freedom == by_coordinates.degrees_of_freedom
    np.testing.assert_allclose(by_distances.centre_deviations, deviations, rtol=1e-3)


def test_distances_of_masked_points_are_refused():
    _, points, places = measured(3)
    with pytest.raises(ValueError, match="leave out the points"):
        adjust_distances(image(points, places, mask=np.arange(N) > 0))


def test_distances_in_numpy():
    """The paper's adjustment with the pseudo-inverse of the distances' covariance."""
    truth, points, places = measured(3)
    first, second = np.triu_indices(len(points), 1)
    of = lambda p: np.hypot(*(p[first] - p[second]).T)
    j = jacobian(lambda p: of(p.reshape(-1, 2)), places.ravel())
    vectors, roots, _ = np.linalg.svd(j, full_matrices=False)
    kept = roots > 1e-3 * roots.max()
    assert np.sum(kept) == 2 * len(points) - 3
    whiten = (vectors[:, kept] / roots[kept]).T / SIGMA

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

    def misfit(unknowns, places):
        seen = unknowns[8] * rays(unknowns, points)
        return corrected(places - unknowns[6:8], unknowns[9:]) - seen

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

    begin = np.concatenate([truth, AT, [60.0, 1, -3, 0, 0, 0, 0, 0]])
    x, q = gauss_newton(residuals, begin)
    sigma0 = np.sqrt(np.sum(residuals(x) ** 2) / (2 * len(points) - len(x)))
    found = found_by_calibrate(points, places, LENS).check()
    deviations = sigma0 * np.sqrt(np.diag(q))
    np.testing.assert_allclose(found.sigma0, sigma0, rtol=1e-5)
    assert np.all(np.abs(found.centre - x[3:6]) < 1e-3 * deviations[3:6])
    own = deviations[9:] * UNITS
    assert np.all(np.abs(found.brown - x[9:] * UNITS) < 1e-3 * own)
    np.testing.assert_allclose(found.brown_deviations, own, rtol=1e-3)


# -------------------------------------------------------------------------------------
# laws


def test_the_measuring_system_may_be_shifted_and_turned():
    """That the axes of zones can be turned along is among the claims above."""
    seen = []
    for turn in (0.0, 0.7):
        _, points, places = measured(3, turn=turn)
        found = found_by_calibrate(points, places + 1e3 * turn)
        seen.append([*found.centre, *found.focal, found.sigma0, *found.angles[:2]])
    np.testing.assert_allclose(seen[1], seen[0], rtol=1e-9)


@pytest.mark.parametrize("y_down", [True, None])
def test_the_handedness_is_found_where_points_are_not_in_a_plane(y_down):
    _, points, places = measured(3)
    down = image(points, places, y_down=y_down)
    upward = image(points, places * [1, -1], y_down=None if y_down is None else False)
    first, second = (calibration.calibrate(i).check() for i in (down, upward))
    np.testing.assert_allclose(second.centre, first.centre, rtol=1e-9)
    np.testing.assert_allclose(second.angles, first.angles, atol=1e-9)
    np.testing.assert_allclose(
        second.principal, first.principal * np.array([1.0, -1.0]), rtol=1e-9
    )


@pytest.mark.slow
def test_a_stretched_film():
    """Stretched by 1 % along x of the measuring system, at any swing: fx and fy tell."""
    for seed in range(6):
        _, points, places = measured(seed, distort=lambda m: m * [1.01, 1.0])
        found = found_by_calibrate(points, places, TWO).check()
        wrong = np.abs(found.focal - np.array([60.6, 60.0]))
        assert np.all(wrong < 3.5 * found.focal_deviations)
        assert abs(found.sigma0 - 1) < 0.3


@pytest.mark.parametrize(
    "model",
    [ONE, *(slow(model) for model in (TWO, STRIPS, LINEAR, LENS))],
    ids=["one", "two", "strips", "linear", "lens"],
)
def test_a_plane_object_is_named(model):
    known = calibration.known(
        principal=(0.0, 0.0), principal_sigma=0.01, focal=60.0, focal_sigma=np.inf
    )
    rng = np.random.default_rng(1)
    for _ in range(3):
        _, station, points, places = scene(rng, N, depth=0.0)
        # the plane is turned, and seen in the same places
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        normal = turn[:, 0] + 3 * (station / np.linalg.norm(station))
        along = points - station
        points = station - along * ((station @ normal) / (along @ normal))[:, None]
        noisy = places + rng.normal(0, SIGMA, places.shape)
        found = found_by_calibrate(points, noisy, model)
        assert found.result == RESULTS.plane_object
        found = found_by_calibrate(points, noisy, model, known=known)
        affine = model.brown is not None  # and its affinity is unknown as well
        expected = RESULTS.plane_object if affine else RESULTS.successful
        assert found.result == expected


@pytest.mark.slow
def test_too_little_is_named():
    _, points, places = measured(3)
    for model in (ONE, STRIPS):
        found = found_by_calibrate(points, places, model, FEW)
        assert found.result == RESULTS.too_few_points
    outer = three_strips(places) != 1
    found = found_by_calibrate(points, places, STRIPS, outer)
    assert found.result == RESULTS.empty_zone
    with pytest.raises(RuntimeError, match="A zone has no point"):
        found.check()


def test_what_is_known_counts():
    """Four points, with a known camera: eight coordinates, six unknowns."""
    truth, points, places = measured(3)
    known = calibration.known(
        principal=tuple(AT), principal_sigma=SIGMA, focal=60.0, focal_sigma=SIGMA
    )
    found = found_by_calibrate(points, places, mask=FEW, known=known)
    assert found.degrees_of_freedom == 2
    assert found.result in (RESULTS.successful, RESULTS.weakly_determined)
    assert np.all(np.abs(found.centre - truth[3:]) < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("field", [60, 130])
def test_stereographic_rays(field):
    """Wide angles: the image that r = 2 f tan(angle / 2) makes."""
    rng = np.random.default_rng(2)
    angle, around = np.radians(rng.uniform(0, field / 2, N)), rng.uniform(0, 6.28, N)
    distance = rng.uniform(3, 8, (N, 1))
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


# -------------------------------------------------------------------------------------
# what is said of the results is true


@pytest.mark.slow
@pytest.mark.parametrize("n", [20, 40, 100])
@pytest.mark.parametrize(
    "model",
    [
        ONE,
        TWO,
        Model(x=calibration.rectangles(2, 2)),
        LENS,
    ],
    ids=["one", "two", "rectangles", "brown"],
)
def test_intervals_hold_the_truth(model, n):
    """95 % intervals of station, focal lengths and principal place in 1,000 images."""
    runs = 1000
    images, stations = [], []
    for seed in range(runs):
        truth, points, places = measured(seed, n)
        images.append(image(points, places))
        stations.append(truth[3:])

    def errors(one):
        found = calibration.calibrate(one, model)
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
        found = adjust_distances(image(points, places), independent=True)
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
        images.append(image(points, places))

    def stretch(one):
        found = calibration.calibrate(one, TWO)
        x, y = found.focal
        slopes = jnp.stack([1 / y, -x / y**2])
        covariance = found.covariance[8:10, 8:10] * found.frame.size**2
        return found.sigma0, x / y, jnp.sqrt(slopes @ covariance @ slopes)

    stacked = jax.tree.map(lambda *a: jnp.stack(a), *images)
    sigma0, ratio, deviation = map(np.asarray, jax.jit(jax.vmap(stretch))(stacked))
    assert 0.9 < np.sqrt(np.mean(sigma0**2)) < 1.1
    assert np.all(np.abs(ratio - 1.01) < 3 * deviation)
