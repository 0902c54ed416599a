"""Covariances of poses: the programs' own retractions, propagation and readers, laws,
and adjustments of many measurements."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import block, exchange
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.exchange import tangents
from jaxro.geometry import mock_pairs

SYSTEMS = (jaxro.RelativePose, jaxro.DependentElements)
ALL = (
    tangents.gtsam,
    tangents.left,
    tangents.colmap,
    tangents.g2o,
    tangents.g2o_angles,
)
SIGNS = np.array([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def measured():
    truth = jaxro.DependentElements(*jnp.array([0.1, -0.2, 0.04, -0.03, 0.5, 1.4]))
    layout = mock_pairs.standard_layout(16)
    heights = mock_pairs.relief(jax.random.key(3), layout, 9.0)
    flat = mock_pairs.mock_pair(
        layout, truth, focal=70.0, base=70.0, y_range=70.0, heights=heights
    )
    return mock_pairs.noisy(flat, jax.random.key(0), 0.01)


@pytest.fixture(scope="module")
def oriented(measured):
    return {k: jaxro.orient(measured, elements=k, base=70.0) for k in SYSTEMS}


@pytest.fixture(scope="module")
def strip():
    mock = block.mock_block(1, block.Flight(models=3))
    start = start_from(mock.block, mock.photos)
    return adjust_block(mock.block, start, mock.ground)


def unlike(own, other):
    """The largest difference of two covariances, in products of deviations."""
    deviations = np.sqrt(np.diagonal(other))
    return np.max(np.abs(own - other) / np.outer(deviations, deviations))


def pose_of(orientation, length):
    """Rotation and translation of the right camera in the left one's axes, in plain
    NumPy."""
    camera = np.asarray(exchange.cam_from_world(orientation, length))
    return camera[:, :3].T, -camera[:, :3].T @ camera[:, 3]


def random_pose(rng, small=1.0):
    """A pose near the identity, or any."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(small * rng.uniform(-1.5, 1.5, 3)).as_matrix()
    return tangents.CameraPose(jnp.array(turn), jnp.array(small * rng.normal(size=3)))


@pytest.mark.parametrize("small", [1.0, 1e-2, 1e-5, 0.0])
def test_tangents_are_those_of_gtsam(small):
    """The logarithm, and both of its sides, of poses far and near."""
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(1)
    at, moved = random_pose(rng), random_pose(rng, small)
    as_gtsam = lambda p: gtsam.Pose3(gtsam.Rot3(np.asarray(p.rotation)), p.translation)
    a, d = as_gtsam(at), as_gtsam(moved)
    local = gtsam.Pose3.Logmap(d)
    near = {"rtol": 1e-9, "atol": 1e-13}
    np.testing.assert_allclose(a.localCoordinates(a.compose(d)), local, atol=1e-9)
    np.testing.assert_allclose(tangents.logarithm(moved), local, **near)
    own = tangents.gtsam(at, at.then(moved))
    np.testing.assert_allclose(own, local, atol=1e-12)
    np.testing.assert_allclose(tangents.left(at, moved.then(at)), local, atol=1e-12)
    moved_in_camera = moved.then(at.inverse).inverse
    np.testing.assert_allclose(tangents.colmap(at, moved_in_camera), local, atol=1e-12)
    angles, half = (
        tangents.g2o_angles(at, at.then(moved)),
        tangents.g2o(at, at.then(moved)),
    )
    np.testing.assert_allclose(angles[3:], local[:3], atol=1e-12)
    np.testing.assert_allclose(angles[:3], d.translation(), atol=1e-12)
    quaternion = d.rotation().toQuaternion()
    vector = np.array([quaternion.x(), quaternion.y(), quaternion.z()])
    np.testing.assert_allclose(half[3:], np.sign(quaternion.w()) * vector, atol=1e-12)


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("tangent", ALL)
def test_every_system_has_one_covariance(oriented, system, tangent):
    """The five elements of any system give the same six by six numbers; of a base with
    a known length they have rank 5."""
    rest = {"length": 70.0, "tangent": tangent}
    own = exchange.pose_covariance(oriented[system], length_deviation=0.1, **rest)
    other = exchange.pose_covariance(
        oriented[jaxro.RelativePose], length_deviation=0.1, **rest
    )
    assert unlike(own, other) < 1e-6
    known = exchange.pose_covariance(oriented[system], **rest)
    deviations = np.sqrt(np.diagonal(own))
    values = np.linalg.eigvalsh(known / np.outer(deviations, deviations))
    assert abs(values[0]) < 1e-12 * values[-1] < 1e-6 * values[1]
    longer = exchange.pose_covariance(
        oriented[system], sigma0=2.0, length=70.0, tangent=tangent
    )
    sigma0 = float(oriented[system].sigma0)
    np.testing.assert_allclose(longer, known * (2 / sigma0) ** 2, rtol=1e-9)


