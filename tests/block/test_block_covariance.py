"""Covariances and derivatives of what is asked for: a dense inverse in NumPy, laws, and
adjustments of changed measurements."""

from dataclasses import replace

import numpy as np
import pytest
from oracles_block import dense_cofactor

from jaxro import block
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.covariance import difference, joint_covariance, relative_covariance
from jaxro.block.sensitivity import differentiate

POINTS = ("c1", "t9", "t20")


@pytest.fixture(scope="module")
def strip():
    mock = block.mock_block(1, block.Flight(models=3))
    start = start_from(mock.block, mock.photos)
    return adjust_block(mock.block, start, mock.ground)


def rough(strips, models):
    """A block with a tenth of the places some standard deviations wrong, so that its
    residuals count; and its start."""
    mock = block.mock_block(1, block.Flight(strips=strips, models=models))
    rng, measured = np.random.default_rng(0), mock.block
    size = np.where(rng.random(len(measured.x)) < 0.1, 0.03, 0.0)
    moved = lambda a: a + size * rng.normal(size=len(a))
    measured = measured._replace(x=moved(measured.x), y=moved(measured.y))
    return measured, start_from(measured, mock.photos), mock.ground


def rotation(found, photo):
    """M, from the angles that are reported."""
    c, s = np.cos(found.angles[photo]), np.sin(found.angles[photo])
    r1 = np.array([[1, 0, 0], [0, c[0], s[0]], [0, -s[0], c[0]]])
    r2 = np.array([[c[1], 0, -s[1]], [0, 1, 0], [s[1], 0, c[1]]])
    r3 = np.array([[c[2], s[2], 0], [-s[2], c[2], 0], [0, 0, 1]])
    return r3 @ r2 @ r1


def unlike(own, other):
    """The largest difference of two covariances, in products of deviations."""
    deviations = np.sqrt(np.diagonal(other))
    return np.max(np.abs(own - other) / np.outer(deviations, deviations))


