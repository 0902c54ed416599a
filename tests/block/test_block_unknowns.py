"""Inner parameters as unknowns, known stations, scale bars, and variance components of a
block: by simulation with known truth."""

import numpy as np
import pytest

from jaxro import block
from jaxro.block import Flight, Inner, adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.bars import scale_of
from jaxro.block.components import adjust_with_components, components_of

FLIGHT = Flight(strips=3, models=5, relief=200.0)


# its pairs are oriented by programs that two tests share
SMALL = block.mock_block(8, Flight(strips=2, models=4))


def flown(seed, flight=FLIGHT, **options):
    """A block with known points across the strips at every second photo."""
    return block.mock_block(seed, flight, control_every=2, **options)


CAMERA = np.array([153.05, 0.03, -0.02, 2e-8])
"""Focal length, principal point and k1 of the camera that took the photos; 153, 0, 0, 0
are given."""


def other_camera(measured):
    """The places as this camera would have shown them."""
    focal, x0, y0, k1 = CAMERA
    x, y = measured.x * focal / 153, measured.y * focal / 153
    radial = 1 - k1 * (x**2 + y**2)
    return measured._replace(x=x * radial + x0, y=y * radial + y0)


@pytest.mark.slow
def test_inner_parameters_are_true_within_their_deviations():
    """So are the points; with the camera that was given sigma0 tells."""
    z = []
    for seed in range(6):
        mock = flown(seed)
        measured = other_camera(mock.block)
        start = start_from(mock.block, mock.photos)
        given = adjust_block(measured, start, mock.ground)
        assert given.sigma0 > 1.3
        found = adjust_block(measured, start, mock.ground, Inner(radial=1)).check()
        assert found.degrees_of_freedom == given.degrees_of_freedom - 4
        assert 0.9 < found.sigma0 < 1.1
        cameras = found.cameras
        assert cameras.names == ("focal", "x0", "y0", "k1")
        z.append((cameras.values[0] - CAMERA) / cameras.deviations[0])
        off = (found.coordinates - mock.points) / found.deviations
        assert np.nanmax(np.abs(off)) < 5
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((rms > 0.3) & (rms < 2))


def test_all_inner_parameters_of_two_cameras():
    """Photos with one focal length have one camera; without errors what the photos were
    taken with is found to rounding."""
    mock = flown(3, FLIGHT._replace(sigma=1e-9), control_sigma=1e-7)
    measured = mock.block
    # the second half of the photos by another camera
    focal = np.where(np.arange(len(measured.photos)) < 9, 153.0, 120.0)
    scale = (focal / 153)[measured.photo]
    measured = measured._replace(
        x=measured.x * scale,
        y=measured.y * scale,
        focal=focal + 0.01,
        sigma=np.full(len(measured.x), 1e-9),
    )
    start = start_from(mock.block, mock.photos)
    every = Inner(radial=3, tangential=True, affinity=True)
    found = adjust_block(measured, start, mock.ground, every).check()
    assert found.cameras.values.shape == (2, 10)
    values, deviations = found.cameras.values, found.cameras.deviations
    np.testing.assert_allclose(values[:, 0], [120, 153], atol=1e-5)
    assert np.all(np.abs(values[:, 1:]) < 6 * deviations[:, 1:])


def test_known_stations_are_those_of_a_dense_adjustment():
    """A block that stations alone place on the ground: with control points of the same
    deviations the normal equations are those of a dense adjustment, which
    `test_orient_block` has; here each station weighs as a control point would."""
    mock = flown(4)
    measured, rng = mock.block, np.random.default_rng(4)
    stations = len(measured.photos)
    at = mock.photos.centres + rng.normal(0, 0.05, (stations, 3))
    known = block.ground(measured.photos, at, 0.05, station=np.ones(stations, bool))
    start = start_from(measured, mock.photos)
    found = adjust_block(measured, start, known).check()
    rays = int(np.sum(found.numbered.rays))
    unknowns = 6 * stations + 3 * int(np.max(found.numbered.number) + 1)
    assert found.degrees_of_freedom == 2 * rays + 3 * stations - unknowns
    total = np.nansum(found.redundancy) + np.sum(found.control_redundancy)
    np.testing.assert_allclose(total, found.degrees_of_freedom, rtol=1e-9)
    np.testing.assert_allclose(
        found.control_residuals, found.centres - at, rtol=1e-6, atol=1e-9
    )
    # the cofactor of a station and its redundancy say the same
    variance = (found.centre_deviations / found.sigma0) ** 2
    np.testing.assert_allclose(
        found.control_redundancy, 1 - variance / 0.05**2, rtol=1e-6
    )
    off = (found.coordinates - mock.points) / found.deviations
    assert 0.5 < np.sqrt(np.nanmean(off**2)) < 1.6


