"""Tables of points on the ground and of model points."""

import numpy as np
import pytest
from bad_tables import write

from jaxro.tables import ground, model
from jaxro.tables.fields import TableError

GROUND = """\
Point,X,Y,Z,sX,sY,sZ,Role
a,1,2,3,.1,.2,.3,control
b,4,5,,.1,.1,,
c,,,6,,,0,Check
d,7,8,9,1,1,1,approximate
"""
MODEL = """\
pair,point,X_bases,Y_bases,Z_bases
1-2,a,0.1,0.2,-1.5
1-2,b,0.3,0.4,-1.6
2-3,a,0.5,0.6,-1.7
"""
nan = np.nan


def test_ground_points_become_numbers_with_roles(tmp_path):
    """Blank coordinates are unknown, and have no standard deviation; a blank role is
    control."""
    read = ground.parse(GROUND, "ground.csv")
    assert read.names == ["a", "b", "c", "d"]
    assert read.roles == ["control", "control", "check", "approximate"]
    expected = [[1, 2, 3], [4, 5, nan], [nan, nan, 6], [7, 8, 9]]
    np.testing.assert_array_equal(read.coordinates, expected)
    expected = [[0.1, 0.2, 0.3], [0.1, 0.1, nan], [nan, nan, 0], [1, 1, 1]]
    np.testing.assert_array_equal(read.deviations, expected)
    np.testing.assert_array_equal(read.is_a("control"), [True, True, False, False])
    np.testing.assert_array_equal(read.known[1], [True, True, False])
    np.testing.assert_array_equal(read.lines, [2, 3, 4, 5])

    path = write(tmp_path, "point;X;Y;Z;sigma\nq;1,5;;2;0,5\n", "ground.csv")
    one = ground.read(path)
    np.testing.assert_array_equal(one.coordinates, [[1.5, nan, 2.0]])
    np.testing.assert_array_equal(one.deviations, [[0.5, nan, 0.5]])
    plain = ground.parse("point,X,Y,Z\nq,1,2,3\n", "ground.csv")
    assert plain.deviations is None and plain.roles == ["control"]
    # as calibrate writes them
    written = ground.parse("point,X,s_X,Y,s_Y,Z,s_Z\nq,1,.1,2,.2,3,.3\n", "points.csv")
    np.testing.assert_array_equal(written.deviations, [[0.1, 0.2, 0.3]])


BAD_GROUND = {  # what stands there, what stands there instead, said
    "no points": (GROUND[GROUND.index("\n") :], "\n", "line 2: found no points"),
    "twice": ("b,4", "a,4", "line 3, column point: found 'a' a second time (first on"),
    "no name": ("b,4", ",4", "line 3, column point: found an empty field"),
    "a word": ("b,4", "b,four", "line 3, column x: found 'four'"),
    "nothing known": ("c,,,6,,,0", "c,,,,,,", "line 4, column x: found three empty"),
    "negative": (".1,.2", "-.1,.2", "line 2, column sx: found '-.1'"),
    "no deviation": (".1,.1,", ".1,,", "line 3, column sy: found an empty field"),
    "role": (
        "Check",
        "tie",
        "line 4, column role: found 'tie'; expected control, check",
    ),
    "one axis": ("sX,sY", "sX,sigma", "column sigma: found it beside sx"),
    "unknown column": ("Role", "weight", "column weight: found an unknown column"),
}


@pytest.mark.parametrize("case", BAD_GROUND)
def test_bad_tables_of_the_ground_say_where(case):
    old, new, said = BAD_GROUND[case]
    assert old in GROUND
    with pytest.raises(TableError) as raised:
        ground.parse(GROUND.replace(old, new, 1), "ground.csv")
    assert said in str(raised.value) and str(raised.value).startswith("ground.csv")


def test_deviations_of_two_axes_are_not_enough():
    with pytest.raises(TableError, match="column sz: found no such column beside sx"):
        ground.parse("point,X,Y,Z,sX,sY\na,1,2,3,1,1\n", "ground.csv")


def test_models_are_those_that_orient_writes():
    """One of several pairs by its name; the unit stands in the header."""
    read = model.parse(MODEL, "points.csv", "points", pair="1-2")
    assert (read.pair, read.unit, read.names) == ("1-2", "bases", ["a", "b"])
    np.testing.assert_array_equal(
        read.coordinates, [[0.1, 0.2, -1.5], [0.3, 0.4, -1.6]]
    )
    assert read.deviations is None
    np.testing.assert_array_equal(read.lines, [2, 3])
    one = model.parse("point,x,y,z,sigma\na,1,2,3,.5\n", "one.csv", "one")
    assert (one.pair, one.unit) == ("one", "")
    np.testing.assert_array_equal(one.deviations, [[0.5, 0.5, 0.5]])


