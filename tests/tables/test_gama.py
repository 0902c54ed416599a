"""XML input of GNU Gama: the same measurements as a table gives, whatever the axes and
units, and one clear error for what is not read."""

import itertools

import numpy as np
import pytest

from jaxro.commands import network_input
from jaxro.tables import gama
from jaxro.tables.fields import TableError

POINTS = """\
<point id="A" x="0" y="0" z="10" fix="xyz"/>
<point id="B" x="100" y="20" z="12" adj="xyZ"/>
<point id="C" x="30" y="80" z="9" adj="XYZ"/>
"""


def document(inside, points=POINTS, network="", parameters="", defaults=""):
    return (
        f"<gama-local><network {network}><parameters {parameters}/>"
        f"<points-observations {defaults}>\n{points}{inside}"
        "</points-observations></network></gama-local>"
    )


SIGHTS = """\
<obs from="A" from_dh="1.5">
<direction to="B" val="12.5" stdev="10" to_dh="1.7"/>
<direction to="C" val="77.25" stdev="10"/>
<distance to="B" val="101.98" stdev="5"/>
<s-distance from="B" to="C" val="92.25" stdev="5" from_dh="1.6" to_dh="0.1"/>
<z-angle to="B" val="98.75" stdev="12" to_dh="1.7"/>
<angle bs="B" fs="C" val="58.32" stdev="8"/>
<azimuth to="C" val="77.2" stdev="20"/>
</obs>
<height-differences><dh from="A" to="B" val="2.001" stdev="1.2"/></height-differences>
<vectors>
<vec from="A" to="C" dx="30.01" dy="80.02" dz="-1.01"/>
<vec from="B" to="C" dx="-70.01" dy="60.02" dz="-3.01" to_dh="0.5"/>
<cov-mat dim="6" band="2">9 1 2 8 3 0 7 0 0 4 0 0 4 0 4</cov-mat>
</vectors>
<coordinates><point id="C" x="30.001" y="80.002"/>
<cov-mat dim="2" band="1">4 1 9</cov-mat></coordinates>
"""

TABLE = """\
kind,from,to,other,value,sigma,from_above,to_above,dX,dY,dZ,sX,sY,sZ,cXY,cXZ,cYZ
direction,A,B,,12.5,0.001,1.5,1.7,,,,,,,,,
direction,A,C,,77.25,0.001,1.5,,,,,,,,,,
distance,A,B,,101.98,0.005,1.5,,,,,,,,,,
slope,B,C,,92.25,0.005,1.6,0.1,,,,,,,,,
zenith,A,B,,98.75,0.0012,1.5,1.7,,,,,,,,,
angle,A,B,C,58.32,0.0008,1.5,,,,,,,,,,
azimuth,A,C,,77.2,0.002,1.5,,,,,,,,,,
height,A,B,,2.001,0.0012,,,,,,,,,,,
vector,A,C,,,,,,30.01,80.02,-1.01,0.003,0.0028284271247461905,0.0026457513110645907,1e-6,2e-6,3e-6
vector,B,C,,,,,0.5,-70.01,60.02,-3.01,0.002,0.002,0.002,0,0,0
"""


def test_the_same_measurements_as_a_table(tmp_path):
    (tmp_path / "net.gkf").write_text(document(SIGHTS))
    (tmp_path / "net.csv").write_text(TABLE)
    read = lambda name: network_input.read(
        tmp_path / name, None, sigma=None, angles="gon", unit="m"
    )
    one, other = read("net.gkf"), read("net.csv")
    for a, b in zip(one.lines, other.lines, strict=False):
        assert (a.kind, a.points) == (b.kind, b.points)
        np.testing.assert_allclose(a.values, b.values, rtol=1e-14)
        np.testing.assert_allclose(a.root, b.root, atol=1e-12)
        np.testing.assert_array_equal(a.above or np.zeros(len(a.points)), b.above)
    known = one.lines[len(other.lines) :]
    assert [line.kind for line in known] == ["plan"] and one.angles == "gon"
    np.testing.assert_allclose(
        known[0].root @ known[0].root.T, np.array([[4, 1], [1, 9]]) * 1e-6
    )
    network, _ = network_input.assemble(one, ["A", "B", "C"])
    np.testing.assert_array_equal(network.held, [[True] * 3, [False] * 3, [False] * 3])
    np.testing.assert_array_equal(
        network.datum, [[False] * 3, [False, False, True], [True] * 3]
    )