@pytest.mark.slow
def test_a_block_is_placed_by_its_stations_alone():
    """From the pairs, one station wrong by 30 m."""
    mock = SMALL
    left, right, pairs, points = block.pairs_of(mock.block)
    rng = np.random.default_rng(5)
    names = mock.block.photos
    at = mock.photos.centres + rng.normal(0, 0.05, (len(names), 3))
    at[7, 0] += 30.0
    known = block.ground(names, at, 0.05, station=np.ones(len(names), bool))
    found = block.orient_block(left, right, pairs, points, known)
    wrong = np.any(found.wrong.control, axis=1)
    assert wrong[7] and np.sum(wrong) == 1
    assert 0.9 < found.adjusted.sigma0 < 1.1
    off, _ = found.adjusted.compare(known)
    assert off[7, 0] == pytest.approx(-30, abs=0.5)


@pytest.mark.slow
def test_variance_components_find_what_was_stated_wrong():
    """Places with twice their deviation, control with a quarter of it."""
    factors, z = [], []
    for seed in range(12):
        mock = block.mock_block(seed, FLIGHT, control_every=1, control_sigma=0.5)
        start = start_from(mock.block, mock.photos)
        ground = mock.ground._replace(sigma=mock.ground.sigma / 4)
        measured = mock.block._replace(sigma=mock.block.sigma * 2)
        adjusted, found = adjust_with_components(block.Given(measured, ground), start)
        assert adjusted.sigma0 == pytest.approx(1, abs=1e-4)
        again = components_of(adjusted)
        assert all(abs(one.factor - 1) < 1e-3 for one in again.values())
        both = found["places"], found["control"]
        factors.append([one.factor for one in both])
        spread = [one.deviation for one in both]
        z.append((np.array(factors[-1]) - [0.5, 4.0]) / spread)
    np.testing.assert_allclose(np.mean(factors, axis=0), [0.5, 4.0], rtol=0.05)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((rms > 0.4) & (rms < 1.6))


def test_scale_bars_are_those_of_a_dense_update():
    """Two bars in a network with control: what they change is the update of its joint
    covariance in NumPy, and their redundancies follow from it."""
    mock = block.mock_block(7, Flight(models=3))
    measured, start = mock.block, start_from(mock.block, mock.photos)
    plain = adjust_block(measured, start, mock.ground).check()
    names = [("t7", "t20"), ("t9", "t16")]
    numbers = [[measured.points.index(name) for name in pair] for pair in names]
    true = [np.linalg.norm(mock.points[a] - mock.points[b]) for a, b in numbers]
    length = np.array(true) + np.array([0.02, -0.01])
    given = block.bars(*zip(*names, strict=True), length, 0.03)
    found = adjust_block(measured, start, mock.ground, bars=given).check()
    assert found.degrees_of_freedom == plain.degrees_of_freedom + 2
    total = np.nansum(found.redundancy) + np.nansum(found.control_redundancy)
    total += np.sum(found.bar_redundancy)
    np.testing.assert_allclose(total, found.degrees_of_freedom, rtol=1e-6)
    apart = found.coordinates[[a for a, _ in numbers]]
    apart = apart - found.coordinates[[b for _, b in numbers]]
    length = np.linalg.norm(apart, axis=1)
    np.testing.assert_allclose(length - given.length, found.bar_residuals, atol=1e-7)
    # bars without weight change nothing
    weak = given._replace(sigma=given.sigma * 1e6)
    same = adjust_block(measured, start, mock.ground, bars=weak).check()
    np.testing.assert_allclose(same.coordinates, plain.coordinates, atol=1e-6)
    np.testing.assert_allclose(same.bar_redundancy, 1, atol=1e-6)


