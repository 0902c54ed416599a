"""Geodetic networks of textbooks to the printed digits, by `jaxro adjust`. Figures and
standard deviations (cm, with sigma0 of the adjustment) as F. Krumm prints them in
Geodetic Network Adjustment Examples, Rev. 3.5, Stuttgart 2020. East before north; angles
and directions clockwise."""

import json

import charamza
import numpy as np
import pytest
from command_line import run

NIEMEIER = """\
direction Z108 280 370.6444 0.0005
direction Z108 104 199.5131 0.0005
direction Z108 113 108.5994 0.0005
direction Z110 106 35.4146 0.0005
direction Z110 Z108 292.9943 0.0005
direction Z110 104 237.8763 0.0005
direction Z110 113 130.2278 0.0005
distance Z108 280 1098.643 0.005
distance Z108 104 1002.598 0.005
distance Z108 113 1517.862 0.005
distance Z110 106 1118.689 0.005
distance Z110 Z108 619.905 0.005
distance Z110 104 1286.215 0.005
distance Z110 113 961.911 0.005
"""
"""W. Niemeier 2008, Ausgleichungsrechnung, pages 156-162; gon."""

NIEMEIER_POINTS = """\
104 40686.792 26816.143 control
106 41932.838 28872.552 control
113 42242.231 27492.007 control
280 40350.846 28835.979 control
Z108 40759.400 27816.100 approximate
Z110 41373.000 27904.000 approximate
"""

NIEMEIER_ADJUSTED = """\
Z108 40759.3769 0.313 27816.1166 0.301
Z110 41373.0193 0.312 27904.0042 0.289
"""

WOLF_DIRECTIONS = {
    1: {2: 0.0, 7: 80.5, 3: 158.961},
    2: {8: 0.0, 7: 62.726, 1: 105.712},
    3: {1: 0.0, 7: 56.496, 9: 85.845, 4: 114.595},
    4: {7: 0.0, 8: 34.45, 9: 80.211, 5: 137.402, 3: 352.309},
    5: {9: 0.0, 6: 66.245, 4: 337.216},
    6: {5: 0.0, 9: 79.169, 8: 111.582},
    7: {2: 0.0, 8: 37.498, 9: 110.258, 4: 164.232, 3: 258.441, 1: 323.486},
    8: {6: 0.0, 9: 21.445, 4: 56.442},
    9: {8: 0.0, 6: 146.143, 5: 200.733, 4: 280.756, 3: 324.105, 7: 346.569},
}
"""H. Wolf 1979, Ausgleichungsrechnung II, page 66; gon."""

WOLF = "".join(
    f"direction {a} {b} {value} 0.0025\n"
    for a, towards in WOLF_DIRECTIONS.items()
    for b, value in towards.items()
)
WOLF += "distance 7 9 2121.90 0.03\nangle 8 7 99.7810 0.0035 2\n"

WOLF_POINTS = """\
1 184423.28 726419.33 approximate
2 186444.18 726476.66 approximate
3 183257.84 725490.35 approximate
4 184292.00 723313.00 approximate
5 185487.00 721829.00 approximate
6 186708.72 722104.58 approximate
7 184868.20 725139.70 approximate
8 186579.30 725336.60 approximate
9 185963.07 723322.02 approximate
"""

WOLF_ADJUSTED = """\
1 184423.0335 2.183 726419.6616 3.117
2 186444.3543 2.510 726476.7948 3.512
3 183257.3128 3.557 725490.5804 2.099
4 184292.0767 2.172 723313.2969 2.190
5 185487.3938 1.780 721828.5221 3.704
6 186708.6561 2.975 722103.9831 3.388
7 184868.0090 1.254 725139.6623 1.249
8 186579.4918 2.793 725336.4593 2.547
9 185963.2619 1.060 723322.2794 1.438
"""

GHILANI_ANGLES = """\
Q R S 38 48 50.7 4.0
Q S T 47 46 12.4 4.0
Q T R 273 24 56.5 4.4
R Q S 269 57 33.4 4.7
S R T 257 32 56.8 4.7
T S Q 279 04 31.2 4.5
R S T 42 52 51.0 4.3
R S Q 90 02 26.7 4.5
S Q R 51 08 45.0 4.3
S T Q 51 18 16.2 4.0
T R S 34 40 05.7 4.0
"""
"""Ghilani 2010, Adjustment Computations, example 16.2; degrees, minutes, seconds."""

GHILANI_DISTANCES = """\
distance Q R 1640.016 0.026
distance R S 1320.001 0.024
distance S T 1579.123 0.025
distance T Q 1664.524 0.026
distance Q S 2105.962 0.029
distance R T 2266.035 0.030
"""

GHILANI_POINTS = """\
Q 1000.00 1000.00 control
R 1003.06 2640.01 approximate
S 2323.07 2638.47 approximate
T 2661.75 1096.07 approximate
"""

GHILANI_ADJUSTED = """\
R 1003.0572 0.001 2640.0051 0.597
S 2323.0626 0.549 2638.4742 0.660
T 2661.7386 0.590 1096.0867 0.727
"""


def seconds(degrees, minutes, rest):
    return (float(degrees) * 60 + float(minutes)) * 60 + float(rest)


def ghilani():
    lines = []
    for line in GHILANI_ANGLES.splitlines():
        at, a, b, *angle, sigma = line.split()
        lines.append(
            f"angle {at} {a} {seconds(*angle) / 3600} {float(sigma) / 3600} {b}"
        )
    bearing = seconds(0, 6, 24.5) / 3600
    lines.append(f"azimuth Q R {bearing} {0.001 / 3600}")
    return "\n".join(lines) + "\n" + GHILANI_DISTANCES


