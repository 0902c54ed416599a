"""Bundler's files: a scene written here, and the photographs of Villa Balbianello that
come with GTSAM."""

import numpy as np
import pixel_scene as scene
import pytest
from scipy.spatial.transform import Rotation

import jaxro
from jaxro import exchange
from jaxro.exchange import files
from jaxro.tables.fields import TableError
from jaxro.tables.measured import one_pair

FOCALS, K1, K2 = (700.0, 650.0, 720.0), -0.18, 0.05


def view(number, world):
    """Places in Bundler's axes, y up, by its own formula: p = -P / Pz."""
    rotation, t = scene.pose(number)
    seen = (world @ rotation.T + t) @ scene.AXES
    p = -seen[:, :2] / seen[:, 2:]
    r2 = np.sum(p**2, axis=1, keepdims=True)
    return FOCALS[number] * (1 + K1 * r2 + K2 * r2**2) * p


def lines_of(count=30):
    """A file of three photos and points that all of them show, and one more that only
    two do."""
    world = scene.points(count)
    lines = ["# Bundle file v0.3", f"3 {count}"]
    for k, focal in enumerate(FOCALS):
        rotation, t = scene.pose(k)
        lines.append(f"{focal} {K1} {K2}")
        lines += [" ".join(map(repr, map(float, row))) for row in scene.AXES @ rotation]
        lines.append(" ".join(map(repr, map(float, scene.AXES @ t))))
    views = [view(k, world) for k in range(3)]
    for i, point in enumerate(world):
        photos = (0, 2) if i == 0 else (0, 1, 2)
        each = " ".join(
            f"{k} {i} {views[k][i][0]!r} {views[k][i][1]!r}" for k in photos
        )
        each = each.replace("np.float64(", "").replace(")", "")
        lines += [" ".join(map(str, point.tolist())), "1 2 3", f"{len(photos)} {each}"]
    return lines


@pytest.fixture
def path(tmp_path):
    return tmp_path / "bundle.out"


def write(path, lines):
    path.write_text("\n".join(lines) + "\n")


def test_every_pair_of_photos_has_its_pose(path):
    write(path, lines_of())
    found = exchange.read_bundler(path, photos=["a", "b", "c"])
    assert found.names == ("a-b", "a-c", "b-c")
    assert found.pairs.lengths.tolist() == [29, 30, 29]
    assert list(found.points[:29]) == [str(k) for k in range(1, 30)]
    for k, photos in enumerate([(0, 1), (0, 2), (1, 2)]):
        oriented = jaxro.orient(one_pair(found.pairs, k))
        assert max(scene.errors(oriented, *photos)) < 1e-9


def test_covariances_are_those_of_pixels_without_distortion(path):
    """Against central differences of the places in the file."""
    first, second = lines_of(), lines_of()
    fields = first[2 + 15 + 2 + 3].split()
    step = 1e-3
    places = []
    for sign, lines in ((1, first), (-1, second)):
        moved = [*fields]
        moved[3] = repr(float(fields[3]) + sign * step)
        lines[2 + 15 + 2 + 3] = " ".join(moved)
        write(path, lines)
        pairs = exchange.read_bundler(path).pairs
        row = int(pairs.begins[1]) + 1  # point 1 in the pair 0-2
        places.append([pairs.x_left[row], pairs.y_left[row]])
    slope = np.subtract(*places) / (2 * step)
    covariance = pairs.pad_to(np.array([1]), 30).covariances[0][0, 1]
    # J of a radial distortion is symmetric: a column gives a row of J Jᵀ's trace
    assert slope @ np.linalg.solve(covariance, slope) == pytest.approx(1, rel=1e-5)


def test_a_point_at_two_places_of_a_photo_is_left_out(path):
    lines = lines_of()
    fields = lines[2 + 15 + 2 + 3].split()
    lines[2 + 15 + 2 + 3] = " ".join(["4", *fields[1:], *fields[1:3], "10", "20"])
    write(path, lines)
    found = exchange.read_bundler(path)
    assert found.pairs.lengths.tolist() == [28, 29, 29]
    assert "1 times a photo shows a point at two places" in found.warnings[0]
    # the same place, found twice by a detector
    lines[2 + 15 + 2 + 3] = " ".join(["4", *fields[1:], *fields[1:3], *fields[3:5]])
    write(path, lines)
    again = exchange.read_bundler(path)
    assert again.pairs.lengths.tolist() == [29, 30, 29] and not again.warnings


