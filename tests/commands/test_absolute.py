"""`jaxro absolute` as its user meets it: reports, files, what is said of control that is
not enough and of bad tables."""

import numpy as np
import pytest
from bad_tables import write
from command_line import rows, run, words

from jaxro.block import absolute
from jaxro.block.absolute_model import model
from jaxro.tables import ground as grounds, model as models
from jaxro.tables.examples import absolute as example


def numbers(table, *columns):
    return np.array([[float(row[c] or "nan") for c in columns] for row in table])


@pytest.fixture
def tables(tmp_path):
    """The example as a user's files."""
    return (
        write(tmp_path, example.MODEL, "model.csv"),
        write(tmp_path, example.GROUND, "ground.csv"),
    )


def test_the_example_is_true_within_its_deviations(tables, tmp_path):
    """Files and report hold the numbers of Python; check points are compared, not
    used."""
    out = tmp_path / "out"
    told = run("absolute", tables[0], "--control", tables[1], "--out", out)
    assert told.exit_code == 0 and not told.stderr
    assert {path.name for path in out.iterdir()} == {
        *("points.csv", "control.csv", "absolute.csv")
    }
    points = rows(out / "points.csv")
    places, deviations = (
        numbers(points, *columns) for columns in (("X", "Y", "Z"), ("sX", "sY", "sZ"))
    )
    off = (places - np.array(example.TRUTH)) / deviations
    assert np.max(np.abs(off)) < 4 and 0.5 < np.sqrt(np.mean(off**2)) < 1.5
    assert [row["role"] for row in points[7:12]] == ["control", *["check"] * 3, ""]

    read = models.parse(example.MODEL, "", "")
    ground = grounds.parse(example.GROUND, "")
    given = np.full((20, 3), np.nan)
    given[:8] = ground.coordinates[:8]
    measured = model(read.coordinates, given, ground_sigma=0.03, sigma=read.deviations)
    found = absolute.orient_model(measured).check()
    np.testing.assert_allclose(places, found.points, rtol=1e-10)
    np.testing.assert_allclose(deviations, found.point_deviations(1.0), rtol=1e-6)
    (elements,) = rows(out / "absolute.csv")
    np.testing.assert_allclose(float(elements["scale"]), found.scale, rtol=1e-9)
    np.testing.assert_allclose(
        float(elements["s_omega_deg"]), np.degrees(found.deviations(1.0)[1]), rtol=1e-6
    )
    sigma0, freedom = float(found.sigma0), int(found.degrees_of_freedom)
    assert f"sigma0 {sigma0:.2f}, {freedom} degrees of freedom" in told.stdout
    control = rows(out / "control.csv")
    assert [row["role"] for row in control] == ["control"] * 8 + ["check"] * 3
    np.testing.assert_allclose(
        np.nan_to_num(numbers(control[:8], "vX", "vY", "vZ")),
        found.residuals[:8],
        atol=1e-6,
    )
    checked = numbers(control[8:], "vX", "vY", "vZ")
    np.testing.assert_allclose(
        checked, found.points[8:11] - ground.coordinates[8:], atol=1e-6
    )
    spread = np.hypot(found.point_deviations(1.0)[8:11], 0.03)
    np.testing.assert_allclose(
        numbers(control[8:], "w_X", "w_Y", "w_Z"), checked / spread, rtol=1e-5
    )
    rms = np.sqrt(np.mean(checked**2, axis=0))
    assert f"check points within X {rms[0]:.3f}, Y {rms[1]:.3f}" in words(told.stdout)


def test_without_a_table_it_shows_a_simulated_model():
    told = run("absolute")
    assert told.exit_code == 0 and "Your own model: jaxro absolute" in told.stdout
    assert "control 3 full, 2 in plan, 3 in height; 3 check points" in told.stdout