COMPASS = {"n": (0, 1), "e": (1, 0), "s": (0, -1), "w": (-1, 0)}
AXES = [
    "".join(pair)
    for pair in itertools.permutations("nesw", 2)
    if np.dot(COMPASS[pair[0]], COMPASS[pair[1]]) == 0
]


@pytest.mark.parametrize("sense", ["left-handed", "right-handed"])
@pytest.mark.parametrize("axes", AXES)
def test_angles_grow_from_x_to_y_whatever_the_axes(axes, sense):
    """Azimuth and angle of three points east and north of each other."""
    east_north = {"A": (0.0, 0.0), "B": (30.0, 70.0), "C": (50.0, -20.0)}
    at = {
        name: [np.dot(COMPASS[axis], place) for axis in axes]
        for name, place in east_north.items()
    }
    points = "".join(
        f'<point id="{name}" x="{x}" y="{y}" fix="xy"/>' for name, (x, y) in at.items()
    )
    sign = 1 if sense == "left-handed" else -1
    gons = lambda name: np.arctan2(*east_north[name]) * 200 / np.pi * sign
    sights = (
        f'<obs from="A"><azimuth to="B" val="{gons("B")}" stdev="1"/>'
        f'<angle bs="B" fs="C" val="{gons("C") - gons("B")}" stdev="1"/></obs>'
    )
    network = f'axes-xy="{axes}" angles="{sense}"'
    found = gama.parse(document(sights, points, network), "net.gkf").lines
    t = {name: np.arctan2(y, x) for name, (x, y) in at.items()}
    for line, wanted in zip(found, (t["B"], t["C"] - t["B"]), strict=True):
        off = np.exp(1j * (line.values[0] * np.pi / 200 - wanted))
        np.testing.assert_allclose(off, 1, atol=1e-12)


def test_units_and_deviations_of_all():
    sights = """<obs from="A"><direction to="B" val="57-32-28.428"/>
    <direction to="C" val="63.9347"/><distance to="B" val="2000"/>
    <distance to="C" val="1" stdev="2"/></obs>
    <height-differences><dh from="A" to="B" val="1" dist="4"/></height-differences>"""
    text = document(
        sights,
        parameters='sigma-apr="3" sigma-act="apriori"',
        defaults='direction-stdev="3.24" distance-stdev="3 2 0.5"',
    )
    found = gama.parse(text, "net.gkf")
    assert found.sigma_known and found.in_degrees
    values = [float(line.values[0]) for line in found.lines]
    roots = [float(line.root[0, 0]) for line in found.lines]
    np.testing.assert_allclose(values[:2], 63.9347, atol=1e-9)
    wanted = [1e-3, 3.24e-4, 0.003 + 0.002 * np.sqrt(2), 0.002, 0.006]
    np.testing.assert_allclose(roots, wanted)
    assert {line.set for line in found.lines[:2]} == {found.lines[0].set}


def test_every_obs_is_a_set_even_on_one_line():
    one = '<obs from="A"><direction to="B" val="1" stdev="1"/></obs>'
    first, second = gama.parse(document(one + one), "net.gkf").lines
    assert first.set != second.set


def test_covariances_within_a_kind_make_one_measurement():
    text = document(TWO.format('<cov-mat dim="2" band="1">4 1 9</cov-mat>'))
    (line,) = gama.parse(text, "net.gkf").lines
    assert line.points == ("A", "B", "A", "C") and line.values.tolist() == [1, 1]
    np.testing.assert_allclose(line.root @ line.root.T, [[4e-6, 1e-6], [1e-6, 9e-6]])


