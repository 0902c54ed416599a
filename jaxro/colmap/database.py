"""A COLMAP database (SQLite): cameras, keypoints and matches read, two-view geometries
written, all or none.

Tables as COLMAP 3.x and 4.x make them. A pair of images has the number 2147483647 a +
b, a < b their numbers; the two columns of its matches are places among the keypoints of
a and of b, from zero. Matrices are nine doubles row by row, qvec is (w, x, y, z) and
tvec turns and moves the frame of camera a into that of b. Columns that a version does
not have are not written; tables that are not named here are not touched.

The tables are read by sqlite3 and not by `pycolmap.Database`, which cannot leave a
database as it is: `open` writes to the file, adds tables that are missing and converts
older ones, and its transaction keeps what was written before an error.
"""

import sqlite3
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from ..tables.fields import TableError, tell

LONGEST_ROW = 100
"""Letters of what a row is called in an error."""

MOST_IMAGES = 2147483647
NEEDED = {
    "cameras": ("camera_id", "model", "params", "prior_focal_length"),
    "images": ("image_id", "name", "camera_id"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data", "config"),
}
"""Tables and columns without which nothing can be done."""
MATRICES = ("F", "E", "H", "qvec", "tvec")
"""Columns of two_view_geometries that not every version has."""

MODELS = {
    int(model): name
    for name, model in pycolmap.CameraModelId.__members__.items()
    if name != "INVALID"
}
"""The camera models by their number in the database."""

Matches = Int[np.ndarray, "_ 2"]


class Image(NamedTuple):
    """An image of the database."""

    name: str
    camera: int


class Geometry(NamedTuple):
    """A row of two_view_geometries; `matrices`: those of F, E, H, qvec and tvec that
    there are, by the names of the columns."""

    pair_id: int
    matches: Matches
    config: int
    matrices: dict[str, Float[np.ndarray, "..."]]


def images_of(pair_id: int) -> tuple[int, int]:
    """(a, b) of the number of a pair."""
    return pair_id // MOST_IMAGES, pair_id % MOST_IMAGES


class Database:
    """An open database within one transaction; `file` is what errors call it."""

    def __init__(self, file: Path, connection: sqlite3.Connection):
        self.file, self._connection = file, connection
        self._columns = {table: self._columns_of(table) for table in NEEDED}

    def _columns_of(self, table: str) -> list[str]:
        rows = self._connection.execute(f"PRAGMA table_info({table})")
        found = [row[1] for row in rows]
        if not found:
            expected = "a database made by COLMAP 3 or later"
            raise self.error(table, None, None, "no such table", expected)
        for column in NEEDED[table]:
            if column not in found:
                expected = f"the columns {', '.join(NEEDED[table])}"
                raise self.error(table, None, column, "no such column", expected)
        return found

    def error(
        self, table: str, row: str | None, column: str | None, found: str, expected: str
    ) -> TableError:
        """What is wrong, and where."""
        place = f"{self.file}, table {table}"
        if row:
            place += f", {tell(row, LONGEST_ROW)}"
        return TableError(place, found=found, expected=expected, column=column)

    def _whole(self, table: str, row: str, column: str, value: object) -> None:
        """Raises TableError unless a value, which SQLite may have of any type in any
        column, is a whole number that counts something."""
        if not isinstance(value, int) or value < 0:
            raise self.error(table, row, column, repr(value), "a whole number from 0")

    def _rows(self, table: str) -> Iterator[tuple]:
        """The needed columns of all rows, in the order of their numbers."""
        columns = ", ".join(NEEDED[table])
        return self._connection.execute(f"SELECT {columns} FROM {table} ORDER BY 1")

    def pair_ids(self) -> list[tuple[int, int]]:
        """(number, number of matches) of every matched pair, in the order of the
        numbers."""
        query = "SELECT pair_id, rows FROM matches ORDER BY pair_id"
        found = self._connection.execute(query).fetchall()
        for pair_id, rows in found:
            self._whole("matches", f"pair_id {pair_id}", "pair_id", pair_id)
            self._whole("matches", f"pair_id {pair_id}", "rows", rows)
        return found

    def images(self, pair_ids: list[int]) -> dict[int, Image]:
        """The images of these pairs by number. Raises TableError where one is
        missing."""
        known = {
            number: Image(str(name), camera)
            for number, name, camera in self._rows("images")
        }
        found = {}
        for pair_id in pair_ids:
            for number in images_of(pair_id):
                if number not in known:
                    row = f"pair_id {pair_id}"
                    expected = "an image of the table images; match the images again"
                    raise self.error("matches", row, None, f"image {number}", expected)
                found[number] = known[number]
        return found

    def cameras(
        self, images: Mapping[int, Image], assume_calibrated: bool
    ) -> dict[int, pycolmap.Camera]:
        """The cameras of these images by number, in the order of the numbers. Raises
        TableError where one is missing, not understood, or has a focal length that is
        only guessed, unless it is to be taken as calibrated."""
        rows = {number: rest for number, *rest in self._rows("cameras")}
        for number, image in images.items():
            row = _row_of(number, image)
            self._whole("images", row, "camera_id", image.camera)
            if image.camera not in rows:
                expected = "a camera of the table cameras"
                raise self.error(
                    "images", row, "camera_id", str(image.camera), expected
                )
        wanted = sorted({image.camera for image in images.values()})
        found = {number: self._camera(number, *rows[number]) for number in wanted}
        for number, camera in found.items():
            if not (camera.has_prior_focal_length or assume_calibrated):
                row = f"camera_id {number}"
                expected = (
                    "1: a focal length that is known; calibrate, or give "
                    "--assume-calibrated if it is good to 1 %"
                )
                raise self.error("cameras", row, "prior_focal_length", "0", expected)
        return found

    def _camera(
        self, number: int, model: Any, params: object, known: object
    ) -> pycolmap.Camera:
        row = f"camera_id {number}"
        if model not in MODELS:
            expected = (
                f"one of {', '.join(f'{k} {v}' for k, v in MODELS.items())}; a later "
                "pycolmap may know it, or undistort the images first"
            )
            raise self.error("cameras", row, "model", str(model), expected)
        camera = pycolmap.Camera(
            model=MODELS[model], has_prior_focal_length=bool(known)
        )
        names = [name.strip() for name in camera.params_info.split(",")]
        why = f"{MODELS[model]} has"
        values = self._array("cameras", row, "params", params, "<f8", len(names), why)
        camera.params = values.tolist()
        lengths = camera.focal_length_idxs() or [0, 1]  # width, height of a panorama
        if not (np.all(np.isfinite(values)) and np.all(values[lengths] > 0)):
            found = str(dict(zip(names, values.tolist(), strict=True)))
            expected = "finite numbers, the focal length positive"
            raise self.error("cameras", row, "params", found, expected)
        return camera

    def keypoints(
        self, images: Mapping[int, Image]
    ) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Pixel coordinates of the keypoints of these images. Raises TableError."""
        found = {}
        for number, rows, cols, data in self._rows("keypoints"):
            if number not in images:
                continue
            row = f"image_id {number}"
            self._whole("keypoints", row, "rows", rows)
            self._whole("keypoints", row, "cols", cols)
            if cols < 2:
                expected = "x and y, and what describes the shape"
                raise self.error("keypoints", row, "cols", str(cols), expected)
            values = self._array(
                "keypoints", row, "data", data, "<f4", rows * cols, "rows x cols are"
            )
            found[number] = values.reshape(rows, cols)[:, :2].astype(np.float64)
        for number, image in images.items():
            if number not in found:
                row = _row_of(number, image)
                expected = "the keypoints of a matched image"
                raise self.error("keypoints", row, None, "no such row", expected)
        return found

    def matches(
        self, pair_ids: Collection[int], keypoints: Mapping[int, int]
    ) -> Iterator[Matches]:
        """The matches of these pairs; `keypoints`: how many an image has. Raises
        TableError, also where a match names one that does not exist."""
        query = "SELECT rows, cols, data FROM matches WHERE pair_id = ?"
        for number in pair_ids:
            rows, cols, data = self._connection.execute(query, (number,)).fetchone()
            row = f"pair_id {number}"
            if rows and cols != 2:
                expected = "2, the places of a keypoint in either image"
                raise self.error("matches", row, "cols", str(cols), expected)
            values = self._array(
                "matches", row, "data", data, "<u4", rows * 2, "rows x cols are"
            )
            found = values.astype(np.int64).reshape(rows, 2)
            largest = found.max(axis=0, initial=-1)
            for image, place in zip(images_of(number), largest, strict=True):
                if place >= keypoints[image]:
                    expected = (
                        f"places below {keypoints[image]}, the number of keypoints of "
                        f"image {image}"
                    )
                    raise self.error(
                        "matches", row, "data", f"keypoint {place}", expected
                    )
            yield found

    def _array(
        self,
        table: str,
        row: str,
        column: str,
        data: object,
        dtype: str,
        count: int,
        why: str,
    ) -> np.ndarray:
        """The numbers of a blob. Raises TableError unless it has so many."""
        if not isinstance(data, bytes | None):
            raise self.error(table, row, column, repr(data), "bytes")
        size, each = len(data or b""), np.dtype(dtype).itemsize
        if size != count * each:
            expected = f"{count * each} bytes: {why} {count} numbers of {each} bytes"
            raise self.error(table, row, column, f"{size} bytes", expected)
        return np.frombuffer(data or b"", dtype)

    def geometries(self) -> int:
        """How many two-view geometries there are."""
        query = "SELECT count(*) FROM two_view_geometries"
        return self._connection.execute(query).fetchone()[0]

    def write(self, geometries: list[Geometry]) -> None:
        """Rows of two_view_geometries, in place of those of the same pairs."""
        known = self._columns["two_view_geometries"]
        matrices = [name for name in MATRICES if name in known]
        columns = [*NEEDED["two_view_geometries"], *matrices]
        rows = []
        for one in geometries:
            matches = one.matches.astype("<u4").tobytes() or None
            blobs = [_blob(one.matrices.get(name)) for name in matrices]
            rows.append((one.pair_id, len(one.matches), 2, matches, one.config, *blobs))
        self._connection.executemany(
            f"INSERT OR REPLACE INTO two_view_geometries ({', '.join(columns)}) "
            f"VALUES ({', '.join('?' * len(columns))})",
            rows,
        )


def _row_of(number: int, image: Image) -> str:
    return f"image_id {number} ({image.name})"


def _blob(values: np.ndarray | None) -> bytes | None:
    return None if values is None else np.ascontiguousarray(values, "<f8").tobytes()
