"""`jaxro clean` as its user meets it: which point is wrong, every row kept, files whole
or none."""

import json
import math

import command_line
import numpy as np
import pytest
import scenes
from bad_tables import write
from command_line import rows, words

import jaxro
from jaxro.commands import tolerances
from jaxro.geometry import mock_pairs
from jaxro.rejection import OUTCOMES, PROCEDURES, Dorozhinsky, TwoStage
from jaxro.reports import columns, verdicts
from jaxro.tables import csv as tables
from jaxro.tables.examples import mock_pair as mock_example

FILES = {
    "cleaned.csv",
    "decisions.csv",
    "decisions.json",
    "elements.csv",
    "residuals.csv",
    "points.csv",
    "reliability.csv",
    "summary.json",
}
FOCAL = ["--focal", str(mock_example.FOCAL)]
PLAIN = ["--procedure", "three-sigma"]
"""The quickest to compile."""


def run(*arguments):
    return command_line.run("clean", *arguments)


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """The example as a user's file."""
    return write(tmp_path_factory.mktemp("sample"), mock_example.TABLE, "mock.csv")


@pytest.fixture(scope="module")
def cleaned(sample, tmp_path_factory):
    """The example cleaned by the algorithm of 1971, and its files."""
    out = tmp_path_factory.mktemp("cleaned") / "new" / "out"
    return run(sample, *FOCAL, "--procedure", "dorozhinsky", "--out", out), out


def test_the_wrong_point_is_named_with_its_evidence(cleaned):
    result, _ = cleaned
    assert result.exit_code == 0 and not result.stderr
    told = words(result.stdout)
    assert "Cleaning of mock by dorozhinsky: 1 of 12 points rejected" in told
    # order, |q| after one correction against eps3, q at the orientation of the other
    # eleven: the error with its sign
    assert "7 1 0.6841 0.1 -1.08" in told
    assert (
        "Relative orientation of mock, 11 points" in told
        and "6 degrees of freedom" in told
    )


def test_every_row_is_kept_with_its_verdict(cleaned, sample):
    _, out = cleaned
    assert {path.name for path in out.iterdir()} == FILES and len(
        list(out.parent.iterdir())
    ) == 1
    (measured,) = tables.read(sample).pairs
    written = rows(out / "cleaned.csv")
    assert [row["point"] for row in written] == measured.points
    numbers = [[float(row[c]) for c in measured.numbers] for row in written]
    np.testing.assert_array_equal(numbers, measured.rows)
    verdicts = {row["point"]: (row["verdict"], row["order"]) for row in written}
    assert verdicts == {
        **dict.fromkeys(measured.points, ("kept", "")),
        "7": ("rejected", "1"),
    }
    residuals = {
        row["point"]: float(row["q_mm"]) for row in rows(out / "residuals.csv")
    }
    assert list(residuals) == [p for p in measured.points if p != "7"]
    for row in written:
        assert (float(row["statistic"]) > float(row["limit"])) == (
            row["verdict"] == "rejected"
        )
        if row["point"] != "7":
            assert math.isclose(
                float(row["q_mm"]), residuals[row["point"]], abs_tol=1e-12
            )
    assert abs(float(written[6]["q_mm"]) + 1.1) < 0.03


