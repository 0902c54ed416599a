"""`jaxro adjust`: published nets, what is named, what is refused."""

import json
from dataclasses import replace

import gemael
import numpy as np
import pytest
from command_line import rows, run, words

from jaxro.commands.adjust import Options, calculate
from jaxro.statistics.promise import repeat_job
from jaxro.surveys.geodetic import adjust_network

SIKI = """\
from,to,difference,sigma
1,2,-0.749,0.00077
1,3,-1.274,0.00126
1,4,-2.89,0.00098
2,3,-0.53,0.00105
2,4,-2.141,0.00133
3,4,-1.614,0.00063
"""
"""A net of levelling of the course of OSGeoLabBp (level_net), .7 mm a kilometre."""

MIKHAIL = """\
from,to,difference,length_km
A,B,25.42,18.1
B,C,10.34,9.4
C,A,-35.2,14.2
B,D,-15.54,17.6
D,E,21.32,13.5
E,C,4.82,9.9
E,A,-31.02,13.8
C,D,-26.11,14.0
"""
"""Mikhail and Ackermann 1976, table 7-1; variance .1 for a kilometre."""


def adjusted(folder, network, points="", *options):
    """The summary of a call."""
    (folder / "network.csv").write_text(network)
    given = [folder / "network.csv"]
    if points:
        (folder / "points.csv").write_text(points)
        given += ["--points", folder / "points.csv"]
    told = run("adjust", *given, "--json", *options)
    assert told.exit_code in (0, 1), told.output
    return json.loads(told.stdout)


def test_a_published_net_to_its_printed_digits(tmp_path):
    found = adjusted(tmp_path, SIKI, "point,Z\n4,101.345\n", "--unknown-sigma0")
    heights = [found["points"][name]["coordinates"][2] for name in "123"]
    spread = [found["points"][name]["deviations"][2] for name in "123"]
    np.testing.assert_array_equal(np.round(heights, 4), [104.2350, 103.4868, 102.9588])
    np.testing.assert_array_equal(np.round(spread, 5), [0.00113, 0.00119, 0.00091])
    assert round(found["sigma0"], 2) == 1.65 and found["usable"]
    assert found["points"]["4"]["deviations"] == [None, None, 0.0]


def test_weights_by_the_length_of_lines(tmp_path):
    """Redundancy 4 and sigma0 .2011 of the weights 10 / km."""
    found = adjusted(tmp_path, MIKHAIL, "point,Z\nA,800\n")
    assert found["degrees_of_freedom"] == 4 and not found["sigma_known"]
    np.testing.assert_allclose(found["sigma0"] / np.sqrt(0.1), 0.2011, atol=5e-5)
    free = adjusted(tmp_path, MIKHAIL)
    assert free["datum"] == 1 and free["sigma0"] == pytest.approx(found["sigma0"])
    for one, other in zip(found["measurements"], free["measurements"], strict=True):
        assert one["tau"] == pytest.approx(other["tau"], abs=1e-9)


def test_xml_of_gama_is_the_same_net(tmp_path):
    lines = [line.split(",") for line in MIKHAIL.splitlines()[1:]]
    rises = "".join(
        f'<dh from="{a}" to="{b}" val="{rise}" dist="{km}"/>'
        for a, b, rise, km in lines
    )
    points = "".join(f'<point id="{name}" adj="z"/>' for name in "BCDE")
    (tmp_path / "net.xml").write_text(
        '<?xml version="1.0"?><gama-local><network><parameters sigma-apr="1000"/>'
        f'<points-observations><point id="A" z="800" fix="z"/>{points}'
        f"<height-differences>{rises}</height-differences></points-observations>"
        "</network></gama-local>"
    )
    found = json.loads(run("adjust", tmp_path / "net.xml", "--json").stdout)
    same = adjusted(tmp_path, MIKHAIL, "point,Z\nA,800\n")
    assert not found["sigma_known"]
    for name, value in (("sigma0", found["sigma0"]), ("datum", 0)):
        assert value == pytest.approx(same[name], rel=1e-9)
    for name, point in found["points"].items():
        assert point["coordinates"][2] == pytest.approx(
            same["points"][name]["coordinates"][2], abs=1e-9
        )
    told = run("adjust", tmp_path / "net.xml", "--sigma", "1")
    assert told.exit_code == 2 and "--sigma: found it beside" in words(told.output)