SIGHT = '<obs from="A"><distance to="B" val="1" stdev="1"/></obs>'
LAUGHS = """<!DOCTYPE lolz [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>
<gama-local><network><description>&b;</description></network></gama-local>"""
OUTSIDE = '<!DOCTYPE gama-local SYSTEM "file:///etc/passwd"><gama-local/>'
TWO = '<obs from="A"><distance to="B" val="1"/><distance to="C" val="1"/>{}</obs>'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LAUGHS, "line 1: found <!DOCTYPE lolz>; expected no document type"),
        (OUTSIDE, "found <!DOCTYPE gama-local>; expected no document type"),
        ("", "no XML (no element found)"),
        ("<gama-local><network></gama-local>", "no XML (mismatched tag)"),
        ("<html/>", "line 1: found <html>; expected <gama-local>"),
        (document("<obs><photo/></obs>"), "line 5: found <photo> in <obs>"),
        (document("dust"), "the text 'dust' in <points-observations>"),
        (document(SIGHT, network='axes-xy="nx"'), "axes-xy='nx'"),
        (document(SIGHT, network='axes-xy="ns"'), "two axes at right angles"),
        (document(SIGHT, network='angles="mixed"'), "angles='mixed'"),
        (document(SIGHT, parameters='sigma-apr="-1"'), "sigma-apr=-1"),
        (document(SIGHT, parameters='colour="red"'), "the attribute colour"),
        (document(""), "no measurements"),
        (document(SIGHT.replace(' stdev="1"', "")), "without a standard deviation"),
        (document(SIGHT.replace('"B"', '"D"')), "the point 'D' without <point>"),
        (document(SIGHT.replace('val="1"', 'val="1,5"')), "val='1,5' of <distance>"),
        (document(SIGHT.replace('val="1"', "")), "<distance> without val"),
        (
            document(SIGHT.replace("distance", "z-angle").replace('"1"', '"301.5"', 1)),
            "val='301.5' of <z-angle>",
        ),
        (
            '<?xml version="1.0" encoding="iso-8859-2"?>' + document(SIGHT),
            None,
        ),
        (document(SIGHT.replace('val="1"', 'val="1e999"')), "val='1e999'"),
        (
            document(SIGHT.replace('val="1"', 'val="&lol;"')),
            "no XML (undefined entity)",
        ),
        (document(SIGHT.replace(' from="A"', "")), "<obs> without from"),
        (document(SIGHT.replace('stdev="1"', 'stdev="0"')), "stdev=0 of <distance>"),
        (document(SIGHT, POINTS.replace("xyz", "xy")), None),
        (document(SIGHT, POINTS.replace(' fix="xyz"', "")), "neither fixed nor adj"),
        (document(SIGHT, POINTS.replace('y="0" ', "")), "a fixed point 'A' without y"),
        (document(SIGHT, POINTS.replace('fix="', 'fix="b')), "fix='bxyz'"),
        (document(SIGHT, POINTS * 2), "a second time (first on line 2)"),
        (document(TWO.format("")), "without a standard deviation"),
        (
            document(
                TWO.format('<cov-mat dim="2" band="1">1 0.5 1</cov-mat>').replace(
                    '<distance to="B"', '<azimuth to="B"'
                )
            ),
            "covariances between measurements of azimuth, distance",
        ),
        (
            document(TWO.format('<cov-mat dim="2" band="0">1 1</cov-mat>' * 2)),
            "a second",
        ),
        (
            document(TWO.format('<cov-mat dim="2" band="0">1 -1</cov-mat>')),
            "a matrix that is not positive",
        ),
        (
            document(TWO.format('<cov-mat dim="3" band="0">1 1 1</cov-mat>')),
            "a <cov-mat> of dim 3, band 0 with 3 numbers; expected dim 2",
        ),
        (document(TWO.format('<cov-mat dim="2" band="0">1 1</cov-mat>')), None),
        (document(SIGHT, defaults='distance-stdev="a"'), None),
        (
            document(SIGHT.replace(' stdev="1"', ""), defaults='distance-stdev="a"'),
            "distance-stdev='a'",
        ),
    ],
)
def test_what_is_not_read_is_said(text, said):
    if said is None:
        gama.parse(text, "net.gkf")
        return
    with pytest.raises(TableError) as told:
        gama.parse(text, "net.gkf")
    assert said in str(told.value) and "net.gkf" in str(told.value)