@pytest.mark.slow
def test_the_log_is_that_of_python_to_the_last_digit(cleaned, sample):
    _, out = cleaned
    (measured,) = tables.read(sample).pairs
    pair = jaxro.pair(
        *measured.coordinates, focal=mock_example.FOCAL, sigma=measured.sigma
    )
    of_pair, of_points = jaxro.clean_batch(
        jaxro.stack([pair]), Dorozhinsky(), select=verdicts.with_log
    )
    every = of_pair["rounds"] | of_points["rounds"]
    found = {name: np.asarray(values[0]) for name, values in every.items()}
    happened = found["happened"]
    log = rows(out / "decisions.csv")
    numbers = [int(row["round"]) for row in log]
    assert sorted(set(numbers)) == list(range(1, happened.sum() + 1))
    assert (
        numbers.count(1) == 12 and numbers.count(happened.sum()) == 11
    )  # a rejected point is in no later round
    table = {(int(row["round"]), row["point"]): row for row in log}
    for number, place in enumerate(np.flatnonzero(happened), 1):
        limit = float(found["limit"][place])
        for i, name in enumerate(measured.points):
            row = table.get((number, name))
            if row is None:
                continue
            wanted = found["statistic"][i, place], found["parallax"][i, place]
            assert (float(row["statistic"]), float(row["parallax_mm"])) == tuple(
                map(float, wanted)
            )
            assert (row["limit"] == "") == math.isinf(limit) and (
                not row["limit"] or float(row["limit"]) == limit
            )
            assert (row["rejected"] == "true") == bool(found["rejected"][i, place])
    summary = json.loads(
        (out / "decisions.json").read_text(), parse_constant=pytest.fail
    )
    assert (
        summary["procedure"] == "dorozhinsky" and summary["tolerances"]["eps3"] == 0.1
    )
    (only,) = summary["pairs"]
    assert (only["outcome"], only["rejected"], only["order"]) == (
        "finished",
        1,
        [["7"]],
    )
    elements = [
        [row[f"{n}_deg"] for n in jaxro.IndependentElements.names]
        for row in only["elements"]
    ]
    np.testing.assert_array_equal(elements, np.rad2deg(found["elements"][happened]))


def table_1(points):
    """Lines of the pair of table 1 (1971) with so many points."""
    flat = mock_pairs.mock_pair(mock_pairs.standard_layout(points))
    errors = np.array([0, 0, 0, 0, 0, 0, 2.0, 2.2, -2.43, -1.90])[:points]
    columns = np.stack(
        [np.asarray(c) for c in mock_pairs.plant(flat, y_right=errors).coordinates],
        axis=-1,
    )
    return [
        f"{i}," + ",".join(map(repr, map(float, row)))
        for i, row in enumerate(columns, 1)
    ]


@pytest.mark.slow
def test_many_pairs_keep_their_rows_in_order_and_say_what_is_left_to_do(tmp_path):
    example = [line.rsplit(",", 1)[0] for line in mock_example.TABLE.split()[1:]]
    pairs = {"good": example, "[four]": example[:4], "1971": table_1(10)}
    lines = [
        f"{name},{pairs[name][i]}"
        for i in range(12)
        for name in pairs
        if i < len(pairs[name])
    ]
    path = write(
        tmp_path,
        "pair,point,x_left,y_left,x_right,y_right\n" + "\n".join(lines),
        "pairs.csv",
    )
    out = tmp_path / "out"
    strict = [
        "--procedure",
        "dorozhinsky",
        "--tolerance",
        "eps3=0.01",
        "--tolerance",
        "eps4 = 0.02",
    ]
    result = run(path, *FOCAL, *strict, "--out", out)
    assert result.exit_code == 1
    told = words(result.stdout)
    assert (
        "OPERATOR_NEEDED 1971 (1 pair)" in told
        and "NOT_ORIENTED [four] (1 pair)" in told
    )
    assert "finished (1 pair)" in told and "good 7 1 0.6841 0.01 -1.08" in told
    written = rows(out / "cleaned.csv")
    assert [(row["pair"], row["point"]) for row in written] == [
        tuple(line.split(",")[:2]) for line in lines
    ]
    order = {
        (row["pair"], row["point"]): row["order"]
        for row in written
        if row["verdict"] == "rejected"
    }
    assert order == {
        ("good", "7"): "1",
        ("1971", "9"): "1",
        ("1971", "4"): "2",
        ("1971", "6"): "3",
        ("1971", "3"): "4",
    }
    # what does not exist is an empty cell: the parallax of a pair that is not oriented
    assert {bool(row["q_mm"]) for row in written if row["pair"] == "[four]"} == {False}
    outcomes = {
        p["pair"]: p["outcome"]
        for p in json.loads((out / "decisions.json").read_text())["pairs"]
    }
    assert outcomes == {
        "good": "finished",
        "[four]": "not_oriented",
        "1971": "operator_needed",
    }
    elements = {row["pair"]: row for row in rows(out / "elements.csv")}
    assert {name: row["points"] for name, row in elements.items()} == {
        "good": "11",
        "[four]": "4",
        "1971": "6",
    }
    assert len(rows(out / "residuals.csv")) == 11 + 4 + 6