def test_the_wrong_measurement_of_the_example_is_named(tmp_path):
    told = run("adjust", "--out", tmp_path / "out")
    assert told.exit_code == 1
    assert "distance 3-2 is wrong" in told.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("points.csv", "measurements.csv", "summary.json"),
    }


def test_legs_of_one_line_are_named_together(tmp_path):
    """Of a point between two legs nothing tells which is wrong."""
    net = "from,to,difference,sigma\n" + "".join(
        f"{a},{b},{rise},0.001\n"
        for a, b, rise in (
            ("a", "m", 1),
            ("m", "b", 1.02),
            ("a", "b", 2),
            ("a", "b", 2),
        )
    )
    told = adjusted(tmp_path, net, "point,Z\na,10\n")
    assert told["wrong"] == ["a-m", "m-b"] and not told["usable"]


@pytest.mark.slow
def test_the_promise_of_a_net(tmp_path):
    """A free net has the intervals and verdicts of the same net with a known point."""
    ask = ("--sigma", "0.3", "--promise", "300", "--size", "8")
    found = adjusted(tmp_path, MIKHAIL, "point,Z\nA,800\n", *ask)["promise"]
    free = adjusted(tmp_path, MIKHAIL, "", *ask)["promise"]
    shares = [found[name]["said"] for name in ("fits", "named", "several")]
    assert sum(shares) == pytest.approx(1) and found["named"]["right"] > 0.9
    for name in ("fits", "named", "several", "accepted", "exactly_right"):
        assert found[name] == pytest.approx(free[name], nan_ok=True)
    shown = run("adjust", tmp_path / "network.csv", *ask)
    said = "In 300 simulated networks like this one, with a wrong measurement of 8"
    assert said in words(shown.stdout)
    told = run("adjust", "--promise", "100", "--wrong", "0")
    assert (
        "In 100 simulated networks like this one, with no wrong measurement"
        in words(told.stdout)
    )


def test_points_that_nothing_joins_to_known_ones_are_named(tmp_path):
    apart = MIKHAIL + "P,Q,1.5,2.0\nQ,R,0.5,2.0\nP,R,2.0,2.0\n"
    (tmp_path / "network.csv").write_text(apart)
    (tmp_path / "points.csv").write_text("point,Z\nA,800\n")
    told = run("adjust", tmp_path / "network.csv", "--points", tmp_path / "points.csv")
    assert told.exit_code == 1
    assert "not determined: nothing tells where the points P, Q, R" in words(
        told.stdout
    )


@pytest.mark.parametrize("option", ["--wrong", "--size"])
def test_errors_of_no_simulation_are_refused(option):
    told = run("adjust", option, "2")
    assert told.exit_code == 2
    assert f"{option}: found it without --promise" in words(told.stderr)


def test_a_promise_of_vectors_is_refused(tmp_path):
    (tmp_path / "network.csv").write_text("from,to,dX,dY,dZ,sigma\na,b,1,2,3,1\n")
    told = run("adjust", tmp_path / "network.csv", "--promise", "100")
    assert told.exit_code == 2
    assert "--promise: found it with several numbers together: vector, line 2" in words(
        told.output
    )


@pytest.mark.parametrize(
    ("network", "said"),
    [
        ("from,to,difference\na,b,1\n", "line 2, column sigma: found nothing"),
        ("from,to,value,sigma\na,b,1,1\n", "column kind: found no such column"),
        ("kind,from,to,value,sigma\nslant,a,b,1,1\n", "column kind: found 'slant'"),
        ("kind,from,to,value,sigma\nheight,a,a,1,1\n", "column to: found 'a'"),
        ("kind,from,to,value,sigma\nheight,a,b,1,0\n", "expected a number above 0"),
        ("kind,from,to,value,sigma\nangle,a,b,1,1\n", "column other: found no such"),
        ("from,to,dX,dY,dZ,sigma\na,b,1,2,x,1\n", "column dz: found 'x'"),
        (
            "from,to,dX,dY,dZ,sX,sY,sZ,cXY\na,b,1,2,3,1,1,1,2\n",
            "a covariance matrix that is not positive",
        ),
        (
            "kind,from,to,value,sigma\ndistance,a,b,1,1\n",
            "no approximate coordinates of point 'a'",
        ),
    ],
)
def test_bad_tables_say_where(network, said, tmp_path):
    (tmp_path / "network.csv").write_text(network)
    told = run("adjust", tmp_path / "network.csv", "--out", tmp_path / "out")
    assert told.exit_code == 2 and said in words(told.output), told.output
    assert not (tmp_path / "out").exists()


