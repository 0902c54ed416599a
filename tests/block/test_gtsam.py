"""The rigorous adjustment beside GTSAM (Dellaert and GTSAM contributors): the same
photos, rays and control as a factor graph, minimised and inverted by that program.

GTSAM's axes of a photo are x to the right, y down, z forward; its poses turn by small
angles about these axes, and shift along them.
"""

import numpy as np
import pytest

from jaxro import block
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.block.covariance import joint_covariance

gtsam = pytest.importorskip("gtsam")

AXES = np.diag([1.0, -1.0, -1.0])
"""From x right, y down, z forward to x right, y up, z backward."""


def photo_key(number):
    return gtsam.symbol("x", int(number))


def point_key(number):
    return gtsam.symbol("p", int(number))


def graph_of(mock):
    """Projection factors of all rays, priors of all control points, and the truth as
    the start."""
    measured, known = mock.block, mock.ground
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    focal = measured.focal[0]
    camera = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    for k, (turn, centre) in enumerate(zip(*mock.photos, strict=True)):
        start.insert(photo_key(k), gtsam.Pose3(gtsam.Rot3(turn.T), centre))
    for k in np.unique(measured.point):
        start.insert(point_key(k), mock.points[k])
    for ray, sigma in enumerate(measured.sigma):
        factor = gtsam.GenericProjectionFactorCal3_S2(
            np.array([measured.x[ray], -measured.y[ray]]),
            gtsam.noiseModel.Isotropic.Sigma(2, sigma),
            photo_key(measured.photo[ray]),
            point_key(measured.point[ray]),
            camera,
        )
        graph.add(factor)
    for row, number in enumerate(known.numbers_in(measured)):
        noise = gtsam.noiseModel.Diagonal.Sigmas(known.sigma[row])
        at = known.coordinates[row]
        graph.add(gtsam.PriorFactorPoint3(point_key(number), at, noise))
    return graph, start


def minimise(graph, start):
    """Gauss-Newton steps until nothing moves."""
    parameters = gtsam.GaussNewtonParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(12)
    return gtsam.GaussNewtonOptimizer(graph, start, parameters).optimize()


def angles_of(turn):
    """omega, phi, kappa of M, object to photo."""
    omega = np.arctan2(-turn[2, 1], turn[2, 2])
    kappa = np.arctan2(-turn[1, 0], turn[0, 0])
    return np.array([omega, np.arcsin(turn[2, 0]), kappa])


def photo_of(pose):
    """omega, phi, kappa and the centre of a pose of GTSAM."""
    return np.concatenate(
        [angles_of(AXES @ pose.rotation().matrix().T), pose.translation()]
    )


def slope_of(pose):
    """The derivatives of these by the pose's own six numbers, by differences."""
    size = np.array([1e-5] * 3 + [1e-1] * 3)
    moved = lambda step: photo_of(pose.retract(step))
    return np.array([(moved(s) - moved(-s)) / (2 * max(s)) for s in np.diag(size)]).T


def compare(own, other, own_covariance, covariance):
    """Estimates and covariances of photos or points, in standard deviations."""
    deviations = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.max(np.abs(own - other) / deviations) < 1e-8
    both = deviations[:, :, None] * deviations[:, None]
    assert np.max(np.abs(own_covariance - covariance) / both) < 1e-8


@pytest.mark.parametrize(("strips", "models"), [(1, 3), (2, 4)])
def test_a_block_is_that_of_gtsam(strips, models):
    """Estimates, deviations, and the joint covariance of two neighbouring photos."""
    mock = block.mock_block(1, block.Flight(strips=strips, models=models))
    measured = mock.block
    found = adjust_block(measured, start_from(measured, mock.photos), mock.ground)
    graph, start = graph_of(mock)
    values = minimise(graph, start)
    squares = 2 * graph.error(values)
    sigma0 = np.sqrt(squares / found.degrees_of_freedom)
    np.testing.assert_allclose(found.check().sigma0, sigma0, rtol=1e-9)

    marginals = gtsam.Marginals(graph, values)
    poses = [values.atPose3(photo_key(k)) for k in range(len(measured.photos))]
    slopes = [slope_of(pose) for pose in poses]
    of_pose = [marginals.marginalCovariance(photo_key(k)) for k in range(len(poses))]
    of_photos = [j @ q @ j.T for j, q in zip(slopes, of_pose, strict=True)]
    compare(
        np.concatenate([found.angles, found.centres], axis=1),
        np.array([photo_of(pose) for pose in poses]),
        found.photo_covariances,
        sigma0**2 * np.array(of_photos),
    )
    seen = np.flatnonzero(found.numbered.number >= 0)
    of_points = [marginals.marginalCovariance(point_key(k)) for k in seen]
    compare(
        found.coordinates[seen],
        np.array([values.atPoint3(point_key(k)) for k in seen]),
        found.point_covariances[seen],
        sigma0**2 * np.array(of_points),
    )
    keys = gtsam.KeyVector([photo_key(1), photo_key(2)])
    both = marginals.jointMarginalCovariance(keys).fullMatrix()
    slope = np.zeros((12, 12))
    slope[:6, :6], slope[6:, 6:] = slopes[1:3]
    expected = sigma0**2 * slope @ both @ slope.T
    own = joint_covariance(found, measured.photos[1:3])
    zero = np.zeros((1, 12))
    compare(zero, zero, own[None], expected[None])