@pytest.mark.parametrize("tangent", ALL)
def test_information_is_the_inverse(oriented, tangent):
    """With a length of known deviation the inverse; without any the pseudo-inverse of
    the covariance of a known length, which has nothing along the base."""
    found, rest = oriented[jaxro.RelativePose], {"length": 3.0, "tangent": tangent}
    covariance = exchange.pose_covariance(found, length_deviation=0.01, **rest)
    information = exchange.pose_information(found, length_deviation=0.01, **rest)
    unit = np.sqrt(np.outer(np.diagonal(covariance), np.diagonal(covariance)))
    np.testing.assert_allclose(
        (information * unit) @ (covariance / unit), np.eye(6), atol=1e-8
    )
    unknown = exchange.pose_information(found, **rest)
    known = exchange.pose_covariance(found, **rest)
    pseudo = np.linalg.pinv(known, rcond=1e-10, hermitian=True)
    np.testing.assert_allclose(unknown, pseudo, atol=1e-6 * np.max(pseudo))
    rotation, base = pose_of(found, 3.0)
    side = {
        tangents.gtsam: (3, rotation.T @ base),
        tangents.left: (3, base),
        tangents.colmap: (3, rotation.T @ base),
        tangents.g2o: (0, rotation.T @ base),
        tangents.g2o_angles: (0, rotation.T @ base),
    }
    first, along = side[tangent]
    direction = np.zeros(6)
    direction[first : first + 3] = along / 3
    assert direction @ unknown @ direction < 1e-12 * np.max(np.diagonal(unknown))


def parameters_of(pose, rotation, base):
    """The five parameters from a pose to rotations and bases near it, in plain NumPy:
    twice the vector part of a quaternion over its first, and stereographic ones."""
    from scipy.spatial.transform import Rotation

    b = np.array([float(a) for a in (pose.bx, pose.by, pose.bz)])
    turn = Rotation.from_quat([float(a) for a in (pose.qx, pose.qy, pose.qz, pose.qw)])
    x, y, z, w = (turn.inv() * Rotation.from_matrix(rotation)).as_quat().T
    sign = np.where(b[2] < 0, -1.0, 1.0)
    a = -1 / (sign + b[2])
    c = b[0] * b[1] * a
    first = np.array([1 + sign * b[0] ** 2 * a, sign * c, -sign * b[0]])
    second = np.array([c, sign + b[1] ** 2 * a, -b[1]])
    unit = base / np.linalg.norm(base, axis=1, keepdims=True)
    scale = 2 / (1 + unit @ b)
    turns = 2 * np.stack([x, y, z], axis=1) / w[:, None]
    return np.column_stack([turns, scale * (unit @ first), scale * (unit @ second)])


def random_steps(covariance, count, seed):
    """Of a covariance that may lack rank."""
    rng = np.random.default_rng(seed)
    unit = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return rng.normal(size=(count, 6)) @ root.T * unit


@pytest.mark.parametrize("program", ["gtsam", "g2o", "colmap"])
def test_samples_of_the_programs_have_the_five_parameters(oriented, program):
    """Poses displaced by the program's own retraction (g2o: by its documented formula)
    scatter like the five parameters and the length of which the covariance is made."""
    from scipy.spatial.transform import Rotation

    found, length, count = oriented[jaxro.RelativePose], 70.0, 20_000
    rotation, base = pose_of(found, length)
    tangent = getattr(tangents, program)
    covariance = exchange.pose_covariance(
        found, tangent, length=length, length_deviation=0.02
    )
    steps = random_steps(covariance, count, 5)
    if program == "g2o":
        x = steps[:, 3:]
        w = np.sqrt(1 - np.sum(x**2, axis=1))
        turn = Rotation.from_quat(np.column_stack([x, w])).as_matrix()
        turns, bases = rotation @ turn, base + steps[:, :3] @ rotation.T
    elif program == "gtsam":
        gtsam = pytest.importorskip("gtsam")
        at = gtsam.Pose3(gtsam.Rot3(rotation), base)
        moved = [at.retract(xi).matrix() for xi in steps]
        turns, bases = (
            np.array([m[:3, part] for m in moved]) for part in (slice(3), 3)
        )
    else:
        pycolmap = pytest.importorskip("pycolmap")
        gtsam = pytest.importorskip("gtsam")
        at = pycolmap.Rigid3d(np.asarray(exchange.cam_from_world(found, length)))
        exp = [pycolmap.Rigid3d(gtsam.Pose3.Expmap(xi).matrix()[:3]) for xi in steps]
        moved = [(e * at).inverse().matrix() for e in exp]
        turns, bases = (np.array([m[:, part] for m in moved]) for part in (slice(3), 3))
    # back to photo axes
    turns = SIGNS[:, None] * turns * SIGNS
    own = parameters_of(found.pose, turns, bases * SIGNS)
    sampled = np.cov(own.T)
    assert unlike(sampled, np.asarray(found.covariance)) < 5 * np.sqrt(2 / count)
    spread = np.std(np.linalg.norm(bases, axis=1))
    assert spread == pytest.approx(0.02, rel=5 / np.sqrt(2 * count))


