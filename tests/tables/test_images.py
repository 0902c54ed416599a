"""Tables of places in images and of object points."""

import numpy as np
import pytest
from bad_tables import write

from jaxro.tables import images as tables
from jaxro.tables.fields import TableError

PLACES = """\
Point,X,Y,image,camera,sigma
a,1,2,first,left,.5
b,3,4,first,left,.5
a,5,6,second,right,.7
c,7,8,second,right,.7
"""
POINTS = """\
point,X,Y,Z,sX,sY,sZ
z,9,9,9,0,0,0
a,1,2,3,.1,.2,.3
b,,,,,,
c,4,5,6,0,0,0
"""


def read(places=PLACES, points=POINTS):
    return tables.assemble(
        tables.places(places, "images.csv", "image"),
        tables.points(points, "points.csv"),
    )


def test_both_tables_become_numbers_with_names(tmp_path):
    """Points that no image shows are left out; empty coordinates are unknown."""
    named = read()
    assert named.images == ["first", "second"] and named.points == ["a", "b", "c"]
    assert named.cameras == ["left", "right"]
    np.testing.assert_array_equal(named.image, [0, 0, 1, 1])
    np.testing.assert_array_equal(named.point, [0, 1, 0, 2])
    np.testing.assert_array_equal(named.camera, [0, 1])
    np.testing.assert_array_equal(named.places, [[1, 2], [3, 4], [5, 6], [7, 8]])
    np.testing.assert_array_equal(named.sigma, [0.5, 0.5, 0.7, 0.7])
    np.testing.assert_array_equal(named.lines, [2, 3, 4, 5])
    np.testing.assert_array_equal(named.known, [True, False, True])
    np.testing.assert_array_equal(named.coordinates[[0, 2]], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(named.deviations[[0, 2]], [[0.1, 0.2, 0.3], [0] * 3])
    assert named.has_deviations and not named.is_single

    path = write(tmp_path, "point;x;y\na;1,5;2\n", "photo 7.csv")
    (row,) = tables.read_places(path)
    assert row.cells == {"point": "a", "x": 1.5, "y": 2.0, "image": "photo 7"}
    one = tables.assemble([row], tables.points("point,X,Y,Z\na,1,2,3\n", "points.csv"))
    assert one.is_single and one.sigma is None and not one.has_deviations
    np.testing.assert_array_equal(one.deviations, [[0, 0, 0]])


BAD = {  # of places or points: what stands there, what stands there instead, said
    "no places": (True, PLACES[PLACES.index("\n") :], "\n", "line 2: found no points"),
    "one point twice": (True, "b,3", "a,3", "line 3, column point: found 'a' a second"),
    "no name": (True, "b,3", ",3", "line 3, column point: found an empty field"),
    "no image": (True, "4,first", "4,", "line 3, column image: found an empty field"),
    "a word": (True, "b,3", "b,three", "line 3, column x: found 'three'"),
    "sigma zero": (
        True,
        "2,first,left,.5",
        "2,first,left,0",
        "column sigma: found '0'",
    ),
    "two cameras": (True, "4,first,left", "4,first,right", "on line 2 for the same"),
    "unknown point": (True, "b,3", "q,3", "found 'q', which points.csv does not have"),
    "known twice": (False, "c,4", "a,4", "line 5, column point: found 'a' a second"),
    "half known": (False, "b,,", "b,1,", "line 4, column y: found an empty field"),
    "negative": (False, ".1,", "-.1,", "line 3, column sx: found '-.1'"),
    "no deviation": (False, ",.3", ",", "line 3, column sz: found an empty field"),
    "both sigmas": (False, "sZ", "sigma", "column sigma: found it beside sX"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tables_say_where(case):
    of_places, old, new, said = BAD[case]
    text = PLACES if of_places else POINTS
    assert old in text
    changed = text.replace(old, new, 1)
    with pytest.raises(TableError) as error:
        read(changed, POINTS) if of_places else read(PLACES, changed)
    assert said in str(error.value)


def test_what_cannot_be_calibrated_is_named():
    with pytest.raises(TableError, match=r"line 3.*'b', whose coordinates are empty"):
        tables.check_known(read(), "points.csv")
    with pytest.raises(TableError, match=r"line 3.*'b', which is unknown, in this"):
        tables.check_seen(read())
    known = read(points=POINTS.replace("b,,,,,,", "b,1,1,1,0,0,0"))
    with pytest.raises(TableError, match=r"line 2.*2 known points in image 'first'"):
        tables.check_known(known, "points.csv")
    tables.check_seen(known)


def test_places_in_parquet_are_those_in_csv(tmp_path):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    text = "photo,point,x,y,sigma\n1,a,0.1,-2.5,0.01\n2,a,1e-07,3.0,0.02\n"
    table = pa.table(
        {
            "photo": pa.array([1, 2]),
            "point": pa.array(["a", "a"]).dictionary_encode(),
            "x": pa.array([0.1, 1e-7]),
            "y": pa.array([-2.5, 3.0]),
            "sigma": pa.array([0.01, 0.02]),
        }
    )
    path = tmp_path / "places.parquet"
    pq.write_table(table, path)
    assert tables.are_places(path)
    expected = tables.places(text, "places.csv", "unused")
    found = tables.read_places(path)
    assert [row.cells for row in found] == [row.cells for row in expected]
    gap = {"photo": ["1"], "point": ["a"], "x": pa.array([None], pa.float64())}
    pq.write_table(pa.table(gap | {"y": [1.0]}), path)
    with pytest.raises(TableError, match="line 1, column x: found an empty field"):
        tables.read_places(path)
    path.write_bytes(b"PAR1 and nothing else")
    with pytest.raises(TableError, match="no Parquet file that can be read"):
        tables.are_places(path)
