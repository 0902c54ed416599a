"""HDF5 files of pairs, written here as the field's benchmarks write them."""

import jax
import numpy as np
import pixel_scene as scene
import pytest

import jaxro
from jaxro import exchange
from jaxro.exchange import files
from jaxro.tables.fields import TableError
from jaxro.tables.measured import one_pair, to_ragged

h5py = pytest.importorskip("h5py", reason="HDF5 files need h5py")

PINHOLE = "PINHOLE", [812.0, 790.0, 330.0, 236.0]
SIMPLE = "SIMPLE_PINHOLE", [655.0, 310.0, 251.0]
OPENCV = "OPENCV", [812.0, 790.0, 330.0, 236.0, -0.21, 0.06, 8e-4, -5e-4]


def matrix_of(params):
    fx, fy, cx, cy = params[:4] if len(params) > 3 else (params[0], *params)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def seen(number, camera, count=40):
    rays = scene.rays(scene.points(count), number)
    if camera[0] == "OPENCV":
        rays = scene.distorted(rays, (*camera[1][4:], 0))
    return scene.pixels(rays, matrix_of(camera[1]))


def put_camera(group, name, camera, size=(640, 480)):
    """As posebench reads it: every entry a list."""
    own = group.create_group(name)
    own["model"] = [camera[0]]
    own["width"], own["height"] = [size[0]], [size[1]]
    own["params"] = camera[1]


def put(file, name, cameras=(PINHOLE, SIMPLE), count=40):
    group = file.create_group(name)
    for k, camera in enumerate(cameras):
        group[f"x{k + 1}"] = seen(k, camera, count)
        put_camera(group, f"camera{k + 1}", camera)
    group["R"], group["t"] = scene.pose(1)
    return group


@pytest.fixture
def path(tmp_path):
    return tmp_path / "pairs.h5"


def test_pairs_are_those_of_their_pixels(path):
    with h5py.File(path, "w") as file:
        put(file, "b"), put(file, "a", (SIMPLE, SIMPLE), 25)
    found = exchange.read_h5(path, sigma=0.5)
    assert found.names == ("a", "b")
    assert found.left == ("a:1", "b:1") and found.right == ("a:2", "b:2")
    assert found.pairs.lengths.tolist() == [25, 40]
    assert len(set(found.points)) == 65  # no point of a pair is one of another
    own = exchange.pair_from_pixels(
        seen(0, PINHOLE),
        seen(1, SIMPLE),
        matrix_of(PINHOLE[1]),
        matrix_of(SIMPLE[1]),
        sigma=0.5,
    )
    batch = found.pairs.pad_to(np.array([1]), 40)
    for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(own), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-12)
    assert max(scene.errors(jaxro.orient(one_pair(found.pairs, 1)))) < 1e-9


def test_equal_pixels_need_no_covariances(path):
    with h5py.File(path, "w") as file:
        put(file, "a", (SIMPLE, SIMPLE))
    found = exchange.read_h5(path, sigma=0.5)
    assert found.pairs.roots is None
    np.testing.assert_array_equal(found.pairs.sigma, 0.5)
    assert found.table.has_sigma and "sigma" in found.table.numbers
    assert not exchange.read_h5(path).table.has_sigma


@pytest.mark.parametrize("sigma", [None, 0.5])
def test_the_table_of_the_commands_holds_the_same(path, sigma):
    """Through the columns and cameras that `jaxro orient` reads; without a known sigma
    the deviations of the table are relative, and one that is given later is theirs."""
    with h5py.File(path, "w") as file:
        put(file, "a")
    found = exchange.read_h5(path, sigma=sigma)
    table = found.table
    assert table.has_sigma == (sigma is not None) and table.has_covariances
    cameras = found.cameras.of_all(table.names, table.file, photos=table.photos)
    again = to_ragged(table, cameras, None if sigma else 0.5)
    wanted = exchange.read_h5(path, sigma=0.5).pairs
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_one_deviation_for_each_point_where_no_more_can_be_used(path):
    with h5py.File(path, "w") as file:
        put(file, "a")
    table = exchange.read_h5(path, sigma=0.5).table.with_one_sigma()
    assert not table.has_covariances and table.has_sigma
    f = (812.0 + 790) / 2
    squares = 0.25 * np.array([(f / 812) ** 2, (f / 790) ** 2, 1, 1])
    np.testing.assert_allclose(table.numbers["sigma"], np.sqrt(np.mean(squares)))
    assert "one standard deviation, the mean" in table.warnings[-1]


def test_distortion_by_colmap(path):
    pytest.importorskip("pycolmap", reason="pycolmap has the camera models")
    with h5py.File(path, "w") as file:
        put(file, "a", (OPENCV, OPENCV))
    found = exchange.read_h5(path)
    own = exchange.pair_from_pixels(
        seen(0, OPENCV),
        seen(1, OPENCV),
        matrix_of(OPENCV[1]),
        distortion_left=OPENCV[1][4:],
    )
    batch = found.pairs.pad_to(np.array([0]), 40)
    for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(own), strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-6, atol=1e-6)


