"""Whatever stands in a file: it is read, by both readers alike, or refused in one short
sentence."""

import random
import sqlite3
from contextlib import closing

import pytest
from mutants import mutants

from jaxro.tables import cameras, csv as tables
from jaxro.tables.examples import pair as example
from jaxro.tables.fields import TableError, tell
from jaxro.tables.measured import COORDINATES

PIECES = (
    *('"', '""', '"a"', ' "a" ', '"a,b"', '"a;b"', '"\n"', "'", ",", ";", "\n", "\r"),
    *("\r\n", "\t", " ", "\0", "\x1b[2J", "\u202e", "\u2028", "\x85", "\xa0", "é", ""),
    *("1e400", "nan", "inf", "-0", "0x10", "1_0", "1.5e3", ".5", "5.", "+1", "1,5"),
    *("9" * 400, "pair", "sigma", "point,point", "x_left", "#", "\ufeff", "NULL"),
)
HEADER, *POINTS = example.TABLE.strip().splitlines()
QUOTED = [f'"p","q {k}",{line.split(",", 1)[1]}' for k, line in enumerate(POINTS)]
TABLE = "\n".join([f"pair,{HEADER}", *(f"p,{line}" for line in POINTS), *QUOTED])

TOML = """
[left]
focal = 152.113
principal_point = [0.01, -0.02]
pixel_size = 0.01

[right]
focal = 152.0
y_down = true
"""
TOML_PIECES = (
    *("[", "]", "[[", "{", "}", "=", '"', '"""', "'", ",", "\n", "#", ".", "\\u0000"),
    *("[" * 5000, "{a=" * 2000, "9" * 5000, "0x" + "f" * 400, "1e999", "nan", "-inf"),
    *("1979-05-27", "true", "a.b.c.d", "focal = 1", "[left]", "[photo.a]", "\x00", "é"),
)


def message(error):
    """What is told, which is one short sentence."""
    told = str(error)
    assert len(told) < 1000 and tell(told) == told
    return told


def by_lines(path):
    try:
        table = tables.read(path)
    except TableError as error:
        return message(error)
    return [
        (pair.name, point, *row)
        for pair in table.pairs
        for point, row in zip(pair.points, pair.rows, strict=True)
    ]


def by_columns(path):
    from jaxro.tables import conversion, parquet

    target = path.with_suffix(".parquet")
    try:
        conversion.convert(path, target)
        found = parquet.Source(target, path)
        scan = found.scan()
        table = found.read(scan.begins)
    except TableError as error:
        return message(error)
    return list(
        zip(
            [scan.names[int(k)].as_py() for k in table.owners],
            table.points.to_pylist(),
            *(column.to_pylist() for column in table.numbers.values()),
            strict=True,
        )
    )


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_both_readers_of_csv_agree(separator, tmp_path, count=300):
    """But for what only one of them looks for: points that come twice, pairs that come
    in two parts."""
    pytest.importorskip("pyarrow")
    text = TABLE
    if separator != ",":
        text = TABLE.replace(",", separator).replace(".", ",")
    path = tmp_path / "mutant.csv"
    for changed in mutants(text, PIECES, count):
        path.write_bytes(changed.encode())
        one, other = by_lines(path), by_columns(path)
        if isinstance(one, str) and "a second time in pair" in one:
            continue
        if isinstance(other, str) and "after other pairs" in other:
            continue
        assert one == other, changed


def test_cameras_are_read_or_refused(tmp_path, count=1000):
    path = tmp_path / "mutant.toml"
    for changed in mutants(TOML, TOML_PIECES, count):
        path.write_bytes(changed.encode())
        try:
            found = cameras.read(path)
        except TableError as error:
            message(error)
        else:
            assert found.left is None or found.left.focal > 0


def test_colmap_databases_are_read_or_refused(tmp_path, count=300):
    """Any value of any type in any column."""
    pytest.importorskip("pycolmap")
    from jaxro.colmap.transaction import open_database

    values = (
        *(None, "text", b"", b"bytes", -1, 0, 1, 2, 7, 0.5, 1e300, 2**62, -(2**63)),
        *("\x1b[2J", "x" * 5000, b"\xff" * 5000),
    )
    rng = random.Random(0)
    for number in range(count):
        path = tmp_path / f"{number}.db"
        with closing(sqlite3.connect(path)) as connection:
            for line in SCHEMA:
                connection.execute(line)
            for table, rows in ROWS.items():
                marks = ", ".join("?" * len(rows[0]))
                connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)
            for _ in range(rng.randint(1, 2)):
                table = rng.choice(list(ROWS))
                columns = [
                    r[1] for r in connection.execute(f"PRAGMA table_info({table})")
                ]
                row = rng.choice(ROWS[table])[0]
                change = f"UPDATE {table} SET {rng.choice(columns)} = ? WHERE rowid = "
                place = f"(SELECT rowid FROM {table} WHERE {columns[0]} = ?)"
                connection.execute(change + place, (rng.choice(values), row))
            connection.commit()
        try:
            with open_database(path, None, True) as database:
                ids = [pair_id for pair_id, _ in database.pair_ids()]
                images = database.images(ids)
                database.cameras(images, True)
                keypoints = database.keypoints(images)
                counts = {n: len(points) for n, points in keypoints.items()}
                list(database.matches(ids, counts))
        except TableError as error:
            message(error)


SCHEMA = (
    # without types: SQLite takes any value anywhere
    "CREATE TABLE cameras (camera_id, model, width, height, params, "
    "prior_focal_length)",
    "CREATE TABLE images (image_id, name, camera_id)",
    "CREATE TABLE keypoints (image_id, rows, cols, data)",
    "CREATE TABLE matches (pair_id, rows, cols, data)",
    "CREATE TABLE two_view_geometries (pair_id, rows, cols, data, config)",
)
BOTH = 2147483647 + 2
ROWS = {
    "cameras": [(1, 0, 640, 480, bytes.fromhex("0000000000408f40") * 3, 1)],
    "images": [(1, "one.jpg", 1), (2, "two.jpg", 1)],
    "keypoints": [(k, 4, 2, b"\0\0\x80\x3f" * 8) for k in (1, 2)],
    "matches": [(BOTH, 4, 2, b"\1\0\0\0" * 8)],
}


def test_parquet_tables_are_read_or_refused(tmp_path, count=300):
    """Whatever byte is another one."""
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    from jaxro.tables import parquet

    rng, path = random.Random(0), tmp_path / "mutant.parquet"
    numbers = {name: [0.5 * k for k in range(16)] for name in COORDINATES}
    names = {"pair": ["a"] * 8 + ["b"] * 8, "point": [str(k % 8) for k in range(16)]}
    pq.write_table(pa.table(names | numbers), path, row_group_size=5)
    content = path.read_bytes()
    for _ in range(count):
        changed = bytearray(content)
        for _ in range(rng.choice((1, 1, 2, 5))):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        path.write_bytes(changed[: rng.choice((len(changed), rng.randrange(9999)))])
        try:
            source = parquet.Source(path)
            table = source.read(source.scan().begins)
            assert len(table.points) == table.begins[-1]
        except TableError as error:
            message(error)
        except parquet.DAMAGED:
            pass  # the command says so in a sentence