def edited(path, edit):
    """The table after each of its lines has become edit(cells), None to delete it."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    kept = [lines[0]] + [new for line in lines[1:] if (new := edit(line)) is not None]
    path.write_text("\n".join(map(",".join, kept)))


def test_a_wrong_control_point_is_named(tables):
    def edit(cells):
        return [*cells[:3], "129.942", *cells[4:]] if cells[0] == "5" else cells

    edited(tables[1], edit)
    told = run("absolute", tables[0], "--control", tables[1])
    assert told.exit_code == 0
    assert "Mind: Z of control point 5 has |w| = " in words(told.stdout)
    assert "as large as the standard deviations say" in words(told.stdout)


@pytest.mark.slow
def test_exchanged_names_are_found(tables):
    """They draw the model so far that it is refused, and no residual tells which."""
    exchange = {"1": "8", "8": "1"}
    edited(tables[1], lambda cells: [exchange.get(cells[0], cells[0]), *cells[1:]])
    told = run("absolute", tables[0], "--control", tables[1])
    assert told.exit_code == 1 and "weakly_determined" in told.stdout
    assert "Without control points 1 and 8 the others fit far better" in words(
        told.stdout
    )


def test_two_solutions_are_shown_and_either_can_be_had(tables, tmp_path):
    """Of two points and a height the other solution is the second."""
    keep = ("1", "2")

    def edit(cells):
        if cells[0] in keep:
            return cells
        return (
            ["8", "", "", cells[3], "", "", cells[6], cells[7]]
            if (cells[0] == "8")
            else None
        )

    edited(tables[1], edit)
    asked = "absolute", tables[0], "--control", tables[1], "--out"
    first = run(*asked, tmp_path / "first")
    second = run(*asked, tmp_path / "second", "--second")
    assert first.exit_code == second.exit_code == 0
    assert "two_solutions: A second position" in words(first.stdout)
    assert "other solution" in first.stdout and "--second" in first.stdout
    both = [rows(tmp_path / name / "absolute.csv") for name in ("first", "second")]
    assert [row["scale"] for row in both[0]] == [row["scale"] for row in both[1][::-1]]
    assert float(both[0][0]["r33"]) > float(both[0][1]["r33"])
    assert "upside down" in words(second.stdout) or float(both[1][0]["r33"]) > 0


def without_plan(cells):
    return [cells[0], "", "", *cells[3:4], "", "", *cells[6:]] if cells[3] else None


NOT_ENOUGH = {
    "heights alone": (without_plan, "too_few_coordinates: ", "Missing: turn about the"),
    "one point": (
        lambda cells: cells if cells[0] == "1" else None,
        "too_few_coordinates: ",
        "Missing: scale (a second point known in plan), turn about the vertical",
    ),
    "X points north": (
        lambda cells: [cells[0], cells[2], cells[1], *cells[3:]],
        "mirrored: ",
        "Exchange X and Y of the ground if X points north",
    ),
}


@pytest.mark.parametrize("case", NOT_ENOUGH)
def test_control_that_is_not_enough_says_what_to_do(case, tables, tmp_path):
    """Exit code 1, no numbers, and no table of points."""
    edit, *said = NOT_ENOUGH[case]
    edited(tables[1], edit)
    out = tmp_path / "out"
    told = run("absolute", tables[0], "--control", tables[1], "--out", out)
    assert told.exit_code == 1, told.output
    assert all(text in words(told.stdout) for text in said)
    assert [path.name for path in out.iterdir()] == ["absolute.csv"]
    (row,) = rows(out / "absolute.csv")
    assert row["result"] in said[0] and row["scale"] == ""


MODEL, GROUND, OPTIONS = 0, 1, "options"
BAD = {  # the table, what stands there, what stands there instead, said
    "a word": (GROUND, "1,4270.363", "1,far", "line 2, column x: found 'far'"),
    "point twice": (GROUND, "\n2,", "\n1,", "line 3, column point: found '1' a second"),
    "unknown role": (GROUND, "check", "tie", "column role: found 'tie'"),
    "no names in common": (GROUND, "\n", "\nk", "found no point of"),
    "no coordinate": (MODEL, "1,0.700132", "1,", "line 2, column x: found an empty"),
    "another column": (MODEL, "Z_bases", "W_bases", "column w_bases: found an unknown"),
    "sigma twice": (OPTIONS, "--sigma", "1", "--sigma: found it beside the standard"),
    "negative sigma": (OPTIONS, "--model-sigma", "-1", "--model-sigma: found -1.0"),
    "no such pair": (OPTIONS, "--pair", "1-2", "--pair: found '1-2'"),
    "no second": (OPTIONS, "--second", None, "--second: found one position"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_says_where_and_writes_nothing(case, tables, tmp_path):
    which, old, new, said = BAD[case]
    extra = []
    if which == OPTIONS:
        extra = [old] if new is None else [old, new]
    else:
        text = tables[which].read_text()
        assert old in text
        every = -1 if case == "no names in common" else 1
        tables[which].write_text(text.replace(old, new, every).rstrip("k"))
    out = tmp_path / "out"
    told = run("absolute", tables[0], "--control", tables[1], "--out", out, *extra)
    assert told.exit_code == 2, told.output
    assert said in words(told.stderr)
    assert not out.exists()


def test_control_without_error_needs_errors_of_the_model(tmp_path):
    bare = "\n".join(",".join(line.split(",")[:4]) for line in example.MODEL.split())
    file = write(tmp_path, bare, "model.csv")
    text = example.GROUND.replace("0.03,0.03,0.03,control", "0.03,0,0.03,control", 1)
    ground = write(tmp_path, text, "ground.csv")
    told = run("absolute", file, "--control", ground)
    assert told.exit_code == 2
    assert "ground.csv, line 2, column sy: found 0, and model" in words(told.stderr)
    told = run("absolute", file, "--control", ground, "--model-sigma", 5e-5)
    assert told.exit_code == 0 and "probability beside 1" in told.stdout
