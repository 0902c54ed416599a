"""COLMAP's text models: three photos of a scene with distortion, written here line by
line."""

import numpy as np
import pixel_scene as scene
import pytest
from scipy.spatial.transform import Rotation

import jaxro
from jaxro import exchange
from jaxro.block.measured_block import from_pairs
from jaxro.exchange import files
from jaxro.tables.fields import TableError
from jaxro.tables.measured import one_pair

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads the models")

OPENCV = [812.0, 790.0, 330.0, 236.0, -0.21, 0.06, 8e-4, -5e-4]
NAMES = ("b/first.jpg", "b/second.jpg", "a.jpg")
COUNT = 30


def pixels(number, world):
    if number == 2:
        return scene.pixels(scene.rays(world, 2), scene.K_RIGHT)
    uv = scene.distorted(scene.rays(world, number), (*OPENCV[4:], 0))
    matrix = np.array([[OPENCV[0], 0, OPENCV[2]], [0, OPENCV[1], OPENCV[3]], [0, 0, 1]])
    return scene.pixels(uv, matrix)


def write(folder, hidden=()):
    """The three files. A keypoint without a point stands before the others; `hidden`:
    points that the first photo does not show."""
    world = scene.points(COUNT)
    numbers = lambda values: " ".join(repr(float(v)) for v in np.ravel(values))
    right = scene.K_RIGHT
    pinhole = right[0, 0], right[1, 1], right[0, 2], right[1, 2]
    (folder / "cameras.txt").write_text(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 OPENCV 640 480 {numbers(OPENCV)}\n7 PINHOLE 640 480 {numbers(pinhole)}\n"
    )
    images, tracks = [], {k: [] for k in range(COUNT)}
    for k, name in enumerate(NAMES):
        rotation, t = scene.pose(k)
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        images.append(
            f"{k + 1} {numbers([w, x, y, z, *t])} {7 if k == 2 else 1} {name}"
        )
        keypoints = ["11.5 12.5 -1"]
        for i, place in enumerate(pixels(k, world)):
            if k == 0 and i in hidden:
                continue
            tracks[i].append(f"{k + 1} {len(keypoints)}")
            keypoints.append(f"{numbers(place)} {100 + i}")
        images.append(" ".join(keypoints))
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text(
        "".join(
            f"{100 + i} {numbers(point)} 0 0 0 0.5 {' '.join(tracks[i])}\n"
            for i, point in enumerate(world)
        )
    )


def test_pairs_of_photos_and_their_poses(tmp_path):
    write(tmp_path, hidden=(3, 4))
    found = exchange.read_colmap_text(tmp_path, sigma=0.5)
    assert found.names == (
        "a.jpg-b/first.jpg",
        "a.jpg-b/second.jpg",
        "b/first.jpg-b/second.jpg",
    )
    assert found.pairs.lengths.tolist() == [28, 30, 28]
    assert found.points[:4] == ("100", "101", "102", "105")
    assert found.sigma_known and found.pairs.roots is not None
    for k, photos in enumerate([(2, 0), (2, 1), (0, 1)]):
        oriented = jaxro.orient(one_pair(found.pairs, k))
        assert max(scene.errors(oriented, *photos)) < 1e-8


def test_points_tie_the_photos_of_a_block(tmp_path):
    """A point has one name in all pairs, and one place on a photo, so that a block sees
    each of them once."""
    write(tmp_path)
    found = files.read(tmp_path)
    with pytest.raises(ValueError, match="the points have covariances"):
        from_pairs(found.left, found.right, found.pairs, found.points)
    plain = found.pairs._replace(roots=None)
    block = from_pairs(found.left, found.right, plain, found.points)
    assert sorted(block.photos) == sorted(NAMES)
    assert len(block.points) == COUNT and len(block.x) == 3 * COUNT


def test_covariances_are_those_of_pixels_without_distortion(tmp_path):
    write(tmp_path)
    found = exchange.read_colmap_text(tmp_path, sigma=0.5)
    own = exchange.pair_from_pixels(
        pixels(0, scene.points(COUNT)),
        pixels(1, scene.points(COUNT)),
        [[OPENCV[0], 0, OPENCV[2]], [0, OPENCV[1], OPENCV[3]], [0, 0, 1]],
        sigma=0.5,
        distortion_left=OPENCV[4:],
    )
    batch = found.pairs.pad_to(np.array([2]), COUNT)
    for a, b in zip(batch.covariances, own.covariances, strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(batch.x_left[0], own.x_left, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("points3D.txt", None, "found a folder with cameras.txt, images.txt"),
        ("cameras.txt", "1 LENS 640 480 1\n", "a model that pycolmap does not read"),
        ("images.txt", "", "Image with ID 1 does not exist"),
    ],
)
def test_what_does_not_fit_is_told(name, text, told, tmp_path):
    write(tmp_path)
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text)
    with pytest.raises(TableError) as error:
        exchange.read_colmap_text(tmp_path)
    assert told in str(error.value)


def test_too_few_common_points_are_told(tmp_path):
    write(tmp_path)
    with pytest.raises(TableError, match="no two photos that share 31 points"):
        exchange.read_colmap_text(tmp_path, least=31)