def compare(folder, *options):
    lines, points = gemael.as_tables()
    (folder / "network.csv").write_text(lines)
    (folder / "points.csv").write_text(points)
    known = "--points", folder / "points.csv"
    return run("compare", folder / "network.csv", *known, *options)


def test_procedures_are_compared_on_a_network(tmp_path):
    out = tmp_path / "scores.csv"
    asked = ("--procedure", "named-sets", "--procedure", "data-snooping")
    settings = ("--errors", "0,1", "--size", "8", "--trials", "100", "--out", out)
    told = compare(tmp_path, *asked, *settings)
    assert told.exit_code == 0, told.output
    assert "16 measurements, 100 networks a row" in words(told.stdout)
    found = rows(out)
    assert [row["procedure"] for row in found] == ["named-sets", "data-snooping"] * 2
    assert [row["errors"] for row in found] == ["0", "0", "1", "1"]
    shares = [float(row["noticed"]) for row in found]
    assert shares[0] == shares[1] < 0.2 < 0.8 < shares[2] == shares[3]
    assert found[0]["found"] == "" and float(found[2]["exactly_se"]) > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--procedure", "ransac"),
            "--procedure: found 'ransac'; expected of a network",
        ),
        (("--errors", "6"), "--errors: found 6; expected less than the 6 degrees"),
        (("--false-alarms", "0"), "--false-alarms: found 0.0"),
        (("--plot", "a.png"), "--plot: found it with a network"),
        (("--focal", "100"), "a network has no camera"),
    ],
)
def test_what_a_comparison_of_networks_has_not(options, said, tmp_path):
    told = compare(tmp_path, *options)
    assert told.exit_code == 2 and said in words(told.output), told.output


@pytest.mark.slow
def test_the_simulated_job_is_that_of_the_program():
    """The example with new errors in its measurements, adjusted and judged as it is:
    the same measurements are named as by the linear job of the promise."""
    done = calculate(Options())
    network = done.solution.network
    rng = np.random.default_rng(5)
    count, n = 80, len(done.lines)
    errors = rng.normal(size=(count, n))
    errors[np.arange(count), rng.integers(0, n, count)] += 7.0
    found = repeat_job(done.rows, errors, level=done.level)
    residuals = done.rows.residuals
    sizes = np.cumsum([len(part.at) for part in network.measured])[:-1]
    same = 0
    for k, e in enumerate(errors):
        parts = zip(network.measured, np.split(residuals + e, sizes), strict=True)
        measured = tuple(
            part._replace(values=part.values + part.roots[:, :, 0] * off[:, None])
            for part, off in parts
        )
        again = replace(
            done, solution=adjust_network(network._replace(measured=measured))
        )
        same += np.flatnonzero(found.named[k]).tolist() == again.wrong
    assert same >= count - 1
    assert 0.2 * count < np.sum(np.sum(found.named, axis=1) == 1) < count


KNOWN = (
    "point,X,Y,Z,sX,sY,sZ\na,,,1,0,0,.1\nb,,,2,0,0,.1\nc,5,6,3,.1,.1,.1\nd,,,4,0,0,0\n"
)


@pytest.mark.parametrize(
    ("covariances", "said"),
    [
        ("a,b,zz,0.001\n", "line 2: found"),
        ("a,e,0.001\n", "line 2, column other: found 'e', whose Z is not known"),
        ("a,d,0.001\n", "found 'd', whose Z is not known with a deviation"),
        ("a,a,0.001\n", "found the variance of a coordinate"),
        ("a,b,0.001\nb,a,0.001\n", "this covariance again (first on line 2)"),
        ("a,c,0.001\n", "points that are known in different coordinates"),
        ("a,b,0.02\n", "a covariance matrix that is not positive"),
    ],
)
def test_bad_covariances_say_where(covariances, said, tmp_path):
    (tmp_path / "net.csv").write_text("from,to,difference,sigma\na,b,1,0.1\n")
    (tmp_path / "points.csv").write_text(KNOWN)
    (tmp_path / "covariances.csv").write_text("point,other,cZZ\n" + covariances)
    tables = "--points", tmp_path / "points.csv"
    tables += "--covariances", tmp_path / "covariances.csv"
    told = run("adjust", tmp_path / "net.csv", *tables)
    assert told.exit_code == 2 and said in words(told.output), told.output
