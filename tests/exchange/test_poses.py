"""Poses in the conventions of other programs: rays that meet, COLMAP and OpenCV
themselves, photos of a block."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import block, exchange
from jaxro.block.adjust import adjust_block
from jaxro.block.adjust_chained import start_from
from jaxro.geometry import mock_pairs

FOCAL = 70.0
SYSTEMS = (
    jaxro.RelativePose,
    jaxro.IndependentElements,
    jaxro.DependentElements,
)


def elements_of(system):
    """Photos that are turned by some degrees, base 1.5 long where the system has one."""
    dependent = jaxro.DependentElements(*jnp.array([0.1, -0.2, 0.04, -0.03, 0.5, 1.4]))
    return jaxro.convert(dependent, system, jnp.array(1.4))


@pytest.fixture(scope="module")
def measured():
    """A pair without errors, and its points in the axes of the left camera."""
    truth = elements_of(jaxro.RelativePose)
    layout = mock_pairs.row_layout()
    heights = mock_pairs.relief(jax.random.key(3), layout, 9.0)
    return mock_pairs.mock_pair(
        layout, truth, focal=FOCAL, base=FOCAL, y_range=FOCAL, heights=heights
    )


@pytest.mark.parametrize("system", SYSTEMS)
def test_both_cameras_see_the_points(system, measured):
    """Points intersected by opencv, with the matrices of the two cameras, project to
    the measured places; so do those that are intersected here."""
    cv2 = pytest.importorskip("cv2")
    second = np.asarray(exchange.cam_from_world(elements_of(system), 1.7))
    first = np.eye(3, 4)
    one, other = (
        np.stack([np.asarray(x), -np.asarray(y)]) / FOCAL
        for x, y in (
            (measured.x_left, measured.y_left),
            (measured.x_right, measured.y_right),
        )
    )
    points = cv2.triangulatePoints(first, second, one, other)
    points = points / points[3]
    assert np.all(points[2] > 0) and np.all((second @ points)[2] > 0)
    for camera, place in ((first, one), (second, other)):
        seen = camera @ points
        np.testing.assert_allclose(seen[:2] / seen[2], place, atol=1e-7)
    rotation, base = second[:, :3], -second[:, :3].T @ second[:, 3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.linalg.norm(base) == pytest.approx(1.7)


def test_it_is_what_colmap_estimates(measured):
    """COLMAP's two-view geometry of the same rays has this pose."""
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=4000, height=4000, params=[1000.0, 2000, 2000]
    )
    pixels = lambda x, y: 2000 + 1000 / FOCAL * np.stack([x, -y], axis=1)
    one = pixels(np.asarray(measured.x_left), np.asarray(measured.y_left))
    other = pixels(np.asarray(measured.x_right), np.asarray(measured.y_right))
    matches = np.repeat(np.arange(len(one), dtype=np.uint32)[:, None], 2, axis=1)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        camera, one, camera, other, matches, options
    )
    found = geometry.cam2_from_cam1.matrix()
    found[:, 3] /= np.linalg.norm(found[:, 3])
    own = exchange.cam_from_world(jaxro.orient(measured))
    np.testing.assert_allclose(own, found, atol=1e-6)


def test_batches_and_rotations():
    """Of a batch what each pair has; R as the elements have it, of unit determinant."""
    pose = elements_of(jaxro.RelativePose)
    longer = jax.tree.map(lambda a: 1.3 * a, pose)
    turned = jaxro.RelativePose(*jnp.array([0.9, 0.1, -0.2, 0.3, 0.6, 0.0, 0.8]))
    both = jax.tree.map(lambda *a: jnp.stack(a), longer, turned)
    lengths = np.array([2.0, 3.0])
    own = exchange.cam_from_world(both, lengths)
    for k, one in enumerate((pose, turned)):
        np.testing.assert_allclose(
            own[k], exchange.cam_from_world(one, lengths[k]), atol=1e-15
        )
    nested = jax.tree.map(lambda a: a[None], both)
    assert exchange.cam_from_world(nested).shape == (1, 2, 3, 4)
    rotation = np.asarray(exchange.rotation_matrix(both))
    relative = jaxro.to_pose(turned).relative()[0]
    np.testing.assert_allclose(rotation[1], np.array(relative), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_photos_of_a_block_see_their_points():
    mock = block.mock_block(1, block.Flight(models=3))
    found = adjust_block(mock.block, start_from(mock.block, mock.photos), mock.ground)
    cameras = exchange.cam_from_world(found)
    assert cameras.shape == (4, 3, 4)
    measured = mock.block
    points = found.coordinates[measured.point]
    seen = np.einsum("rij,rj->ri", cameras[measured.photo, :, :3], points)
    seen += cameras[measured.photo, :, 3]
    place = measured.focal[measured.photo, None] * seen[:, :2] / seen[:, 2:]
    off = place * np.array([1.0, -1.0]) - np.stack([measured.x, measured.y], axis=1)
    np.testing.assert_allclose(off, found.misfits, atol=1e-9)