def test_matrices_in_place_of_models(path):
    with h5py.File(path, "w") as file:
        group = put(file, "a")
        for k, camera in enumerate((PINHOLE, SIMPLE), 1):
            del group[f"camera{k}"]
            group[f"camera{k}"] = matrix_of(camera[1])
    with h5py.File(path.with_name("models.h5"), "w") as file:
        put(file, "a")
    one, other = exchange.read_h5(path), files.read(path.with_name("models.h5"))
    for a, b in zip(
        jax.tree.leaves(one.pairs), jax.tree.leaves(other.pairs), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_scores_are_those_of_their_matches(path):
    """Under either name; unknown of a pair without, and in the table of the commands."""
    with h5py.File(path, "w") as file:
        put(file, "a")["scores"] = np.arange(40.0)
        put(file, "b")["matching_scores0"] = -np.arange(25.0)
        put(file, "c", count=30)
        del file["b"]["x1"], file["b"]["x2"]
        file["b"]["x1"], file["b"]["x2"] = seen(0, PINHOLE, 25), seen(1, SIMPLE, 25)
    found = exchange.read_h5(path)
    unknown = np.full(30, np.nan)
    wanted = np.concatenate([np.arange(40.0), -np.arange(25.0), unknown])
    np.testing.assert_array_equal(found.pairs.score, wanted)
    np.testing.assert_array_equal(found.table.numbers["score"], wanted)


def broken(change):
    def write(file):
        group = put(file, "a")
        change(group)

    return write


def replaced(name, value):
    def change(group):
        del group[name]
        if value is not None:
            group[name] = value

    return broken(change)


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (lambda file: None, "found no groups"),
        (replaced("x2", None), "column a/x2: found no such entry, but R, camera1"),
        (replaced("x2", np.zeros((3, 2))), "3 points beside 40 in x1"),
        (
            broken(lambda group: group.create_dataset("scores", data=[1.0])),
            "column a/scores: found shape (1,)",
        ),
        (replaced("x1", np.zeros((40, 3))), "column a/x1: found shape (40, 3)"),
        (replaced("camera1/params", [1.0]), "column a/camera1/params: found 1 numbers"),
        (
            replaced("camera2/model", None),
            "column a/camera2/model: found no such entry",
        ),
        (replaced("camera2/model", ["LENS"]), "the model 'LENS'; COLMAP has"),
        (replaced("camera2/model", ["OPENCV"]), "3 parameters of model OPENCV"),
        (replaced("camera1", np.eye(4)), "column a/camera1: found K of the left photo"),
        (lambda file: file.create_dataset("a", data=[1.0]), "column a/x1"),
    ],
)
def test_what_does_not_fit_is_told(write, told, path):
    if "LENS" in told or "OPENCV" in told:
        pytest.importorskip("pycolmap", reason="pycolmap has the camera models")
    with h5py.File(path, "w") as file:
        write(file)
    with pytest.raises(TableError) as error:
        exchange.read_h5(path)
    assert told in str(error.value)


def linked(kind, target):
    """A file whose x1 stands elsewhere."""

    def write(file):
        group = put(file, "a")
        file["elsewhere"] = group["x1"][:]
        del group["x1"]
        group["x1"] = kind(target)

    return write


def stored(**how):
    """A file whose x1 claims other values than it holds."""

    def write(file):
        group = put(file, "a")
        del group["x1"]
        group.create_dataset("x1", dtype="f8", **how)

    return write


def virtual(file):
    group = put(file, "a")
    del group["x1"]
    layout = h5py.VirtualLayout((40, 2), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "x", (40, 2))
    group.create_virtual_dataset("x1", layout)


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (linked(lambda name: h5py.ExternalLink("b.h5", name), "/x"), "a link out of this file"),
        (linked(h5py.SoftLink, "/nowhere/x"), "a link to 'nowhere', which is not there"),
        (linked(h5py.SoftLink, "/a/x1"), "column a/x1: found links that lead"),
        (virtual, "values that lie in another file"),
        (stored(shape=(40, 2), external=[("b.raw", 0, 640)]), "that lie in another file"),
        (stored(shape=(10**12, 2), chunks=(10**4, 2), compression="gzip"), "shape (1000000000000"),
        (stored(shape=(8, 2), chunks=(10**7, 2), maxshape=(None, 2)), "in parts of (10000000, 2)"),
        (replaced("camera1/params", ["a", "b", "c", "d"]), "a/camera1/params: found values of"),
        (replaced("camera1/model", [1.0]), "column a/camera1/model: found no text"),
        (replaced("camera1/params", [1e300, 1, 1, 1]), "K = [[1e+300"),
        (replaced("camera1", [b"text"]), "column a/camera1: found values of type"),
        (replaced("x2", np.full((40, 2), 1j)), "column a/x2: found values of type complex128"),
    ],
)  # fmt: skip
def test_what_leads_out_of_the_file_or_claims_too_much_is_refused(write, told, path):
    with h5py.File(path, "w") as file:
        write(file)
    with pytest.raises(TableError) as error:
        exchange.read_h5(path)
    assert told in str(error.value)


def test_links_within_a_file_are_followed(path):
    with h5py.File(path, "w") as file:
        group = put(file, "a", (SIMPLE, SIMPLE))
        del group["camera2"]
        group["camera2"] = h5py.SoftLink("camera1")
    assert exchange.read_h5(path).pairs.lengths.tolist() == [40]


def test_matches_without_numbers_are_left_out(path):
    with h5py.File(path, "w") as file:
        group = put(file, "a")
        group["x1"][3], group["x2"][[5, 7]] = np.nan, [[1e300, 0], [0, np.inf]]
    found = exchange.read_h5(path)
    assert found.pairs.lengths.tolist() == [37]
    assert "3 of 40 matches are left out" in found.warnings[0]


def test_a_file_of_another_kind_is_told(path):
    path.write_text("point,x_left\n")
    with pytest.raises(TableError, match="no HDF5 file that can be read"):
        files.read(path)