def test_it_is_the_dense_inverse(strip):
    """Photos and points, all angles about the axes of their photos: what is left of a
    small turn in the oracle's axes."""
    names = strip.block.photos[1:]
    own = joint_covariance(strip, names, POINTS)
    dense = strip.sigma0**2 * dense_cofactor(strip)
    photos = len(strip.block.photos)
    number = [strip.numbered.number[strip.block.points.index(p)] for p in POINTS]
    rows = np.concatenate(
        [np.arange(6, 6 * photos), *(6 * photos + 3 * k + np.arange(3) for k in number)]
    )
    expected = dense[np.ix_(rows, rows)]
    # angles from small turns of the camera's axes, by differences
    slope = np.eye(len(rows))
    camera = np.diag([1.0, -1.0, -1.0])
    for k in range(len(names)):
        m = rotation(strip, k + 1)

        def angles(turn, m=m):
            turned = camera @ (np.eye(3) + skew(turn)) @ camera @ m
            phi = np.arcsin(turned[2, 0] / np.linalg.norm(turned[2]))
            omega = np.arctan2(-turned[2, 1], turned[2, 2])
            kappa = np.arctan2(-turned[1, 0], turned[0, 0])
            return np.array([omega, phi, kappa])

        step = 1e-6
        own_slope = [(angles(step * e) - angles(-step * e)) / 2e-6 for e in np.eye(3)]
        slope[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = np.array(own_slope).T
    assert unlike(own, slope @ expected @ slope.T) < 1e-6


def skew(w):
    """w×."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def test_the_parts_are_those_of_the_adjustment(strip):
    """Also in a free network."""
    measured, start, _ = rough(2, 4)
    for found in (strip, adjust_block(measured, start)):
        own = joint_covariance(found, found.block.photos, ("t12", "t13"))
        assert unlike(own[6:12, 6:12], found.photo_covariances[1]) < 1e-9
        point = found.block.points.index("t13")
        assert unlike(own[-3:, -3:], found.point_covariances[point]) < 1e-9
        assert np.min(np.linalg.eigvalsh(own / np.trace(own))) > -1e-12


def test_a_relative_pose_follows_from_the_angles_and_centres(strip):
    """Pose and covariance by differences of the reported angles and centres."""
    names = strip.block.photos[1], strip.block.photos[3]
    pose = relative_covariance(strip, *names)
    first, second = rotation(strip, 1), rotation(strip, 3)
    np.testing.assert_allclose(pose.rotation, first @ second.T, atol=1e-12)
    base = first @ (strip.centres[3] - strip.centres[1])
    np.testing.assert_allclose(pose.base, base, rtol=1e-12)
    q = joint_covariance(strip, names)

    def values(step):
        adjustment = replace_angles(strip, step)
        turned = adjustment[0] @ adjustment[1].T @ pose.rotation.T
        w = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
        return np.concatenate([w, adjustment[0] @ adjustment[2]])

    size = np.tile([1e-6] * 3 + [1e-3] * 3, 2)
    steps = np.diag(size)
    slope = [
        (values(s) - values(-s)) / (2 * d) for s, d in zip(steps, size, strict=True)
    ]
    slope = np.array(slope).T
    assert unlike(pose.covariance, slope @ q @ slope.T) < 1e-6


def replace_angles(found, step):
    """M of photos 1 and 3 and the vector between them, displaced."""

    class Moved:
        angles = found.angles.copy()

    Moved.angles[1] += step[:3]
    Moved.angles[3] += step[6:9]
    apart = found.centres[3] + step[9:] - found.centres[1] - step[3:6]
    return rotation(Moved, 1), rotation(Moved, 3), apart


def test_no_datum_changes_what_lies_between_photos():
    """Of two free networks from different starts: the rotation, and the direction of
    the base."""
    measured, start, _ = rough(2, 4)
    rng = np.random.default_rng(1)
    other = start._replace(centres=start.centres + rng.normal(0, 60, (10, 3)))
    found = [adjust_block(measured, begin) for begin in (start, other)]
    names = measured.photos[0], measured.photos[6]
    one, two = (relative_covariance(each.check(), *names) for each in found)
    np.testing.assert_allclose(one.rotation, two.rotation, atol=1e-9)
    assert unlike(one.covariance[:3, :3], two.covariance[:3, :3]) < 1e-5
    across = [
        np.eye(3) - np.outer(p.base, p.base) / (p.base @ p.base) for p in (one, two)
    ]
    of = lambda p, a: a @ p.covariance[3:, 3:] @ a.T / (p.base @ p.base)
    expected = of(two, across[1])
    np.testing.assert_allclose(
        of(one, across[0]), expected, atol=1e-5 * np.max(np.abs(expected))
    )


def test_a_difference_of_points(strip):
    apart = difference(strip, "t9", "t20")
    q = joint_covariance(strip, points=("t9", "t20"))
    expected = q[2, 2] + q[5, 5] - 2 * q[2, 5]
    np.testing.assert_allclose(apart.height_deviation, np.sqrt(expected), rtol=1e-9)
    along = np.concatenate([-apart.vector, apart.vector]) / apart.distance
    expected = np.sqrt(along @ q @ along)
    np.testing.assert_allclose(apart.distance_deviation, expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("free", [False, True])
def test_derivatives_are_those_of_the_finished_adjustment(free):
    """By adjusting changed measurements anew; first-order influences would be wrong by
    more than the tolerance."""
    measured, start, known = rough(2, 4)
    ground = None if free else known
    found = adjust_block(measured, start, ground).check()
    photo, point = 1, measured.points.index("t9")
    slopes = differentiate(found, (measured.photos[photo],), ("t9",))
    values = lambda f: np.concatenate(
        [f.angles[photo], f.centres[photo], f.coordinates[point]]
    )
    rays = np.flatnonzero(measured.point == point)[:2]
    for ray, axis in ((rays[0], "x"), (rays[1], "y"), (7, "y")):

        def changed(by, ray=ray, axis=axis):
            places = getattr(measured, axis).copy()
            places[ray] += by
            return adjust_block(measured._replace(**{axis: places}), start, ground)

        expected = (values(changed(0.01)) - values(changed(-0.01))) / 0.02
        own = slopes.rays[:, ray, "xy".index(axis)]
        np.testing.assert_allclose(
            own, expected, rtol=1e-5, atol=1e-6 * np.abs(own).max()
        )
    if free:
        return

    def moved(by):
        at = known.coordinates.copy()
        at[1, 2] += by
        return adjust_block(measured, start, known._replace(coordinates=at))

    expected = (values(moved(0.05)) - values(moved(-0.05))) / 0.1
    own = slopes.control[:, 1, 2]
    np.testing.assert_allclose(own, expected, rtol=1e-5, atol=1e-6 * np.abs(own).max())


@pytest.mark.parametrize(
    ("inner", "size"), [(None, 1.0), (block.Inner(principal=False), 0.05)]
)
def test_derivatives_give_the_covariance(inner, size):
    """Of measurements without large residuals: Σ (dx/dl)² σ² is the cofactor matrix, to
    the second-order term of the residuals, which a focal length that is hardly
    determined makes large."""
    flight = block.Flight(models=3)
    flight = flight._replace(sigma=size * flight.sigma)
    mock = block.mock_block(1, flight, control_sigma=size * 0.02)
    start = start_from(mock.block, mock.photos)
    found = adjust_block(mock.block, start, mock.ground, inner)
    names = mock.block.photos[:1]
    slopes = differentiate(found, names, POINTS)
    rays = slopes.rays * mock.block.sigma[:, None]
    control = slopes.control * mock.ground.sigma
    q = np.einsum("arx,brx->ab", rays, rays)
    q = q + np.einsum("akx,bkx->ab", control, control)
    expected = joint_covariance(found, names, POINTS) / found.sigma0**2
    assert 1e-9 < unlike(q, expected) < 1e-3


def test_names_that_are_not_there_are_refused(strip):
    with pytest.raises(ValueError, match="has no photo 'nowhere'"):
        joint_covariance(strip, ("nowhere",))
    with pytest.raises(ValueError, match="two points are needed"):
        difference(strip, "t9", "t9")
    hidden = strip.numbered.number.copy()
    hidden[strip.block.points.index("t9")] = -1
    without = replace(strip, numbered=strip.numbered._replace(number=hidden))
    with pytest.raises(ValueError, match="'t9' is not in the adjustment"):
        joint_covariance(without, points=("t9",))
