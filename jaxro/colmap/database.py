"""A COLMAP database (SQLite): cameras, keypoints and matches read, two-view geometries
written, all or none.

Tables as COLMAP 3.x and 4.x make them. A pair of images has the number 2147483647 a +
b, a < b their numbers; the two columns of its matches are places among the keypoints of
a and of b, from zero. Matrices are nine doubles row by row, qvec is (w, x, y, z) and
tvec turns and moves the frame of camera a into that of b. Columns that a version does
not have are not written; tables that are not named here are not touched.
"""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..tables.fields import TableError
from ..tables.whole import check_file
from .cameras import MODELS, OTHERS, PhotoCamera

MOST_IMAGES = 2147483647
WAIT = 1.0
"""Seconds to wait for a database that something else writes to."""
NEEDED = {
    "cameras": ("camera_id", "model", "params", "prior_focal_length"),
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config"),
}
"""Tables and columns without which nothing can be done."""

Matches = Int[np.ndarray, "_ 2"]


class Image(NamedTuple):
    """An image of the database."""

    name: str
    camera: int


class Geometry(NamedTuple):
    """A row of two_view_geometries by the names of its columns; None where there is
    nothing."""

    pair_id: int
    matches: Matches
    config: int
    F: Float[np.ndarray, "3 3"] | None = None
    E: Float[np.ndarray, "3 3"] | None = None
    H: Float[np.ndarray, "3 3"] | None = None
    qvec: Float[np.ndarray, "4"] | None = None
    tvec: Float[np.ndarray, "3"] | None = None


def images_of(pair_id: int) -> tuple[int, int]:
    """(a, b) of the number of a pair."""
    return pair_id // MOST_IMAGES, pair_id % MOST_IMAGES