def test_colmap_propagates_the_same(oriented, strip):
    """COLMAP turns the covariance of a pose into that of its inverse, and of two poses
    into that of the relative one, as its left tangent has them here."""
    pycolmap = pytest.importorskip("pycolmap")
    found, length = oriented[jaxro.RelativePose], 5.0
    camera = pycolmap.Rigid3d(np.asarray(exchange.cam_from_world(found, length)))
    rest = {"length": length, "length_deviation": 0.01}
    own = exchange.pose_covariance(found, tangents.colmap, **rest)
    back = pycolmap.get_covariance_for_inverse(camera, own)
    expected = exchange.pose_covariance(found, tangents.left, **rest)
    np.testing.assert_allclose(back, expected, rtol=1e-9, atol=1e-12 * back.max())

    names = strip.block.photos[1:3]
    cameras = exchange.cam_from_world(strip)[1:3]
    one, other = (pycolmap.Rigid3d(c) for c in cameras)
    joint = joint_in_cameras(strip, names)
    relative = pycolmap.get_covariance_for_relative_rigid3d(one, other, joint)
    pose, own = exchange.relative_photo_covariance(strip, *names, tangents.colmap)
    assert unlike(own, relative) < 1e-5
    np.testing.assert_allclose(
        (other * one.inverse()).inverse().matrix(), np.column_stack(pose), atol=1e-6
    )
    photos = exchange.photo_covariances(strip, tangents.colmap)
    for k in range(2):
        part = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert unlike(photos[k + 1], part) < 1e-5


def joint_in_cameras(adjusted, names):
    """The joint covariance of two photos in COLMAP's tangent, from that of angles and
    centres by differences, in plain NumPy."""
    from scipy.spatial.transform import Rotation

    numbers = [adjusted.block.photos.index(name) for name in names]
    joint = block.joint_covariance(adjusted, names)

    def camera(values):
        omega, phi, kappa = values[:3]
        object_to_photo = Rotation.from_euler("xyz", [-omega, -phi, -kappa])
        rotation = SIGNS[:, None] * object_to_photo.as_matrix()
        return rotation, -rotation @ values[3:]

    slope = np.zeros((12, 12))
    for k, number in enumerate(numbers):
        at = np.concatenate([adjusted.angles[number], adjusted.centres[number]])
        rotation, along = camera(at)
        np.testing.assert_allclose(
            rotation, exchange.cam_from_world(adjusted)[number, :, :3], atol=1e-9
        )
        for j in range(6):
            step = np.zeros(6)
            step[j] = 1e-5 if j < 3 else 1e-2
            ends = []
            for sign in (1, -1):
                turned, moved = camera(at + sign * step)
                turn = Rotation.from_matrix(turned @ rotation.T).as_rotvec()
                # Exp(ξ) T: to first order t' = t + w × t + v
                ends.append(
                    np.concatenate([turn, moved - along - np.cross(turn, along)])
                )
            own = (ends[0] - ends[1]) / (2 * step[j])
            slope[6 * k : 6 * k + 6, 6 * k + j] = own
    return slope @ joint @ slope.T


def test_gtsam_propagates_the_same(strip):
    """The relative covariance of two photos is that of GTSAM's own derivatives of
    `between`, by the joint covariance."""
    gtsam = pytest.importorskip("gtsam")
    names = strip.block.photos[1:3]
    joint = joint_in_cameras(strip, names)
    cameras = exchange.cam_from_world(strip)[1:3]
    poses = [gtsam.Pose3(np.vstack([c, [0, 0, 0, 1]])).inverse() for c in cameras]
    # left tangent of the inverse: Exp(ξ) T⁻¹ is (T Exp(-ξ))⁻¹
    first, second = (np.zeros((6, 6), order="F") for _ in range(2))
    poses[0].between(poses[1], first, second)
    slope = np.hstack([first, second])
    pose, own = exchange.relative_photo_covariance(strip, *names, tangents.gtsam)
    assert unlike(own, slope @ joint @ slope.T) < 1e-5
    np.testing.assert_allclose(
        poses[0].between(poses[1]).matrix()[:3], np.column_stack(pose), atol=1e-6
    )


def test_batches_failures_and_bad_arguments(oriented):
    """A batch is what its pairs are; NaN where a pair is not usable; lengths that are
    none are refused."""
    one = oriented[jaxro.RelativePose]
    failed = replace(one, result=jaxro.RESULTS.diverged)
    found = jax.tree.map(lambda *a: jnp.stack(a), one, failed, one)
    own = exchange.pose_covariance(found, length=np.array([2.0, 1.0, 3.0]))
    for k, length in ((0, 2.0), (2, 3.0)):
        alone = exchange.pose_covariance(one, length=length)
        np.testing.assert_allclose(own[k], alone, atol=1e-12 * alone.max())
    assert np.all(np.isnan(own[1]))
    assert np.all(np.isnan(exchange.pose_information(found)[1]))
    with pytest.raises(ValueError, match="positive length"):
        exchange.pose_covariance(one, length=-1.0)
    with pytest.raises(ValueError, match="pose_information"):
        exchange.pose_covariance(one, length_deviation=np.inf)
    with pytest.raises(ValueError, match="small positive"):
        exchange.pose_information(one, length_deviation=0.0)
