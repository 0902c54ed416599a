"""Examples of GNU Gama's own tests, to what gama-local prints of them: axes and angles
of different sense; points in space with slope distances, zenith angles and vectors; free
networks, one at chosen points."""

import json

import numpy as np
import pytest
from command_line import run

STATIONS = """\
s1 s2 0.000000 s4 31.697272 s6 42.944778 s5 70.089781 s3 99.371895
s2 s4 0.000000 s5 18.518960 s3 65.183762 s1 113.998034
s3 s1 0.000000 s2 51.813951 s4 82.231880 s6 111.740852 s5 146.962472
s4 s5 0.000000 s3 66.875719 s1 116.969225 s2 171.273861
s5 s3 0.000000 s1 23.755682 s2 58.187080 s4 68.394012 s6 111.655849
s6 s5 0.000000 s3 53.123142 s1 84.955241 s4 105.485275
"""
LENGTHS = """\
s1 s3 479.4903 s5 973.3437 s6 983.1419 s2 502.4023 s4 650.9058
s2 s3 691.0610 s5 870.0721 s4 318.5303
s3 s4 591.6779 s6 774.8489 s5 583.8668
s4 s5 572.2641 s6 360.9761
s5 s6 414.0729
"""
"""R. Ghoddousi-Fard: X is east and Y is north, and the directions are clockwise."""

SEF = {
    "s1": (1245.6615, 564.1391, 1245.65959245, 564.13779844),
    "s2": (965.2758, 147.2527, 965.27543580, 147.25322497),
    "s3": (845.1657, 827.7976, 845.16578476, 827.79624477),
    "s4": (668.5546, 263.0875, 668.55499939, 263.09143281),
    "s5": (279.5796, 682.8368, 279.58041807, 682.83500718),
    "s6": (307.6384, 269.7137, 307.63936953, 269.71369183),
}
"""Given and adjusted coordinates."""


def entries(text):
    for line in text.splitlines():
        station, *rest = line.split()
        yield from zip([station] * len(rest), rest[::2], rest[1::2], strict=False)


def adjust(folder, network, inside):
    (folder / "net.gkf").write_text(
        '<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">'
        f"<network {network}><points-observations>{inside}</points-observations>"
        "</network></gama-local>"
    )
    return json.loads(run("adjust", folder / "net.gkf", "--json").stdout)


@pytest.mark.slow
def test_axes_and_angles_of_different_sense(tmp_path):
    inside = "".join(
        f'<point id="{name}" x="{x}" y="{y}" adj="XY"/>'
        for name, (x, y, *_) in SEF.items()
    )
    for station in SEF:
        inside += f'<obs from="{station}">'
        for element, text, deviation in (
            ("direction", STATIONS, "0.70"),
            ("distance", LENGTHS, "0.20"),
        ):
            inside += "".join(
                f'<{element} to="{b}" val="{value}" stdev="{deviation}"/>'
                for a, b, value in entries(text)
                if a == station
            )
        inside += "</obs>"
    found = adjust(tmp_path, 'axes-xy="en" angles="left-handed"', inside)
    assert found["datum"] == 3 and found["degrees_of_freedom"] == 26
    np.testing.assert_allclose(10 * found["sigma0"], 13.186338, rtol=1e-5)
    for name, (*_, x, y) in SEF.items():
        at = found["points"][name]["coordinates"][:2]
        np.testing.assert_allclose(at, [x, y], 0, 1e-7)
    spread = np.square(1000 * np.array(found["points"]["s1"]["deviations"][:2]))
    np.testing.assert_allclose(spread, [0.012647302, 0.016096107], rtol=1e-4)


TETRAHEDRON = """\
<point id="1" x="0.000" y="0.000" z="0.000" fix="xy" adj="Z"/>
<point id="2" x="3000.000" y="0.000" z="0.000" adj="XYZ"/>
<point id="3" x="1500.000" y="2598.076" z="0.000" fix="xy" adj="z"/>
<point id="4" adj="xyz"/>
"""
SIGHTS = {
    "direction": (
        "5.1",
        "1 2 0.000062 3 66.666614 4 33.328943\n"
        "2 1 199.999759 3 133.333457 4 166.670169\n"
        "3 1 266.666543 2 333.333488 4 300.000463\n"
        "4 1 233.327126 2 366.668098 3 99.998746\n",
    ),
    "s-distance": (
        "6.2",
        "1 2 3000.005 3 2999.987 4 3000.037\n2 3 2999.992 4 2999.970\n3 4 2999.990\n",
    ),
    "distance": ("4.0", "1 2 3000.006\n"),
    "z-angle": (
        "7.3",
        "1 2 99.998830 3 99.996608 4 39.181085\n"
        "2 1 100.001167 3 99.997811 4 39.181028\n"
        "3 1 100.003388 2 100.002062 4 39.185237\n"
        "4 1 160.819022 2 160.818669 3 160.814358\n",
    ),
}
RISES = "1 2 0.061\n2 3 0.100\n3 1 -0.160\n"
VECTORS = """\
<vectors><vec from="1" to="4" dx="1500.013" dy="866.031" dz="2449.488"/>
<vec from="1" to="3" dx="1499.990" dy="2598.072" dz="0.006"/>
<cov-mat dim="6" band="2">
25 5 -7 24 -1 0 23 0 0 24 -6 7 25 -6 26
</cov-mat></vectors>
"""


@pytest.mark.slow
def test_a_tetrahedron_in_space(tmp_path):
    """Heights are free at the points 1 and 2; without the height difference that
    gama-local drops."""
    inside = TETRAHEDRON
    for station in "1234":
        inside += f'<obs from="{station}">'
        for element, (deviation, text) in SIGHTS.items():
            inside += "".join(
                f'<{element} to="{b}" val="{value}" stdev="{deviation}"/>'
                for a, b, value in entries(text)
                if a == station
            )
        inside += "</obs>"
    rises = "".join(
        f'<dh from="{a}" to="{b}" val="{value}" stdev="3.9"/>'
        for a, b, value in entries(RISES)
    )
    inside += f"<height-differences>{rises}</height-differences>{VECTORS}"
    found = adjust(tmp_path, "", inside)
    assert found["datum"] == 1 and found["degrees_of_freedom"] == 29
    np.testing.assert_allclose(10 * found["sigma0"], 57.611775, rtol=1e-6)
    points = found["points"]
    heights = [points[name]["coordinates"][2] for name in "123"]
    np.testing.assert_allclose(heights, [-0.017563, 0.017563, 0.091591], 0, 1e-6)
    at = points["2"]["coordinates"][:2] + points["4"]["coordinates"]
    wanted = [3000.009194, 0.034467, 1500.009624, 865.994523, 2449.497613]
    np.testing.assert_allclose(at, wanted, 0, 1e-6)
    square = (1000 * points["1"]["deviations"][2]) ** 2
    np.testing.assert_allclose(square, 68.820581, rtol=1e-4)
