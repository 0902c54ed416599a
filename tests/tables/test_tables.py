"""Reading tables and cameras: what fits is read whole, what does not stops with file,
line and column."""

import jax.numpy as jnp
import numpy as np
import pytest
from bad_tables import BAD_CAMERAS, BAD_TABLES, HEAD, A, B, write

from jaxro import Camera
from jaxro.tables import cameras, csv as tables
from jaxro.tables.examples import pair as example
from jaxro.tables.fields import TableError


@pytest.mark.parametrize("case", BAD_TABLES)
def test_bad_tables_are_named_by_file_line_and_column(case, tmp_path):
    content, line, column, found = BAD_TABLES[case]
    path = write(tmp_path, content, "pairs.csv")
    with pytest.raises(TableError) as caught:
        tables.read(path)
    error = caught.value
    assert (error.file, error.line, error.column) == (str(path), line, column)
    assert found in error.found and error.expected
    assert f"{path}, line {line}" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("case", BAD_CAMERAS)
def test_bad_cameras_are_named_by_file_line_and_key(case, tmp_path):
    content, line, key, found = BAD_CAMERAS[case]
    path = write(tmp_path, content, "camera.toml")
    with pytest.raises(TableError) as caught:
        cameras.read(path)
    assert (caught.value.file, caught.value.line, caught.value.column) == (
        str(path),
        line,
        key,
    )
    assert found in caught.value.found


def test_unreadable_files(tmp_path):
    for path in (tmp_path / "missing.csv", tmp_path):
        with pytest.raises(TableError, match="that can be read"):
            tables.read(path)


@pytest.mark.parametrize(
    "text",
    [
        f"{HEAD}\n{A}\n{B}\n",
        f"\ufeffid,xl,yl,xr,yr\r\n{A}\r\n\r\n{B}",
        ' Point , X_LEFT,y_left,x_right,y_right\n"a", 1,2 ,3,+4.0\n,,,,\nb,5e0,6.,7,8',
        "y_right,point,x_left,y_left,x_right\n4,a,1,2,3\n8,b,5,6,7",
    ],
)
def test_one_table_written_in_many_ways(text, tmp_path):
    (only,) = tables.read(write(tmp_path, text, "left_right.csv")).pairs
    assert (
        only.name == "left_right" and only.points == ["a", "b"] and only.sigma is None
    )
    np.testing.assert_array_equal(only.coordinates, [[1, 5], [2, 6], [3, 7], [4, 8]])


def test_pairs_keep_their_order_and_their_sigmas():
    text = f"pair,sigma,{HEAD}\nq,.1,{A}\np,.2,{A}\nq,.3,{B}\n"
    table = tables.parse(text, "file", "unused")
    assert [(one.name, one.points, one.lines) for one in table.pairs] == [
        ("q", ["a", "b"], [2, 4]),
        ("p", ["a"], [3]),
    ]
    np.testing.assert_array_equal(table.pairs[0].sigma, [0.1, 0.3])
    assert not table.warnings, "the same point in two pairs is no repetition"


def test_a_point_under_two_names_is_a_warning():
    (warning,) = tables.parse(f"{HEAD}\n{A}\n{B}\nc,1,2,3,4.0", "file", "pair").warnings
    assert "c = a (line 4)" in warning and "degrees of freedom" in warning


def test_cameras_of_every_form(tmp_path):
    name = "in-strip_1_10"
    forms = {
        "[camera]\nfocal = 3": (3, 3),
        "[left]\nfocal = 3\n[right]\nfocal = 4": (3, 4),
        "[photo.10]\nfocal = 4\n[photo.in-strip_1]\nfocal = 3\n[photo.in]\nfocal = 5": (
            3,
            4,
        ),
    }
    for text, focals in forms.items():
        both = cameras.read(write(tmp_path, text, "camera.toml")).of(name, "pairs.csv")
        assert tuple(camera.focal for camera in both) == focals
    text = "[camera.wide]\nfocal = 3\n[camera.tele]\nfocal = 4"
    named = cameras.read(write(tmp_path, text, "camera.toml")).named
    assert {name: camera.focal for name, camera in named.items()} == {
        "wide": 3,
        "tele": 4,
    }
    photos = cameras.read(
        write(tmp_path, "[photo.1]\nfocal = 3\n[photo.2]\nfocal = 4", "camera.toml")
    )
    with pytest.raises(TableError, match=r"line 2, column pair.*LEFT-RIGHT") as caught:
        photos.of(name, "pairs.csv", 2)
    assert "1, 2" in caught.value.expected


def test_photo_coordinates_are_those_of_the_camera():
    (measured,) = tables.parse(example.TABLE, "file", "pair").pairs
    left, right = Camera(150.0, (3.0, -4.0), 0.5, True), Camera(100.0)
    pair = cameras.to_pair(measured, "file", left, right)
    u, v, *_ = map(jnp.asarray, measured.coordinates)
    for got, wanted in zip(
        (pair.x_left, pair.y_left), left.to_photo(u, v), strict=True
    ):
        np.testing.assert_array_equal(got, wanted)
    assert (float(pair.focal_left), float(pair.focal_right)) == (150.0, 100.0)
    np.testing.assert_array_equal(
        cameras.to_pair(measured, "file", left, left, 0.01).sigma, 0.005
    )
    with pytest.raises(TableError, match="pixel size"):
        cameras.to_pair(measured, "file", left, right, 0.01)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("[camera]\nfocal" + ".a" * 10**5 + " = 1", "line 2: found a line with 100000 points"),
        ("# " + "a" * 10**6, "found more than 1 million bytes"),
        ("[camera]\nfocal = 0x" + "f" * 10**5, "found a whole number of thousands of digits"),
        ("[camera]\nfocal = " + "9" * 10**4, "found a whole number of thousands of digits"),
        ("camera = " + "[" * 10**4, "too deep to be read"),
        ("[camera]\nfocal = 1\nfocal = 2", "no valid TOML (Cannot overwrite a value"),
        ("[camera]\nfocal = 1\0", "line 2: found no valid TOML"),
    ],
)  # fmt: skip
def test_absurd_camera_files_are_one_sentence(content, told, tmp_path):
    path = tmp_path / "cameras.toml"
    path.write_text(content)
    with pytest.raises(TableError) as error:
        cameras.read(path)
    assert told in str(error.value) and len(str(error.value)) < 1000
