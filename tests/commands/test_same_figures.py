"""CSV and Parquet tables of the same pairs go the same way: the figures are the same to
the last digit, for one pair, a few, and many, which are worked on in parts."""

import csv
import json
import math
from functools import partial

import command_line
import numpy as np
import pytest

from jaxro.commands import large
from jaxro.tables.measured import COORDINATES

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

FOCAL = 100.0
COUNTS = {"one": 1, "few": 3, "many": 70}
TABLES = ("elements", "residuals", "points", "reliability")
TEXTS = {"pair", "point", "result", "causes"}
ONLY_PARQUET = {"used", "outcome", "kept", "undecided", "other_solution"}
ONLY_CSV = {"advice", "verdict", *(f"control_{c}" for c in COORDINATES)}
PART_ROWS = 200


@pytest.fixture(scope="module", autouse=True)
def small_parts():
    """Many pairs make four parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(large, "Large", partial(large.Large, part_rows=PART_ROWS))
        yield


def measure(pairs: int) -> dict[str, list]:
    """Columns of near-vertical pairs of 8 to 12 points with errors of 0.01 mm, every
    second of them with a wrong point. Of pair 2 the right photo is mirrored, of pair 4
    the origin lies in a corner."""
    rng = np.random.default_rng(7)
    columns: dict[str, list] = {
        name: [] for name in ("pair", "point", "x_left", "y_left", "x_right", "y_right")
    }
    for k in range(pairs):
        count = int(rng.integers(8, 13))
        low, high = (-20, -60, -110), (80, 60, -90)
        ground = rng.uniform(low, high, (count, 3))
        right = ground - (60.0, 0.0, 0.0)
        right = right + np.cross(rng.uniform(-0.03, 0.03, 3), right)
        left_image, right_image = (
            -FOCAL * p[:, :2] / p[:, 2:] + 0.01 * rng.normal(size=(count, 2))
            for p in (ground, right)
        )
        right_image[0, 1] += k % 2
        if k == 2:
            right_image[:, 1] *= -1
        if k == 4:
            left_image, right_image = (
                photo - np.min(photo, axis=0) + 1 for photo in (left_image, right_image)
            )
        columns["pair"] += [f"p{k:03}"] * count
        columns["point"] += [str(i) for i in range(count)]
        for name, values in zip(
            list(columns)[2:], (*left_image.T, *right_image.T), strict=True
        ):
            columns[name] += values.tolist()
    return columns


@pytest.fixture(
    scope="module",
    params=[
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("one", "few")),
        "many",
    ],
)
def folder(request, tmp_path_factory):
    """The same measurements as table.csv and table.parquet."""
    columns = measure(COUNTS[request.param])
    folder = tmp_path_factory.mktemp(request.param)
    pq.write_table(pa.table(columns), folder / "table.parquet")
    with (folder / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows(
            [list(columns), *zip(*columns.values(), strict=True)]
        )
    return folder


def run(command, folder, *more):
    """The exit codes of both tables, and of CSV with Parquet results."""
    codes = []
    parquet = ("--tables", ",".join(TABLES))
    for kind, results in (("csv", ()), ("parquet", parquet), ("csv", parquet)):
        name = f"{command}_{kind}" + (
            "_as_parquet" if kind == "csv" and results else ""
        )
        table = folder / f"table.{kind}"
        given = ("--focal", FOCAL, "--out", folder / name, *results, *more)
        if results:
            given = (*given, "--parquet")
        told = command_line.run(command, table, *given)
        assert told.exit_code in (0, 1), told.output
        codes.append(told.exit_code)
    return codes


def assert_same(folder, command, table, without=()):
    """Every column that both files have holds the same values in both."""
    found = pq.read_table(folder / f"{command}_parquet" / table)
    with (folder / f"{command}_csv" / f"{table}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found.num_rows
    shared = set(found.column_names) & set(rows[0]) - set(without)
    assert set(found.column_names) - shared <= ONLY_PARQUET
    assert set(rows[0]) - shared <= ONLY_CSV
    if "kept" in found.column_names:
        kept = [row["verdict"] == "kept" for row in rows]
        assert found.column("kept").to_pylist() == kept
    converted = pq.read_table(folder / f"{command}_csv_as_parquet" / table)
    assert converted.equals(found)
    for name in shared:
        texts = [row[name] for row in rows]
        for text, value in zip(texts, found.column(name).to_pylist(), strict=True):
            if name in TEXTS:
                assert text == (value or "")
            elif isinstance(value, bool):
                assert text == str(value).lower()
            elif value is None or (math.isinf(value) and not text):
                assert not text, name
            else:
                assert float(text) == value, name


@pytest.mark.slow
def test_oriented_pairs_have_the_same_figures(folder):
    assert len(set(run("orient", folder))) == 1
    for table in TABLES:
        assert_same(folder, "orient", table)
    pairs = pq.read_table(folder / "orient_parquet" / "elements").to_pylist()
    told = json.loads((folder / "orient_parquet" / "summary.json").read_text())
    if len(pairs) > 2:
        assert pairs[2]["result"] == "mirrored" and "p002" in told["causes"]
    if len(pairs) > 4:
        assert "origin" in pairs[4]["causes"]
    named = [p for p in pairs if p["causes"] or p["result"] == "mirrored"]
    assert told["pairs_wrong_as_a_whole"] == len(named)
    parts = len(list((folder / "orient_parquet" / "elements").iterdir()))
    assert (parts > 3) == (folder.name.startswith("many"))


@pytest.mark.slow
def test_cleaned_pairs_have_the_same_figures(folder):
    """Every row stays, with its verdict."""
    assert len(set(run("clean", folder, "--procedure", "three-sigma"))) == 1
    for table in (*TABLES, "cleaned"):
        assert_same(folder, "clean", table)
    measured = pq.read_table(folder / "table.parquet")
    cleaned = pq.read_table(folder / "clean_parquet" / "cleaned")
    assert cleaned.select(measured.column_names).equals(measured)
    kept = np.sum(cleaned.column("kept").to_pylist())
    assert pq.read_table(folder / "clean_parquet" / "residuals").num_rows == kept


@pytest.mark.slow
def test_what_holds_no_number_is_no_point_that_was_rejected(tmp_path):
    """And harms no other pair."""
    columns, found = measure(3), {}
    row = columns["pair"].index("p001")
    for name in ("whole", "lost"):
        if name == "lost":
            columns["x_left"][row] = None
        table, out = tmp_path / f"{name}.parquet", tmp_path / name
        pq.write_table(pa.table(columns), table)
        asked = "--focal", FOCAL, "--procedure", "three-sigma", "--out", out
        asked += ("--tables", ",".join(TABLES))  # the program of the tests above
        code = command_line.run("clean", table, *asked).exit_code
        assert code == 1 if name == "lost" else code in (0, 1)
        found[name] = pq.read_table(out / "elements").to_pylist()
    assert found["lost"][1]["result"] == "non_finite_input"
    for k in (0, 2):
        assert found["lost"][k] == found["whole"][k]
    lost = pq.read_table(tmp_path / "lost" / "cleaned").slice(row, 1).to_pylist()[0]
    assert (lost["kept"], lost["order"], lost["statistic"]) == (False, 0, np.inf)