BAD_OPTIONS = {
    "unknown procedure": (["--procedure", "guess"], ["'guess'", *PROCEDURES]),
    "unknown tolerance": (
        [*PLAIN, "--tolerance", "eps=1"],
        ["'eps'", "factor=3.0", "more_than=9", "least=6"],
    ),
    "no value": (
        [*PLAIN, "--tolerance", "factor"],
        ["'factor' without =", "factor=3.0"],
    ),
    "two meanings": (
        ["--procedure", "two-stage", "--tolerance", "least=7"],
        ["first.least or second.least"],
    ),
    "no number": ([*PLAIN, "--tolerance", "factor=x"], ["factor=x", "a number"]),
    "negative": ([*PLAIN, "--tolerance", "factor=-1"], ["factor=-1", "not negative"]),
    "half a point": (
        [*PLAIN, "--tolerance", "least=6.5"],
        ["least=6.5", "a whole number"],
    ),
    "nothing is above it": (
        ["--tolerance", "level=1.5"],
        ["level=1.5", "between 0 and 1"],
    ),
    "all are above it": (
        ["--procedure", "igg3", "--tolerance", "limit=0"],
        ["limit=0", "above 0"],
    ),
    "empty": (["--procedure", ""], ["''", *PROCEDURES]),
    "infinite": ([*PLAIN, "--tolerance", "factor=inf"], ["factor=inf"]),
    "no focal length": (PLAIN, ["neither --focal nor --camera"]),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options_write_nothing(case, sample, tmp_path):
    options, found = BAD_OPTIONS[case]
    focal = [] if case == "no focal length" else FOCAL
    result = run(sample, *focal, *options, "--out", tmp_path / "out")
    assert result.exit_code == 2 and not result.stdout and not list(tmp_path.iterdir())
    assert all(text in result.stderr for text in found), result.stderr


def test_what_judges_by_sigma_is_not_run_without_one(tmp_path):
    path = write(
        tmp_path,
        mock_example.TABLE.replace(",.003", "").replace(",sigma", ""),
        "pairs.csv",
    )
    result = run(
        path, *FOCAL, "--procedure", "data-snooping", "--out", tmp_path / "out"
    )
    assert (
        result.exit_code == 2
        and "--sigma" in result.stderr
        and list(tmp_path.iterdir()) == [path]
    )
    assert not tolerances.judges_by_sigma(PROCEDURES["tau"])


def test_tolerances_reach_every_part():
    changed = tolerances.change(
        TwoStage(), ["eps3=0.2", "second.level=0.01", "exact=false", "first.least=7"]
    )
    assert (
        changed.first == Dorozhinsky(eps3=0.2, least=7)
        and type(changed.first.least) is int
    )
    assert (changed.second.level, changed.second.exact, changed.second.least) == (
        0.01,
        False,
        6,
    )
    for procedure in PROCEDURES.values():
        for name, value in tolerances.tolerances(procedure).items():
            text = "0.5" if value is None else str(value).lower()
            after = tolerances.tolerances(
                tolerances.change(procedure, [f"{name}={text}"])
            )
            assert after == {
                **tolerances.tolerances(procedure),
                name: 0.5 if value is None else value,
            }


def test_every_outcome_has_a_name_and_advice():
    number = int(OUTCOMES.finished._value)
    assert columns.OUTCOME_NAMES[number] == "finished"
    assert not columns.OUTCOME_ADVICE["finished"]
    assert all(
        columns.OUTCOME_ADVICE[name]
        for name in ("operator_needed", "nothing_to_test", "not_oriented")
    )


@pytest.mark.slow
def test_points_that_nothing_tells_apart_are_named(tmp_path):
    """An error in one of four points that stand alone in their zones: in the report,
    the tables and the summary."""
    layout = mock_pairs.standard_layout(8)
    # the last two beside the third and the fourth, not at their places
    layout = layout._replace(x=(*layout.x[:6], 0.05, 0.95))
    flat = mock_pairs.plant(mock_pairs.mock_pair(layout), y_right=np.eye(8)[0] * 0.4)
    columns = np.stack([np.asarray(c) for c in flat.coordinates], axis=-1)
    lines = [
        f"{name},{','.join(map(repr, map(float, row)))}"
        for name, row in zip("abcdefgh", columns, strict=True)
    ]
    path = write(
        tmp_path,
        "point,x_left,y_left,x_right,y_right\n" + "\n".join(lines),
        "eight.csv",
    )
    out = tmp_path / "out"
    result = run(
        path,
        "--focal",
        70,
        "--sigma",
        0.01,
        "--procedure",
        "data-snooping",
        "--out",
        out,
    )
    assert result.exit_code == 1
    told = words(result.stdout)
    assert (
        "0 of 8 points rejected" in told
        and "wrong is one of a, b, e, f; nothing tells which" in told
    )
    assert "UNDECIDED eight" in told
    verdicts = {row["point"]: row["verdict"] for row in rows(out / "cleaned.csv")}
    assert verdicts == {
        **dict.fromkeys("abcdefgh", "kept"),
        **dict.fromkeys("abef", "undecided"),
    }
    (only,) = json.loads((out / "decisions.json").read_text())["pairs"]
    assert (only["outcome"], only["undecided"], only["order"]) == (
        "undecided",
        ["a", "b", "e", "f"],
        [],
    )


@pytest.fixture(scope="module")
def two_scenes(tmp_path_factory):
    """A table of a pair of photographs with two scenes and one with one, and how to clean
    it."""
    parts = scenes.two_scenes(1, 50, 40, 100, seed=1), scenes.photographs(1, 84, 0.5)
    lines = ["pair,point,x_left,y_left,x_right,y_right"]
    focal = float(parts[0].focal[0])
    for name, part in zip(("two", "one"), parts, strict=True):
        photos = np.stack(part.coordinates)[:, 0] * focal / part.focal[0]
        numbers = enumerate(photos.T.tolist(), 1)
        lines += [f"{name},{k}," + ",".join(map(repr, xy)) for k, xy in numbers]
    path = write(tmp_path_factory.mktemp("two"), "\n".join(lines), "two.csv")
    return path, ["--focal", repr(focal), "--sigma", "1"]


@pytest.mark.slow
def test_several_solutions_are_told_with_their_points(two_scenes, tmp_path):
    """In words, in the JSON and on the page of the report: the pair is not usable."""
    table, how = two_scenes
    out, page = tmp_path / "out", tmp_path / "report.html"
    result = run(table, *how, "--out", out, "--report", page)
    assert result.exit_code == 1, result.stderr
    told, said = words(result.stdout), "points agree with base ("
    assert told.count(said) == 2 and "several_solutions (1: two)" in told
    assert words(page.read_text()).count(said) == 2
    two, one = json.loads((out / "decisions.json").read_text())["pairs"]
    assert one["solutions"] == []
    kept, other = two["solutions"]
    assert f"two: {len(kept['points'])} {said}" in told
    assert f"two: {len(other['points'])} {said}" in told
    rejected = {point for points in two["order"] for point in points}
    assert set(other["points"]) < rejected and not set(kept["points"]) & rejected
    assert len(kept["points"]) >= 45 and len(other["points"]) >= 25
    assert 0 < kept["probability"] < other["probability"] < 1e-3
    base = [other["elements"][name] for name in ("bx", "by", "bz")]
    assert np.linalg.norm(base) == pytest.approx(1)
    usable = json.loads((out / "summary.json").read_text())["pairs"]
    assert [pair["result"] for pair in usable] == ["several_solutions", "successful"]


@pytest.mark.slow
def test_the_promise_of_the_intervals_is_told(sample):
    """Of an error that is always found they hold what they say, in words and in the
    JSON."""
    how = [
        *FOCAL,
        "--procedure",
        "data-snooping",
        "--promise",
        "300",
    ]
    result = run(sample, *how, "--json")
    assert result.exit_code == 0, result.stderr
    (only,) = json.loads(result.stdout)["orientation"]["pairs"]
    told = only["promise"]
    assert told["repetitions"] == 300 and told["confidence"] == 0.95
    assert set(told["intervals"]) == set(only["elements"])
    assert told["exactly_right"] > 0.9 and 0.9 < told["region"] < 0.99
    assert all(0.88 < share <= 1 for share in told["intervals"].values())
    assert "In 300 simulated pairs like this one" in words(run(sample, *how).stdout)


def test_a_promise_needs_repetitions_and_a_table_at_once(sample):
    few = run(sample, *FOCAL, "--promise", "5")
    assert few.exit_code == 2 and "--promise" in words(few.stderr)
    parts = run(sample, *FOCAL, "--promise", "100", "--parquet", "--out", "never")
    assert parts.exit_code == 2 and "has no --promise" in words(parts.stderr)
