"""The datum of a free network: a pseudo-inverse in NumPy, laws, and strips that centres
alone would hardly hold."""

import numpy as np
import pytest
from oracles_block import dense_slopes, find_rays, rotations_of, with_wrong_rays

from jaxro import block
from jaxro.adjustment import RESULTS
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.orient_block import orient_block


def adjust_freely(strips, models, seed=1):
    """A free network, and its start."""
    mock = block.mock_block(seed, block.Flight(strips=strips, models=models))
    start = start_from(mock.block, mock.photos)
    return adjust_block(mock.block, start).check(), start


def distance_of(found):
    """From photos to the points that they show, the median."""
    used = found.numbered.rays
    apart = found.coordinates[found.block.point] - found.centres[found.block.photo]
    return np.median(np.linalg.norm(apart[used], axis=1))


@pytest.mark.parametrize(("strips", "models"), [(1, 3), (2, 4)])
def test_its_cofactors_are_the_pseudo_inverse_of_least_variance(strips, models):
    """P N⁺ Pᵀ with P = 1 - G (Gᵀ W G)⁻¹ Gᵀ W, G all vectors that N takes to zero, W the
    weights of turns and shifts of photos, zero for points."""
    first, _ = adjust_freely(strips, models)
    found = adjust_block(first.block, first.as_start).check()
    a, photos = dense_slopes(found), len(found.block.photos)
    # columns of one size: an angle, or a shift over the distance
    unit = np.full(a.shape[1], distance_of(found))
    unit[: 6 * photos].reshape(photos, 6)[:, :3] = 1.0
    values, vectors = np.linalg.eigh((a * unit).T @ (a * unit))
    assert values[6] < 1e-6 * values[7]
    g, rest = vectors[:, :7], vectors[:, 7:]
    pseudo = rest / values[7:] @ rest.T
    weighted = g.T * (np.arange(len(unit)) < 6 * photos)
    p = np.eye(len(unit)) - g @ np.linalg.solve(weighted @ g, weighted)
    q = p @ pseudo @ p.T * np.outer(unit, unit)
    own = [q[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(photos)]
    length = np.array([1.0] * 3 + [found.frame.length] * 3)
    cofactors = found.adjustment.cofactors["photo"] * np.outer(length, length)
    spread = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    both = spread[:, :, None] * spread[:, None]
    np.testing.assert_allclose(cofactors / both, own / both, atol=1e-5)
    seen = found.numbered.number >= 0
    of_points = np.sqrt(np.diagonal(q)[6 * photos :].reshape(-1, 3))
    deviations = found.sigma0 * of_points
    np.testing.assert_allclose(found.deviations[seen], deviations, rtol=1e-5)


def test_photos_stay_as_a_whole_where_they_began():
    """Neither their centres nor their turns shift, turn or scale as a whole."""
    found, start = adjust_freely(2, 4)
    moved = found.centres - start.centres
    about = start.centres - start.centres.mean(axis=0)
    largest = np.max(np.abs(moved))
    assert largest > 0.01
    np.testing.assert_allclose(moved.sum(axis=0), 0, atol=1e-7 * largest)
    assert abs(np.sum(about * moved)) < 1e-7 * np.sum(np.abs(about * moved))
    quaternions = start.quaternions, np.asarray(found.stations.quaternion)
    before, after = (rotations_of(each) for each in quaternions)
    m = np.swapaxes(before, 1, 2) @ after
    of = lambda i, j: (m[:, i, j] - m[:, j, i]) / 2
    turned = np.stack([of(1, 2), of(2, 0), of(0, 1)], axis=1)
    assert np.max(np.abs(turned)) > 1e-6
    distance = distance_of(found)
    whole = np.cross(about, moved) + distance**2 * turned
    assert np.all(np.abs(whole.sum(axis=0)) < 1e-5 * np.abs(whole).sum())


def test_no_datum_changes_what_the_network_says_of_itself():
    """From two starts, one turned, shifted, of another scale and rough: residuals,
    sigma0, redundancy, and ratios of distances with their deviations."""
    from scipy.spatial.transform import Rotation

    found, start = adjust_freely(2, 4)
    rng = np.random.default_rng(2)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    noise = lambda a, size: a + rng.normal(0, size, a.shape)
    away = lambda a: 100 + 1.7 * turn.apply(a)
    x, y, z, w = start.quaternions[:, [1, 2, 3, 0]].T
    turned = Rotation.from_quat(np.stack([x, y, z, w], axis=1)) * turn.inv()
    rough = turned * Rotation.from_rotvec(rng.normal(0, 0.003, (len(x), 3)))
    x, y, z, w = rough.as_quat().T
    other = start._replace(
        quaternions=np.stack([w, x, y, z], axis=1),
        centres=noise(away(start.centres), 5.0),
        points=away(start.points),
    )
    second = adjust_block(found.block, other).check()
    np.testing.assert_allclose(second.sigma0, found.sigma0, rtol=1e-8)
    np.testing.assert_allclose(second.residuals, found.residuals, atol=1e-8)
    np.testing.assert_allclose(second.redundancy, found.redundancy, atol=1e-6)
    names = found.block.points[5:25:5]
    for a, b, c, d in (names, names[::-1]):
        one, two = (
            [block.difference(each, *pair) for pair in ((a, b), (c, d), (b, c))]
            for each in (found, second)
        )
        ratio = lambda three: three[0].distance / three[1].distance
        np.testing.assert_allclose(ratio(two), ratio(one), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_a_short_strip_with_wrong_ties_comes_to_rest(seed):
    """Four models, from their pairs, without anything known of the ground: centres
    alone do not see such a strip roll."""
    mock = block.mock_block(seed, block.Flight(models=4))
    measured, bad = with_wrong_rays(mock, seed, 0.2)
    oriented = orient_block(*block.pairs_of(measured, seed))
    found = oriented.adjusted.check()
    assert found.adjustment.result == RESULTS.successful and oriented.wrong.settled
    assert found.adjustment.iterations < 6 and 0.8 < found.sigma0 < 1.25
    assert not np.any(find_rays(found.block, measured, bad) & found.numbered.rays)


@pytest.mark.parametrize("names", [None, 5])
def test_a_datum_of_points_has_the_cofactors_of_the_pseudo_inverse(names):
    """P N⁺ Pᵀ with the weights of the datum points alone; what lies between photos and
    points stays what it was."""
    first, _ = adjust_freely(1, 4)
    begin = adjust_block(first.block, first.as_start).check()
    seen = np.flatnonzero(begin.numbered.number >= 0)
    some = None if names is None else [begin.block.points[k] for k in seen[::names]]
    found = block.refer_to_points(begin, some)
    a, photos = dense_slopes(found), len(found.block.photos)
    unit = np.full(a.shape[1], distance_of(found))
    unit[: 6 * photos].reshape(photos, 6)[:, :3] = 1.0
    values, vectors = np.linalg.eigh((a * unit).T @ (a * unit))
    g, rest = vectors[:, :7], vectors[:, 7:]
    pseudo = rest / values[7:] @ rest.T
    weight = np.zeros((len(seen), 3))
    weight[:: names or 1] = 1.0
    weighted = g.T * np.concatenate([np.zeros(6 * photos), weight.ravel()])
    p = np.eye(len(unit)) - g @ np.linalg.solve(weighted @ g, weighted)
    q = p @ pseudo @ p.T * np.outer(unit, unit)
    of_points = np.sqrt(np.diagonal(q)[6 * photos :].reshape(-1, 3))
    np.testing.assert_allclose(
        found.deviations[seen], found.sigma0 * of_points, rtol=1e-5
    )
    centres = np.sqrt(np.diagonal(q)[: 6 * photos].reshape(photos, 6)[:, 3:])
    np.testing.assert_allclose(
        found.centre_deviations, found.sigma0 * centres, rtol=1e-5
    )
    names = [found.block.points[k] for k in seen[[1, 9]]]
    covariance = block.joint_covariance(found, points=names)
    rows = 6 * photos + 3 * np.array([[1], [9]]) + np.arange(3)[None]
    both = found.sigma0**2 * q[np.ix_(rows.ravel(), rows.ravel())]
    np.testing.assert_allclose(covariance, both, atol=1e-5 * np.max(np.abs(both)))
    one, two = (
        block.relative_covariance(each, "1-1", "1-2") for each in (begin, found)
    )
    np.testing.assert_allclose(
        one.covariance[:3, :3], two.covariance[:3, :3], rtol=1e-4, atol=1e-12
    )
    # an error of a place moves its point by Q Aᵀ, on this datum
    moved = block.assess_block(found).rays.point
    checked = np.all(found.redundancy > 0.1, axis=1)
    ray = np.flatnonzero(checked)[7]
    k = 2 * np.sum(found.numbered.rays[:ray])
    point = found.numbered.number[found.block.point[ray]]
    by_error = q[6 * photos + 3 * point :][:3] @ a.T[:, k : k + 2]
    r = found.redundancy[ray]
    delta = block.assess_block(found).delta0 * found.sigma0 / np.sqrt(r)
    np.testing.assert_allclose(
        np.abs(moved[ray]), np.abs(by_error.T) * delta[:, None], rtol=1e-3
    )


def test_a_datum_of_points_that_is_none():
    mock = block.mock_block(1, block.Flight(models=3))
    start = start_from(mock.block, mock.photos)
    held = adjust_block(mock.block, start, mock.ground)
    with pytest.raises(ValueError, match="known points hold the network"):
        block.refer_to_points(held)
    free = adjust_block(mock.block, start)
    with pytest.raises(ValueError, match="'strange' is not in the adjustment"):
        block.refer_to_points(free, ["strange"])
    with pytest.raises(ValueError, match="on no line"):
        block.refer_to_points(free, free.block.points[:2])


@pytest.mark.slow
def test_distances_do_not_know_the_datum():
    """With a scale by bars and an unknown focal length: distances and their deviations,
    and the camera, are the same on a datum of points."""
    mock = block.mock_block(2, block.Flight(models=5))
    often = np.flatnonzero(np.bincount(mock.block.point) >= 3)
    one, other, third = (mock.block.points[k] for k in often[[0, -1, 9]])
    length = np.linalg.norm(mock.points[often[0]] - mock.points[often[-1]])
    bars = block.bars([one], [other], np.array([length]), 0.02)
    start = start_from(mock.block, mock.photos)
    inner = block.Inner(principal=False)
    found = adjust_block(mock.block, start, None, inner, bars=bars).check()
    referred = block.refer_to_points(found)
    for a, b in ((one, other), (one, third)):
        before, after = (block.difference(each, a, b) for each in (found, referred))
        assert after.distance == before.distance
        assert after.distance_deviation == pytest.approx(before.distance_deviation)
    np.testing.assert_allclose(
        referred.cameras.deviations, found.cameras.deviations, rtol=1e-6
    )
    worse = np.nanmean(found.deviations**2) / np.nanmean(referred.deviations**2)
    assert worse > 1