def change(line, new):
    def changed(lines):
        lines[line - 1] = new
        return lines

    return changed


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (change(1, "# Bundle file v0.1"), "line 1: found '# Bundle file v0.1'"),
        (change(1, "# Bundled"), "line 2: found '3 30'; expected the line"),
        (change(2, "3"), "line 2: found 1 fields; expected the numbers of cameras"),
        (change(2, "3 x"), "line 2, column number of points: found 'x'"),
        (change(2, f"{10**12} 30"), "line 20: found 9 fields for camera 3, second row"),
        (change(3, "700 -0.18"), "line 3: found 2 fields for camera 0; expected 3: f k1"),
        (change(3, "700,5 0 0"), "column camera 0, f: found '700,5', a comma in a number"),
        (change(18, "1 2"), "line 18: found 2 fields for point 0; expected 3: X Y Z"),
        (change(19, "2 0 1 2 2 0 1 2 2"), "line 19: found 9 fields for the colour of point 0"),
        (change(20, "1 0 0 1,5 2"), "line 20, column point 0, place of a view: found '1,5'"),
        (lambda lines: lines[:-1], "line 107: found the end of the file; expected the views"),
        (lambda lines: [lines[0], "0 0"], "found no two photos that share 6 points"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told(changed, told, path):
    write(path, changed(lines_of()))
    with pytest.raises(TableError) as error:
        exchange.read_bundler(path)
    assert told in str(error.value)


def everywhere(*lines):
    """Comments before the version, between all lines and behind some."""

    def changed(given):
        with_comments = ["# by a program", given[0], *lines]
        for line in given[1:]:
            with_comments += [f"{line} # {len(with_comments)}", "", "  # a comment"]
        return with_comments

    return changed


@pytest.mark.parametrize(
    ("changed", "told", "lengths"),
    [
        (everywhere("# 4 40"), [], [29, 30, 29]),
        (change(8, "0 0 0"), ["29 views on camera 1, which has no focal length, are left "
                              "out (first on line 23)"], [30]),
        (change(9, "-1.#IND nan -inf"), ["29 views on camera 1, whose numbers cannot be used",
                                         "1 camera whose numbers cannot be used, is left out "
                                         "(line 8)"], [30]),
        (change(3, "1e300 0 0"), ["30 views on camera 0, whose focal length is 1e+300",
                                   "1 camera whose focal length"], [29]),
        (change(3, "700 -2.5 0"), ["camera 0, whose distortion k1 = -2.5, k2 = 0 (line 3) shows"],
         None),
        (change(20, "1 7 0 1 2"), ["1 view on camera 7, which the file does not have, is left "
                                   "out (line 20)"], [29, 29, 29]),
        (change(20, "1 0 0 1 inf"), ["1 view whose camera, x or y is no number, is left out"],
         [29, 29, 29]),
        (change(20, "1 -1 0 1 2"), ["1 view whose camera, x or y is no number"], [29, 29, 29]),
        (change(20, "2 0 0 1 2 2 0 1"), ["1 point whose line of views has another number"],
         [29, 29, 29]),
        (change(18, "nan nan nan"), ["1 point whose coordinates are no numbers, is left out "
                                     "(line 18)"], [29, 29, 29]),
    ],
)  # fmt: skip
def test_an_entry_that_cannot_be_used_is_left_out(changed, told, lengths, path):
    """The first point is seen by the photos 0 and 2 only; all others by three."""
    write(path, changed(lines_of()))
    found = exchange.read_bundler(path)
    for sentence in told:
        assert any(sentence in warning for warning in found.warnings), found.warnings
    assert len(found.warnings) == len(told)
    if lengths is not None:
        assert found.pairs.lengths.tolist() == lengths


def test_a_file_of_which_nothing_is_left_tells_why(path):
    lines = lines_of()
    for k in (3, 8):
        lines = change(k, "0 0 0")(lines)
    write(path, lines)
    with pytest.raises(
        TableError, match=r"line 20: .* \(30 views on camera 0, which has"
    ):
        exchange.read_bundler(path)


def test_photos_of_one_name_are_refused(path):
    write(path, lines_of())
    with pytest.raises(TableError, match="the name 'a' of photos 0 and 2"):
        exchange.read_bundler(path, photos=["a", "b", "a"])


def test_pairs_have_names_of_their_own(path):
    """1-2-1-2-1 would be two of them."""
    write(path, lines_of())
    found = exchange.read_bundler(path, photos=["1-2", "1-2-1", "2-1"])
    assert found.names == ("1-2 - 1-2-1", "1-2 - 2-1", "1-2-1 - 2-1")


def test_photographs_of_balbianello(data):
    """The places without distortion are those that an independent program made."""
    folder = data / "balbianello"
    if not folder.is_dir():
        pytest.skip("the folder of measured data has no balbianello")
    file = folder / "Balbianello.out"
    found = files.read(file)
    assert found.names[0] == "0-1" and found.pairs.lengths[0] == 248
    # with the focal length 500, in the order of the points
    told = np.loadtxt(
        folder / "pairs" / "cam0_cam1_norm_f500.csv", delimiter=",", skiprows=1
    )
    own = slice(0, 248)
    pairs = found.pairs
    assert list(map(int, found.points[own])) == told[:, 0].astype(int).tolist()
    left = pairs.x_left[own] / pairs.focal_left[0] * 500
    np.testing.assert_allclose(left, told[:, 1], atol=2e-4)
    right = pairs.y_right[own] / pairs.focal_right[0] * 500
    np.testing.assert_allclose(right, told[:, 4], atol=2e-4)


@pytest.mark.slow
def test_poses_of_balbianello(data):
    """Within 0.24° and 1.4° of Bundler's own solution, as an independent adjustment of
    these files is."""
    file = data / "balbianello" / "Balbianello.out"
    if not file.is_file():
        pytest.skip("the folder of measured data has no balbianello")
    found = files.read(file)
    pairs = found.pairs
    cameras = [
        np.loadtxt(file, skiprows=2 + 5 * k, max_rows=5).reshape(5, 3) for k in range(5)
    ]
    for k, (first, second) in ((0, (0, 1)), (4, (1, 2))):
        assert found.names[k] == f"{first}-{second}"
        pose = jaxro.orient(one_pair(pairs, k)).pose
        # Bundler's photos look along -z, as those of jaxro do
        (r1, t1), (r2, t2) = ((cameras[c][1:4], cameras[c][4]) for c in (first, second))
        turn = Rotation.from_quat([pose.qx, pose.qy, pose.qz, pose.qw])
        off = (turn * Rotation.from_matrix(r1 @ r2.T).inv()).magnitude()
        base, own = r1 @ (-r2.T @ t2) + t1, np.array([pose.bx, pose.by, pose.bz])
        cosine = own @ base / np.linalg.norm(base) / np.linalg.norm(own)
        assert np.degrees(off) < 0.25
        assert np.degrees(np.arccos(cosine)) < 1.5
