"""Tables of places measured in images, and of object points: CSV text in, `NamedImages`
out, or one clear error. Places may also come in Parquet.

places   point, x, y in any rectangular system of the image; optionally image (of
         several in one table), sigma (of x and y), camera (which one took the image)
points   point, X, Y, Z, blank where they are unknown; optionally sX, sY, sZ, or sigma
         for all three (0: without error)
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from . import fields, whole
from .fields import Columns, TableError
from .survey_checks import Row

TEXTS = ("point", "image", "camera")
PLACES = Columns(
    ("point", "x", "y"),
    ("image", "sigma", "camera"),
    {"photo": "image"},
    texts=TEXTS,
)
AXES = ("x", "y", "z")
DEVIATIONS = ("sx", "sy", "sz")
POINTS = Columns(("point", *AXES), (*DEVIATIONS, "sigma"), texts=TEXTS)

FEWEST = 4
"""Known points without which no station of an image can be found."""

SHOWN = 5
"""Names that an error tells of a longer list."""


@dataclass(frozen=True)
class NamedImages:
    """Places measured in images, with the names of images, cameras and points.

    Of each row of the table: the numbers of its `image` and `point`, its place (`x`,
    `y`), `sigma` (None without this column), and its line. Of each image the number of
    its `camera`. `coordinates` and `deviations` of the points are NaN where they are
    unknown.
    """

    file: str
    images: list[str]
    cameras: list[str]
    points: list[str]
    image: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    places: Float[np.ndarray, "row 2"]
    sigma: Float[np.ndarray, " row"] | None
    lines: Int[np.ndarray, " row"]
    camera: Int[np.ndarray, " image"]
    coordinates: Float[np.ndarray, "point 3"]
    deviations: Float[np.ndarray, "point 3"]
    has_deviations: bool

    @property
    def is_single(self) -> bool:
        """Whether there is one image only."""
        return len(self.images) == 1

    @property
    def known(self) -> np.ndarray:
        """Which points have coordinates."""
        return np.all(np.isfinite(self.coordinates), axis=1)

    def rows_of(self, image: int) -> Int[np.ndarray, " some"]:
        """The rows of an image."""
        return np.flatnonzero(self.image == image)

    def names_of(self, rows: np.ndarray) -> list[str]:
        """The names of the points of these rows."""
        return [self.points[k] for k in self.point[rows]]


def read_places(path: Path) -> list[Row]:
    """The places of a file; without a column `image` they are those of one image, named
    after the file. Raises TableError."""
    if whole.is_parquet(path):
        return _check_places(_rows_of_parquet(path, PLACES), path.stem)
    return places(fields.read_text(path), str(path), path.stem)


def are_places(path: Path) -> bool:
    """Whether the header of a table is that of places measured photo by photo. Raises
    TableError where it cannot be read."""
    if whole.is_parquet(path):
        from .parquet import open_file

        names = open_file(path).schema_arrow.names
    else:
        names = fields.header_of(path)
    return {"image", *PLACES.required} <= {PLACES.full(entry) for entry in names}


def read_points(path: Path) -> list[Row]:
    """The object points of a file. Raises TableError."""
    return points(fields.read_text(path), str(path))


def places(text: str, file: str, image: str) -> list[Row]:
    """The places of CSV text; `image`: the name of the image where the text has none.
    Raises TableError."""
    return _check_places(_rows(text, file, PLACES), image)


def _check_places(given: list[Row], image: str) -> list[Row]:
    """Rows of places as they are written, with numbers for their numbers. Raises
    TableError."""
    rows, seen = [], {}
    for row in given:
        of = row.cells.setdefault("image", image)
        for column in TEXTS:
            if column in row.cells:
                fields.name(row.cells[column], row.file, row.line, column)
        for axis in ("x", "y"):
            row.cells[axis] = _number(row, axis, "; delete the line to leave it out")
        if "sigma" in row.cells:
            row.cells["sigma"] = _deviation(row, "sigma", can_be_zero=False)
        name = row.cells["point"]
        if (of, name) in seen:
            raise row.error(
                "point",
                found=f"{name!r} a second time in image {of!r} (first on line "
                f"{seen[of, name]})",
                expected="each point once in an image; rename it or delete one of the "
                "two",
            )
        seen[of, name] = row.line
        rows.append(row)
    return rows


def points(text: str, file: str) -> list[Row]:
    """The object points of CSV text. Raises TableError."""
    rows, seen = [], {}
    for row in _rows(text, file, POINTS):
        name = fields.name(row.cells["point"], file, row.line, "point")
        if name in seen:
            raise row.error(
                "point",
                found=f"{name!r} a second time (first on line {seen[name]})",
                expected="each point once; delete one of the two",
            )
        seen[name] = row.line
        _read_coordinates(row)
        rows.append(row)
    return rows


def _read_coordinates(row: Row) -> None:
    """Makes numbers of the coordinates of a point and of their deviations: all or
    none. Raises TableError."""
    cells = row.cells
    if "sigma" in cells and any(axis in cells for axis in DEVIATIONS):
        raise TableError(
            row.file,
            line=1,
            column="sigma",
            found="it beside sX, sY, sZ",
            expected="one sigma for all three coordinates, or one for each of them",
        )
    empty = [axis for axis in AXES if not cells[axis]]
    if empty and len(empty) < len(AXES):
        raise row.error(
            empty[0],
            found="an empty field beside other coordinates",
            expected="X, Y and Z, or three empty fields for a point that is unknown",
        )
    for axis in AXES:
        advice = "; three empty fields for a point that is unknown"
        cells[axis] = np.nan if empty else _number(row, axis, advice)
    for column in (*DEVIATIONS, "sigma"):
        if column in cells:
            cells[column] = (
                np.nan if empty else _deviation(row, column, can_be_zero=True)
            )


def assemble(measured: list[Row], known: list[Row]) -> NamedImages:
    """The places of all images with the points of the object. Raises TableError for
    what does not fit together."""
    file, other = measured[0].file, known[0].file
    at = {row.cells["point"]: number for number, row in enumerate(known)}
    names = list(dict.fromkeys(row.cells["point"] for row in measured))
    _check_names(measured, at, other)
    chosen = [known[at[name]].cells for name in names]
    images = list(dict.fromkeys(row.cells["image"] for row in measured))
    cameras, camera = _cameras(measured, images)
    number = {name: k for k, name in enumerate(names)}
    of_image = {name: k for k, name in enumerate(images)}
    has_sigma = "sigma" in measured[0].cells
    column = lambda name, rows: np.array([row[name] for row in rows], float)
    coordinates = np.stack([column(axis, chosen) for axis in AXES], axis=1)
    cells = [row.cells for row in measured]
    return NamedImages(
        file=file,
        images=images,
        cameras=cameras,
        points=names,
        image=np.array([of_image[cell["image"]] for cell in cells]),
        point=np.array([number[cell["point"]] for cell in cells]),
        places=np.stack([column(axis, cells) for axis in ("x", "y")], axis=1),
        sigma=column("sigma", cells) if has_sigma else None,
        lines=np.array([row.line for row in measured]),
        camera=camera,
        coordinates=coordinates,
        deviations=_point_deviations(chosen, coordinates),
        has_deviations=any(c in known[0].cells for c in (*DEVIATIONS, "sigma")),
    )


def _point_deviations(
    chosen: list[dict[str, Any]], coordinates: np.ndarray
) -> np.ndarray:
    """Standard deviations of the coordinates, zero where the table has none."""
    of = lambda cells, axis: cells.get(axis, cells.get("sigma", 0.0))
    found = np.array([[of(cells, axis) for axis in DEVIATIONS] for cells in chosen])
    return np.where(np.isfinite(coordinates), found, np.nan)


def _cameras(
    measured: list[Row], images: list[str]
) -> tuple[list[str], Int[np.ndarray, " image"]]:
    """The names of the cameras, and the number of that which took each image: one for
    all, where the table does not tell it. Raises TableError for an image with two."""
    if "camera" not in measured[0].cells:
        return ["camera"], np.zeros(len(images), int)
    found = cameras_of(measured)
    of_images = [found[name] for name in images]
    cameras = list(dict.fromkeys(of_images))
    return cameras, np.array([cameras.index(name) for name in of_images])


def cameras_of(measured: list[Row]) -> dict[str, str]:
    """The name of the camera of each image, of a table that has them. Raises TableError
    for an image with two."""
    first: dict[str, Row] = {}
    for row in measured:
        before = first.setdefault(row.cells["image"], row)
        if before.cells["camera"] != row.cells["camera"]:
            raise row.error(
                "camera",
                found=f"{row.cells['camera']!r}, and {before.cells['camera']!r} on "
                f"line {before.line} for the same image {row.cells['image']!r}",
                expected="one camera for each image",
            )
    return {name: row.cells["camera"] for name, row in first.items()}


def _check_names(measured: list[Row], at: dict[str, int], other: str) -> None:
    """Raises TableError for a measured point that the object does not have."""
    unknown = [row for row in measured if row.cells["point"] not in at]
    if not unknown:
        return
    if len(unknown) == len(measured):
        ours = list(dict.fromkeys(row.cells["point"] for row in measured))
        raise TableError(
            measured[0].file,
            column="point",
            found=f"no point of {other}; its points are {_some(ours)}",
            expected=f"names of {other}: {_some(list(at))}",
        )
    name = unknown[0].cells["point"]
    raise unknown[0].error(
        "point",
        found=f"{name!r}, which {other} does not have",
        expected=f"a point of {other}; delete the line, or add the point there (with "
        "empty coordinates if these are unknown and several images show it)",
    )


def check_known(named: NamedImages, other: str) -> None:
    """Raises TableError where an image that is calibrated alone has an unknown point,
    or too few points."""
    unknown = np.flatnonzero(~named.known[named.point])
    if unknown.size:
        row = unknown[0]
        raise TableError(
            named.file,
            line=int(named.lines[row]),
            column="point",
            found=f"{named.points[named.point[row]]!r}, whose coordinates are empty in "
            f"{other}",
            expected="known points in an image that is calibrated alone; delete the "
            "line, or calibrate several images together",
        )
    for image, name in enumerate(named.images):
        rows = named.rows_of(image)
        if len(rows) < FEWEST:
            raise TableError(
                named.file,
                line=int(named.lines[rows[0]]),
                column="point",
                found=f"{len(rows)} known points in image {name!r}",
                expected=f"at least {FEWEST}; a check needs 6 or more",
            )


def check_seen(named: NamedImages) -> None:
    """Raises TableError for an unknown point in one image only."""
    met = np.bincount(named.point, minlength=len(named.points))
    lonely = np.flatnonzero(~named.known & (met < 2))
    if lonely.size:
        row = int(np.flatnonzero(named.point == lonely[0])[0])
        raise TableError(
            named.file,
            line=int(named.lines[row]),
            column="point",
            found=f"{named.points[lonely[0]]!r}, which is unknown, in this image only "
            f"(points like it: {lonely.size})",
            expected="unknown points in two images or more; delete the line, or give "
            "the coordinates of the point",
        )


def _rows(text: str, file: str, columns: Columns) -> list[Row]:
    """The lines of CSV text as they are written. Raises TableError."""
    given = io.StringIO(text, newline="")
    found, line = [], 1
    for line, cells in fields.lines_of(given, file, columns):
        found.append(Row(file, line, dict(cells)))
    if not found:
        raise TableError(
            file,
            line=line + 1,
            found="no points",
            expected=f"{columns}, and one line for each point below them",
        )
    return found


def _rows_of_parquet(path: Path, columns: Columns) -> list[Row]:
    """The rows of a Parquet table as a CSV table of them would have them; their numbers
    count from 1. Raises TableError."""
    from .parquet import read_columns

    table = read_columns(path)
    places = columns.places(list(table), str(path), None)
    names = list(table)
    texts = {name: list(map(_text, table[names[k]])) for name, k in places.items()}
    rows = zip(*texts.values(), strict=True)
    found = [
        Row(str(path), k, dict(zip(texts, cells, strict=True)))
        for k, cells in enumerate(rows, 1)
    ]
    if not found:
        raise TableError(path, found="no rows", expected=str(columns))
    return found


def _text(value: Any) -> str:
    """An entry of a Parquet table as CSV text has it."""
    return "" if value is None else str(value)


def _number(row: Row, column: str, advice: str = "") -> float:
    return fields.number(row.cells[column], row.file, row.line, column, advice)


def _deviation(row: Row, column: str, *, can_be_zero: bool) -> float:
    """A standard deviation. Raises TableError."""
    text, value = row.cells[column], _number(row, column)
    if value < 0 or (value == 0 and not can_be_zero):
        least = "0 or more" if can_be_zero else "more than 0"
        expected = f"a standard deviation, {least}, in the unit of the coordinates"
        raise row.error(column, found=repr(text), expected=expected)
    return value


def _some(names: Sequence[str]) -> str:
    """The first names of a list."""
    more = ", ..." if len(names) > SHOWN else ""
    return ", ".join(map(repr, names[:SHOWN])) + more