@pytest.mark.slow
def test_bars_without_weight_leave_the_cameras_what_they_are():
    """Values and deviations: the ends of the bars are common unknowns beside them."""
    mock = block.mock_block(7, Flight(models=3))
    measured, start = mock.block, start_from(mock.block, mock.photos)
    inner = Inner(principal=False)
    plain = adjust_block(measured, start, mock.ground, inner).check().cameras
    given = block.bars(["t7", "t9"], ["t20", "t16"], np.full(2, 1e3), 1e7)
    found = adjust_block(measured, start, mock.ground, inner, bars=given).check()
    np.testing.assert_allclose(found.cameras.values, plain.values, rtol=1e-7)
    # one more degree of freedom for each bar, which fits
    np.testing.assert_allclose(
        found.cameras.deviations / found.sigma0,
        plain.deviations / adjust_block(measured, start, mock.ground, inner).sigma0,
        rtol=1e-5,
    )


@pytest.mark.slow
def test_bars_give_a_free_network_its_scale():
    mock = SMALL
    left, right, pairs, points = block.pairs_of(mock.block)
    at = dict(zip(mock.block.points, mock.points, strict=True))
    names = [("t20", "t60"), ("t30", "t62"), ("c0", "c3")]
    length = np.array([np.linalg.norm(at[a] - at[b]) for a, b in names])
    given = block.bars(*zip(*names, strict=True), length, 0.01)
    found = block.orient_block(left, right, pairs, points, bars=given).adjusted
    free = block.orient_block(left, right, pairs, points).adjusted
    # one distance for the scale, two that are checked
    assert found.degrees_of_freedom == free.degrees_of_freedom + 2
    now = dict(zip(found.block.points, found.coordinates, strict=True))
    one, other = "t10", "t64"
    true = np.linalg.norm(at[one] - at[other])
    assert np.linalg.norm(now[one] - now[other]) == pytest.approx(true, rel=2e-4)
    with pytest.raises(ValueError, match="no bar has both"):
        strange = given._replace(one=("a", "b", "c"))
        block.orient_block(left, right, pairs, points, bars=strange)


def test_the_scale_of_a_network_is_that_of_its_precise_bars():
    mock = SMALL
    names = mock.block.points[:4], mock.block.points[4:8]
    at = dict(zip(mock.block.points, mock.points, strict=True))
    apart = zip(*names, strict=True)
    length = np.array([np.linalg.norm(at[a] - at[b]) for a, b in apart])
    scale = lambda factors, sigma: scale_of(
        block.bars(*names, length * factors, sigma), mock.block, mock.points
    )
    assert scale([2.0, 2.0, 2.0, 3.0], 0.01) == pytest.approx(2.0)
    assert scale([2.0, 3.0, 4.0, 5.0], 0.01 * length) == pytest.approx(3.5)
    imprecise = np.array([0.02, 5000.0, 5000.0, 5000.0])
    assert scale([2.0, 3.0, 3.0, 3.0], imprecise) == pytest.approx(2.0)


@pytest.mark.parametrize("unknown", [2, 0])
def test_two_coordinates_of_a_point_on_one_photo_determine_it(unknown):
    """It begins on its ray; its other two coordinates check the photo by one."""
    mock = block.mock_block(9, Flight(models=3))
    name = mock.block.points[20]
    rays = np.flatnonzero(mock.block.point == 20)
    alone = np.zeros(len(mock.block.photo), bool)
    alone[rays[1:]] = True
    measured = mock.block.without(alone)
    at = np.array([mock.points[20]])
    at[0, unknown] = np.nan
    known = mock.ground._replace(
        points=(*mock.ground.points, name),
        coordinates=np.concatenate([mock.ground.coordinates, at]),
        sigma=np.concatenate([mock.ground.sigma, np.full((1, 3), 0.02)]),
        check=np.append(mock.ground.check, False),
        station=np.append(mock.ground.station, False),
    )
    start = start_from(measured, mock.photos)
    assert np.all(np.isnan(start.points[20]))
    found = adjust_block(measured, start, known).check()
    without = adjust_block(measured, start, mock.ground).check()
    assert found.degrees_of_freedom == without.degrees_of_freedom + 1
    off = (found.coordinates[20] - mock.points[20]) / found.deviations[20]
    assert np.max(np.abs(off)) < 4