NETS = {
    "Niemeier": (NIEMEIER, NIEMEIER_POINTS, NIEMEIER_ADJUSTED, "gon"),
    "Wolf, free": (WOLF, WOLF_POINTS, WOLF_ADJUSTED, "gon"),
    "Ghilani": (ghilani(), GHILANI_POINTS, GHILANI_ADJUSTED, "degrees"),
}


def adjust(folder, name, header="point,Y,X,role"):
    """The call for a net, with the columns of its points named so."""
    lines, points, _, angles = NETS[name]
    rows = [line.split() for line in lines.splitlines()]
    text = "".join(",".join([*row, ""][:6]) + "\n" for row in rows)
    (folder / "network.csv").write_text("kind,from,to,value,sigma,other\n" + text)
    text = points.replace(" ", ",")
    (folder / "points.csv").write_text(f"{header}\n{text}")
    tables = folder / "network.csv", "--points", folder / "points.csv"
    return run("adjust", *tables, "--angles", angles, "--unknown-sigma0", "--json")


@pytest.mark.slow
@pytest.mark.parametrize("name", NETS)
def test_the_printed_coordinates_and_deviations(name, tmp_path):
    found = json.loads(adjust(tmp_path, name).stdout)["points"]
    for line in NETS[name][2].splitlines():
        point, east, spread_east, north, spread_north = line.split()
        at, spread = found[point]["coordinates"], found[point]["deviations"]
        at, spread = [at[1], at[0]], 100 * np.array([spread[1], spread[0]])
        np.testing.assert_allclose(at, [float(east), float(north)], 0, 0.5001e-4)
        there = [float(spread_east), float(spread_north)]
        np.testing.assert_allclose(spread, there, 0, 0.5001e-3)


def test_known_heights_with_a_covariance_matrix(tmp_path):
    """The dynamic net of F. Krumm, example 2.3: heights, deviations and residuals, mm."""
    legs = "2,8,5.128,700 3,6,2.183,500 3,7,12.254,500 6,7,10.071,800 8,7,2.824,800"
    lines = [leg.split(",") for leg in legs.split()]
    (tmp_path / "network.csv").write_text(
        "from,to,difference,sigma\n"
        + "".join(f"{a},{b},{v},{np.sqrt(float(s) / 1000)}\n" for a, b, v, s in lines)
    )
    (tmp_path / "points.csv").write_text(
        "point,Z,sigma\n2,107.7541,.05\n3,103.4535,.06\n"
    )
    (tmp_path / "covariances.csv").write_text("point,other,cZZ\n3,2,-0.0015\n")
    tables = "--points", tmp_path / "points.csv"
    tables += "--covariances", tmp_path / "covariances.csv"
    told = run(
        "adjust", tmp_path / "network.csv", *tables, "--unknown-sigma0", "--json"
    )
    found = json.loads(told.stdout)
    heights = [found["points"][name]["coordinates"][2] for name in "23678"]
    printed = [107.7541, 103.4535, 105.6364, 115.7072, 112.8826]
    np.testing.assert_allclose(heights, printed, 0, 0.5001e-4)
    spread = [1000 * found["points"][name]["deviations"][2] for name in "23678"]
    np.testing.assert_allclose(spread, [0.04, 0.04, 0.43, 0.39, 0.48], 0, 0.005001)
    residuals = [1000 * float(row["residual"]) for row in found["measurements"][:5]]
    printed = [0.52, -0.10, -0.27, -0.17, 0.60]
    np.testing.assert_allclose(residuals, printed, 0, 0.005001)
    assert found["measurements"][5]["points"] == "2-3"


@pytest.mark.slow
def test_axes_the_wrong_way_round_are_no_solution(tmp_path):
    told = adjust(tmp_path, "Wolf, free", "point,X,Y,role")
    assert told.exit_code == 1, told.output
    assert json.loads(told.stdout)["result"] == "diverged"


@pytest.mark.slow
def test_the_example_of_gama_to_its_printed_digits(tmp_path):
    """From two known points alone. GNU Gama takes one step from coordinates some 10 mm
    away, so that its m0 is right to 2e-5."""
    (tmp_path / "charamza.gkf").write_text(charamza.as_xml())
    told = run("adjust", tmp_path / "charamza.gkf", "--json")
    found = json.loads(told.stdout)
    assert found["degrees_of_freedom"] == 37 and not found["sigma_known"]
    np.testing.assert_allclose(10 * found["sigma0"], charamza.M0, 0, 0.5e-4)
    for line in charamza.ADJUSTED.splitlines():
        point, x, y = line.split()
        at = found["points"][point]["coordinates"][:2]
        np.testing.assert_allclose(at, [float(x), float(y)], 0, 1e-6)
    spread = found["points"]["403"]["deviations"][0]
    np.testing.assert_allclose((1000 * spread) ** 2, charamza.VARIANCE_403, 1e-5)
    lines, points = charamza.as_tables()
    (tmp_path / "network.csv").write_text(lines)
    (tmp_path / "points.csv").write_text(points)
    tables = tmp_path / "network.csv", "--points", tmp_path / "points.csv"
    told = run("adjust", *tables, "--angles", "gon", "--unknown-sigma0", "--json")
    same = json.loads(told.stdout)
    for name, point in found["points"].items():
        np.testing.assert_allclose(
            point["coordinates"][:2], same["points"][name]["coordinates"][:2], 1e-12
        )