def test_what_the_errors_of_model_points_share_is_read():
    """The root of the own covariance row by row, and five columns in common."""
    names = [*model.OWN, *model.COMMON]
    head = ",".join(
        ["point,X_mm,Y_mm,Z_mm,sX_mm,sY_mm,sZ_mm", *(f"{n}_mm" for n in names)]
    )
    numbers = ",".join(map(str, range(1, 22)))
    read = model.parse(f"{head}\na,1,2,3,1,1,1,{numbers}\n", "points.csv", "points")
    assert read.factors is not None and read.unit == "mm"
    np.testing.assert_array_equal(
        read.factors.own[0], [[1, 0, 0], [2, 3, 0], [4, 5, 6]]
    )
    np.testing.assert_array_equal(
        read.factors.common[0], np.arange(7, 22).reshape(3, 5)
    )
    with pytest.raises(TableError, match="column own_xx: found it without own_yx"):
        text = "point,X,Y,Z,sX,sY,sZ,own_XX\na,1,2,3,1,1,1,1\n"
        model.parse(text, "points.csv", "points")


BAD_MODEL = {
    "several": ("", "", None, "--pair: found models of 2 pairs"),
    "other": (
        "",
        "",
        "3-4",
        "--pair: found '3-4'; expected a pair of points.csv: '1-2'",
    ),
    "twice": ("2,b", "2,a", "1-2", "line 3, column point: found 'a' a second time"),
    "blank": ("0.3,", ",", "1-2", "line 3, column x: found an empty field"),
    "no Z": (",Z_bases", "", "1-2", "column z: found no such column"),
    "another unit": (
        "Z_bases",
        "Y_mm",
        "1-2",
        "column y_mm: found this column a second",
    ),
}


@pytest.mark.parametrize("case", BAD_MODEL)
def test_bad_tables_of_models_say_where(case):
    old, new, pair, said = BAD_MODEL[case]
    with pytest.raises(TableError) as raised:
        model.parse(MODEL.replace(old, new, 1), "points.csv", "points", pair)
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("columns", "numbers", "said"),
    [
        ("sigma", "0", "line 2, column sigma: found '0'"),
        ("sX", "1", "column sx: found it without other deviations"),
        ("sX,sigma", "1,1", "column sx: found it beside other deviations"),
    ],
)
def test_bad_deviations_of_a_model_are_refused(columns, numbers, said):
    with pytest.raises(TableError, match=said):
        model.parse(f"point,x,y,z,{columns}\na,1,2,3,{numbers}\n", "one.csv", "one")


LISTS = {
    "pix4d": "a,500010.25,5200020.5,101.5,0.02,0.03\nb,500110.0,5200030.0,99.0,0.02,0.03\n",
    "metashape": """# CoordinateSystem: LOCAL_CS["Local Coordinates (m)"]
#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Easting_(m),Accuracy_Y/Northing_(m),Accuracy_Z/Altitude_(m),Error_(m),X_error,X_est
a,500010.25,5200020.5,101.5,0.02,0.02,0.03,0.011,0.010,500010.26
b,500110.0,5200030.0,99.0,0.02,0.02,0.03,0.011,0.010,500110.01
# Total Error,,,,,,,0.011,0.010,
""",
    "metashape_plan": "#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_XY_(m),"
    "Accuracy_Z_(m)\na,500010.25,5200020.5,101.5,0.02,0.03\n"
    "b,500110.0,5200030.0,99.0,0.02,0.03\n",
    "names": "name;Easting;Northing;Height;sXY;sZ\n"
    "a;500010,25;5200020,5;101,5;0,02;0,03\nb;500110;5200030;99;0,02;0,03\n",
    "odm": """EPSG:32632
500010.25 5200020.5 101.5 3044 2622 IMG_0525.jpg a
500010.25 5200020.5 101.5 1044 622 IMG_0526.jpg a
500110.0 5200030.0 99.0 144 1622 IMG_0526.jpg b
""",
}  # fmt: skip


@pytest.mark.parametrize("program", LISTS)
def test_lists_of_control_of_other_programs_are_read_as_they_are(program):
    read = ground.parse(LISTS[program], "list")
    assert read.names == ["a", "b"]
    expected = [[500010.25, 5200020.5, 101.5], [500110, 5200030, 99]]
    np.testing.assert_array_equal(read.coordinates, expected)
    if program == "odm":
        assert read.deviations is None
    else:
        np.testing.assert_array_equal(read.deviations, [[0.02, 0.02, 0.03]] * 2)
    lines = {"pix4d": [1, 2], "metashape": [3, 4], "odm": [2, 4]}
    assert read.lines.tolist() == lines.get(program, [2, 3])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("EPSG:1\n1 2 3 4 5 i.jpg\n", "line 2: found 6 entries"),
        ("EPSG:1\n1 2 3 4 5 i.jpg a\n1 2 4 4 5 j.jpg a\n", "line 3, column point"),
        ("a,1,2,3\nb,1,2,x\n", "line 2, column z: found 'x'"),
        ("point,X,Y,Z,sXY,sX,sZ\na,1,2,3,1,1,1\n", "column sx: found it beside sxy"),
        ("#Label,X/Easting,Y/Northing,Z/Altitude\na,1,2,oh\n", "line 2, column z"),
        ("#Label,X,Y,Z,Accuracy_Q\na,1,2,3,1\n", "column accuracy_q"),
    ],
)
def test_bad_lists_of_control_say_where(text, said):
    with pytest.raises(TableError) as raised:
        ground.parse(text, "list")
    assert said in str(raised.value)
