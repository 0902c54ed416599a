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


def edit(old, new):
    """Text in place of another, once."""

    def changed(text):
        assert old in text
        return text.replace(old, new, 1)

    return changed


@pytest.mark.parametrize(
    ("name", "changed", "told"),
    [
        ("points3D.txt", None, "found a folder with cameras.txt, images.txt"),
        ("cameras.txt", edit("1 OPENCV", "1 LENS"), "line 2, column camera 1: found the model"),
        ("cameras.txt", edit("790.0 ", ""), "found 7 parameters of model OPENCV, which has 8"),
        ("cameras.txt", edit("812.0", "812,0"), "line 2, column PARAMS: found '812,0', a comma"),
        ("cameras.txt", edit("812.0", "nan"), "line 2, column PARAMS: found 'nan'"),
        ("cameras.txt", edit("812.0", "1e300"), "found the parameters [1e+300"),
        ("cameras.txt", edit("7 PINHOLE 640", "7 PINHOLE -640"), "line 3, column WIDTH: found"),
        ("cameras.txt", edit("7 PIN", "1 PIN"), "line 3: found camera 1 a second time"),
        ("images.txt", lambda text: "", "images.txt: found no photos"),
        ("images.txt", edit("b/second", "b/first"),
         "line 3, column NAME: found the name 'b/first.jpg' a second time (first on line 1)"),
        ("images.txt", edit("1.0 0.0", "1,0 0.0"), "a comma in a number"),
        ("images.txt", edit(" 7 a.jpg", " 8 a.jpg"), "line 5, column CAMERA: found camera 8"),
        ("images.txt", edit(" a.jpg", ""), "line 5: found a photo without a name"),
        ("images.txt", edit("11.5 12.5 -1", "11.5 12.5"), "line 2: found 92 fields"),
        ("images.txt", edit(" 100 ", " 1e2 "), "line 2, column POINT of a keypoint: found '1e2'"),
        ("points3D.txt", edit("0 0 0", "0"), ""),
        ("points3D.txt", lambda text: text.replace(".", ","), "line 1, column X: found"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told(name, changed, told, tmp_path):
    write(tmp_path)
    path = tmp_path / name
    if changed is None:
        path.unlink()
    else:
        path.write_text(changed(path.read_text()))
    if told == "":  # nothing that is needed
        assert len(exchange.read_colmap_text(tmp_path).names) == 3
        return
    with pytest.raises(TableError) as error:
        exchange.read_colmap_text(tmp_path)
    assert told in str(error.value)


def test_names_are_read_whole(tmp_path):
    """Also with blanks, which COLMAP's own reader cuts."""
    write(tmp_path)
    path = tmp_path / "images.txt"
    names = {
        NAMES[0]: "DJI 1.JPG",
        NAMES[1]: "DJI  1.JPG",
        NAMES[2]: "sub dir/1 # 2.JPG",
    }
    text = path.read_text()
    for name, new in names.items():
        text = text.replace(name, new)
    path.write_text(text)
    found = exchange.read_colmap_text(tmp_path)
    assert {*found.left, *found.right} == {*names.values()}


def test_binary_files_hold_the_same(tmp_path):
    """As pycolmap writes them, of a model that pycolmap has read."""
    write(tmp_path, hidden=(3,))
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    folder = tmp_path / "binary"
    folder.mkdir()
    model.write_binary(str(folder))
    one, other = files.read(tmp_path), files.read(folder)
    assert one.names == other.names and one.points == other.points
    np.testing.assert_array_equal(one.pairs.x_left, other.pairs.x_left)
    np.testing.assert_array_equal(one.pairs.y_right, other.pairs.y_right)


@pytest.mark.parametrize(
    ("name", "changed", "told"),
    [
        ("images", lambda content: content[:1000], "bytes for"),
        ("images", lambda content: (10**12).to_bytes(8, "little") + content[8:], "column photo 3"),
        ("images", lambda content: content + b"\0", "found 1 bytes behind the last entry"),
        ("cameras", lambda content: content[:12] + b"\x63" + content[13:], "found the model 99"),
        ("points3D", lambda content: content[:51] + b"\xff" * 8 + content[59:],
         "the track of point entry 0"),
    ],
)  # fmt: skip
def test_counts_beyond_the_file_are_told(name, changed, told, tmp_path):
    write(tmp_path)
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    folder = tmp_path / "binary"
    folder.mkdir()
    model.write_binary(str(folder))
    path = folder / f"{name}.bin"
    path.write_bytes(changed(path.read_bytes()))
    with pytest.raises(TableError, match=r"byte \d+, column") as error:
        files.read(folder)
    assert told in str(error.value)


def test_too_few_common_points_are_told(tmp_path):
    write(tmp_path)
    with pytest.raises(TableError, match="no two photos that share 31 points"):
        exchange.read_colmap_text(tmp_path, least=31)