class Database:
    """An open database within one transaction; `file` is what errors call it."""

    def __init__(self, file: Path, connection: sqlite3.Connection):
        self.file, self._connection = file, connection
        self._columns = {table: self._columns_of(table) for table in NEEDED}

    def _columns_of(self, table: str) -> list[str]:
        found = [
            row[1] for row in self._connection.execute(f"PRAGMA table_info({table})")
        ]
        missing = [column for column in NEEDED[table] if column not in found]
        if not found:
            raise self.error(
                table,
                None,
                None,
                "no such table",
                "a database made by COLMAP 3 or later",
            )
        if missing:
            raise self.error(
                table,
                None,
                missing[0],
                "no such column",
                f"the columns {', '.join(NEEDED[table])}",
            )
        return found

    def error(
        self, table: str, row: str | None, column: str | None, found: str, expected: str
    ) -> TableError:
        """What is wrong, and where."""
        place = ", ".join([str(self.file), f"table {table}", *([row] if row else [])])
        return TableError(place, column=column, found=found, expected=expected)

    def _rows(
        self, table: str, columns: tuple[str, ...], order: str
    ) -> Iterator[tuple]:
        return iter(
            self._connection.execute(
                f"SELECT {', '.join(columns)} FROM {table} ORDER BY {order}"
            )
        )

    def cameras(self) -> dict[int, PhotoCamera]:
        """Cameras by number; models that are not understood have no parameters."""
        return {
            number: self._camera(number, *rest)
            for number, *rest in self._rows("cameras", NEEDED["cameras"], "1")
        }

    def _camera(
        self, number: int, model: int, params: bytes | None, known: int
    ) -> PhotoCamera:
        if model not in MODELS:
            return PhotoCamera(OTHERS.get(model, f"number {model}"), {}, bool(known))
        name, names = MODELS[model]
        row = f"camera_id {number}"
        values = self._array(
            "cameras", row, "params", params, np.dtype("<f8"), len(names), f"{name} has"
        )
        parameters = dict(zip(names, map(float, values), strict=True))
        camera = PhotoCamera(name, parameters, bool(known))
        if not (np.all(np.isfinite(values)) and min(camera.focals) > 0):
            raise self.error(
                "cameras",
                row,
                "params",
                str(parameters),
                "finite numbers, the focal length positive",
            )
        return camera

    def images(self) -> dict[int, Image]:
        """Images by number."""
        return {
            number: Image(*rest)
            for number, *rest in self._rows("images", NEEDED["images"], "1")
        }

    def keypoints(self, wanted: set[int]) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Pixel coordinates of the keypoints of the images wanted."""
        found = {}
        for number, rows, cols, data in self._rows(
            "keypoints", NEEDED["keypoints"], "1"
        ):
            if number in wanted:
                if cols < 2:
                    row = f"image_id {number}"
                    raise self.error(
                        "keypoints",
                        row,
                        "cols",
                        str(cols),
                        "x and y, and what describes the shape",
                    )
                values = self._array(
                    "keypoints",
                    f"image_id {number}",
                    "data",
                    data,
                    np.dtype("<f4"),
                    rows * cols,
                    "rows x cols are",
                )
                found[number] = values.reshape(rows, cols)[:, :2].astype(np.float64)
        return found

    def pair_ids(self) -> list[tuple[int, int]]:
        """(number, number of matches) of every matched pair, in the order of the
        numbers."""
        return list(self._rows("matches", ("pair_id", "rows"), "pair_id"))

    def matches(self, pair_ids: list[int]) -> Iterator[Matches]:
        """The matches of these pairs."""
        for number in pair_ids:
            query = "SELECT rows, cols, data FROM matches WHERE pair_id = ?"
            rows, cols, data = self._connection.execute(query, (number,)).fetchone()
            row = f"pair_id {number}"
            if rows and cols != 2:
                raise self.error(
                    "matches",
                    row,
                    "cols",
                    str(cols),
                    "2, the places of a keypoint in either image",
                )
            values = self._array(
                "matches",
                row,
                "data",
                data,
                np.dtype("<u4"),
                rows * 2,
                "rows x cols are",
            )
            yield values.astype(np.int64).reshape(rows, 2)

    def _array(
        self,
        table: str,
        row: str,
        column: str,
        data: bytes | None,
        dtype: np.dtype,
        count: int,
        why: str,
    ):
        if isinstance(data, str):
            raise self.error(table, row, column, "text", "bytes")
        size = len(data or b"")
        if size != count * dtype.itemsize:
            expected = (
                f"{count * dtype.itemsize} bytes: {why} {count} numbers of "
                f"{dtype.itemsize} bytes"
            )
            raise self.error(table, row, column, f"{size} bytes", expected)
        return np.frombuffer(data or b"", dtype)

    def geometries(self) -> int:
        """How many two-view geometries there are."""
        return self._connection.execute(
            "SELECT count(*) FROM two_view_geometries"
        ).fetchone()[0]

    def write(self, geometries: list[Geometry]) -> None:
        """Rows of two_view_geometries, in place of those of the same pairs."""
        known = [
            c
            for c in ("F", "E", "H", "qvec", "tvec")
            if c in self._columns["two_view_geometries"]
        ]
        columns = [*NEEDED["two_view_geometries"], *known]
        places = ", ".join("?" * len(columns))
        rows = [
            (
                g.pair_id,
                len(g.matches),
                2,
                g.matches.astype("<u4").tobytes() or None,
                g.config,
                *(_blob(getattr(g, c)) for c in known),
            )
            for g in geometries
        ]
        command = (
            f"INSERT OR REPLACE INTO two_view_geometries ({', '.join(columns)}) VALUES "
            f"({places})"
        )
        self._connection.executemany(command, rows)


def _blob(values: np.ndarray | None) -> bytes | None:
    return None if values is None else np.ascontiguousarray(values, "<f8").tobytes()


@contextmanager
def opened(file: Path, out: Path | None, force: bool) -> Iterator[Database]:
    """The database, or a copy of it at `out`, in a transaction that takes effect when
    the block ends without an error; after one nothing is changed. Raises TableError."""
    if not file.is_file():
        raise TableError(
            file, found="no such file", expected="a COLMAP database; check the path"
        )
    if out is not None and out.absolute() == file.absolute():
        out = None
    if out is None:
        with (
            _said(file),
            closing(_connection(file)) as connection,
            _transaction(connection, file) as database,
        ):
            _refuse(database, force)
            yield database
        return
    check_file(out, force)
    draft = out.absolute().with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        with _said(file, out):
            draft.parent.mkdir(parents=True, exist_ok=True)
            with closing(_connection(draft)) as connection:
                # a draft that is not finished is thrown away: it needs no journal, and
                # the disk waits until it is
                connection.execute("PRAGMA journal_mode = MEMORY")
                connection.execute("PRAGMA synchronous = OFF")
                with _said(file), closing(_connection(file)) as source:
                    source.execute(
                        "SELECT count(*) FROM sqlite_master"
                    )  # waits for a lock for a while, a backup for ever
                    source.backup(connection)
                with _transaction(connection, file) as database:
                    _refuse(database, force)
                    yield database
        with _said(out):
            with draft.open("r+b") as finished:
                os.fsync(finished.fileno())
            os.replace(draft, out)
    finally:
        for end in ("", "-wal", "-shm", "-journal"):
            with suppress(OSError):
                draft.with_name(draft.name + end).unlink(missing_ok=True)


def _connection(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=WAIT, isolation_level=None)


@contextmanager
def _transaction(connection: sqlite3.Connection, name: Path) -> Iterator[Database]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield Database(name, connection)
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")


@contextmanager
def _said(file: Path, written: Path | None = None) -> Iterator[None]:
    """What SQLite and the disk complain of, as an error that says what to do;
    `written`: the copy, if there is one."""
    try:
        yield
    except sqlite3.OperationalError as error:
        expected = (
            "a database that nothing else writes to, in a folder that can be written; "
            "or --out for a copy"
        )
        raise TableError(written or file, found=str(error), expected=expected) from None
    except sqlite3.DatabaseError as error:
        raise TableError(
            file, found=str(error), expected="a sound SQLite database made by COLMAP"
        ) from None
    except OSError as error:
        found = error.strerror or str(error)
        raise TableError(
            written or file, found=found, expected="a file that can be written"
        ) from None


def _refuse(database: Database, force: bool) -> None:
    count = database.geometries()
    if count and not force:
        found = f"{count} two-view geometries"
        raise database.error(
            "two_view_geometries", None, None, found, "none, or --force to replace them"
        )
