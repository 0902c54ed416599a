"""CSV and Parquet tables of the same pairs go the same way: the figures are the same to
the last digit, for one pair, a few, and many."""

import csv
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from jaxro.cli import app

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

FOCAL = 100.0
COUNTS = {"one": 1, "few": 3, "many": 70}
TABLES = ("elements", "residuals", "points", "reliability")
TEXTS = {"pair", "point", "result"}


def measure(pairs: int) -> dict[str, list]:
    """Columns of near-vertical pairs of 8 to 12 points with errors of 0.01 mm, every
    second of them with a wrong point."""
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
        columns["pair"] += [f"p{k:03}"] * count
        columns["point"] += [str(i) for i in range(count)]
        for name, values in zip(
            list(columns)[2:], (*left_image.T, *right_image.T), strict=True
        ):
            columns[name] += values.tolist()
    return columns


@pytest.fixture(scope="module", params=COUNTS)
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
    """The exit codes of both tables."""
    codes = []
    for kind in ("csv", "parquet"):
        options = ("--focal", FOCAL, "--out", folder / f"{command}_{kind}", *more)
        if kind == "parquet":
            options = (*options, "--tables", ",".join(TABLES))
        arguments = (command, folder / f"table.{kind}", *options)
        result = CliRunner().invoke(app, [*map(str, arguments)])
        assert result.exit_code in (0, 1), result.output
        codes.append(result.exit_code)
    return codes


def assert_same(folder, command, table, without=()):
    """Every column that both files have holds the same values in both."""
    found = pq.read_table(folder / f"{command}_parquet" / table)
    with (folder / f"{command}_csv" / f"{table}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found.num_rows
    shared = set(found.column_names) & set(rows[0]) - set(without)
    assert set(found.column_names) - shared <= {"used", "outcome", "kept", "undecided"}
    for name in shared:
        texts = [row[name] for row in rows]
        for text, value in zip(texts, found.column(name).to_pylist(), strict=True):
            if name in TEXTS:
                assert text == value
            elif isinstance(value, bool):
                assert text == str(value).lower()
            elif value is None or (math.isinf(value) and not text):
                assert not text, name
            else:
                assert float(text) == value, name


def test_oriented_pairs_have_the_same_figures(folder):
    first, second = run("orient", folder)
    assert first == second
    for table in TABLES:
        assert_same(folder, "orient", table)


def test_cleaned_pairs_have_the_same_figures(folder):
    first, second = run("clean", folder, "--procedure", "three-sigma")
    assert first == second
    for table in (*TABLES, "cleaned"):
        assert_same(folder, "clean", table)
