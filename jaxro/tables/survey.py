"""Tables of a survey over a grid: CSV text in, a named `surveys.grid_survey.Survey` out, or one
clear error. All in mm.

readings   point, square, parallax; optionally grid (the grid read at the point),
           x, y (for the picture), height (where it is known)
grid       square, side, photo_side; parallax (the grid read in the square, unless
           each reading has its own), height (of the grid there, else 0)
traverses  traverse, from, to, back, fore: the legs in order, both readings made anew
           for each; a square's name is its corner, of known height
"""

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..surveys.grid_survey import Measured, Survey, survey
from ..surveys.planning import Deviations
from . import fields
from .fields import Columns, TableError
from .survey_checks import Row, check_legs, check_reading, check_scale

TEXTS = ("point", "square", "traverse", "from", "to")
POSITIVE = ("side", "photo_side")
READINGS = Columns(
    ("point", "square", "parallax"), ("grid", "x", "y", "height"), texts=TEXTS
)
GRID = Columns(("square", "side", "photo_side"), ("parallax", "height"), texts=TEXTS)
TRAVERSES = Columns(("traverse", "from", "to", "back", "fore"), texts=TEXTS)
LONGEST = 1e9
"""mm: no length is longer, and none shorter than its inverse."""


@dataclass(frozen=True)
class Named:
    """A survey with the names of its parts; the first `points` of its points are those
    of the table of readings, the others corners of squares. `places`: x, y (2, point),
    None without them."""

    survey: Survey
    names: list[str]
    squares: list[str]
    points: int
    traverses: list[str]
    places: np.ndarray | None


def rows(text: str, file: str, columns: Columns) -> list[Row]:
    """The lines of CSV text by the names of its columns. Raises
    TableError."""
    found, line = [], 1
    given = io.StringIO(text, newline="")
    for line, entries in fields.lines_of(given, file, columns):
        row = Row(file, line, {})
        for column, entry in entries.items():
            row.cells[column] = _cell(entry, row, column, column in columns.optional)
        found.append(row)
    if not found:
        expected = f"{columns}, and one line for each below them"
        raise TableError(file, line=line + 1, found="no lines", expected=expected)
    return found


def _cell(entry: str, row: Row, column: str, optional: bool) -> Any:
    """What a field says. Raises TableError."""
    if column in TEXTS:
        return fields.name(entry, row.file, row.line, column)
    if optional and not entry:
        return None
    value = fields.number(entry, row.file, row.line, column)
    if column in POSITIVE and value <= 0:
        raise row.error(column, found=repr(entry), expected="a positive length in mm")
    if abs(value) > LONGEST:
        raise row.error(column, found=repr(entry), expected=f"mm, at most {LONGEST:g}")
    return value


def read(path: Path, columns: Columns) -> list[Row]:
    """The lines of a file. Raises TableError."""
    return rows(fields.read_text(path), str(path), columns)


def assemble(
    readings: list[Row],
    grid: list[Row],
    traverses: list[Row] | None,
    camera_height: float,
    base: float,
    deviations: Deviations,
) -> Named:
    """The survey of these tables. Raises TableError for whatever does not fit
    together."""
    squares = _read_squares(grid, camera_height, base)
    points = _read_points(readings, squares, deviations)
    count, legs = len(readings), traverses or []
    start, end = _read_legs(points, squares, legs, deviations, readings[0].file)
    known = np.array([height is not None for height in points.height])
    if legs:
        check_legs(legs, start, end, known, list(points.numbers))
    own = np.where(np.arange(len(known)) < count, deviations.point, 0.0)
    measured = _arrays(
        camera_height=camera_height,
        base=base,
        side=squares.side,
        photo_side=squares.photo_side,
        grid=points.grid.values,
        point=points.parallax,
        back=np.array([row.cells["back"] for row in legs], float),
        fore=np.array([row.cells["fore"] for row in legs], float),
    )
    spread = _arrays(
        camera_height=deviations.camera_height,
        base=deviations.base,
        side=deviations.side,
        photo_side=deviations.photo_side,
        grid=points.grid.deviations,
        point=own,
        back=deviations.point,
        fore=deviations.point,
    )
    made = survey(
        measured,
        spread,
        square=points.square,
        grid=points.grid.number,
        datum=squares.datum,
        known=known,
        height=np.array([height or 0.0 for height in points.height]),
        start=start,
        end=end,
    )
    places = [[row.cells.get(axis) for row in readings] for axis in "xy"]
    is_complete = not any(value is None for axis in places for value in axis)
    return Named(
        survey=made,
        names=list(points.numbers),
        squares=list(squares.numbers),
        points=count,
        traverses=[row.cells["traverse"] for row in legs],
        places=np.array(places, float) if is_complete else None,
    )


def _arrays(**values: Any) -> Measured:
    """What was measured, or its standard deviations, as arrays of JAX."""
    return Measured(**{name: jnp.asarray(value) for name, value in values.items()})


class _Squares(NamedTuple):
    """The squares of the grid: their numbers by name; sides in nature and on the photo,
    parallaxes p_c and heights of the grid there, the cameras' heights over them."""

    rows: list[Row]
    numbers: dict[str, int]
    side: np.ndarray
    photo_side: np.ndarray
    p_c: np.ndarray
    datum: np.ndarray
    over: np.ndarray

    def parallax(self, square: int) -> float | None:
        """The reading of the grid in a square, if the table has it."""
        return self.rows[square].cells.get("parallax")

    def check(self, row: Row, column: str, grid: float, square: int) -> None:
        """Raises TableError for a reading that no point of the square can have."""
        p_c, over = float(self.p_c[square]), float(self.over[square])
        check_reading(row, column, grid, p_c, over)


def _read_squares(grid: list[Row], camera_height: float, base: float) -> _Squares:
    numbers = _number(grid, "square")
    check_scale(grid, camera_height)
    side, photo_side = (np.array([row.cells[c] for row in grid]) for c in POSITIVE)
    datum = np.array([row.cells.get("height") or 0.0 for row in grid])
    p_c = base * photo_side / side
    return _Squares(
        rows=grid,
        numbers=numbers,
        side=side,
        photo_side=photo_side,
        p_c=p_c,
        datum=datum,
        over=camera_height - datum,
    )


class _GridReadings:
    """Readings of the grid, each once: values and deviations, and the number of that of
    every point."""

    def __init__(self):
        self.values: list[float] = []
        self.deviations: list[Any] = []
        self.number: list[int] = []
        self._shared: dict[int, int] = {}

    def add(self, value: Any, square: int | None, deviation: Any) -> None:
        """The next point has this reading: its own, or (`square`) that of all points of
        the square."""
        if square not in self._shared:
            self.values.append(value)
            self.deviations.append(deviation)
            if square is None:
                self.number.append(len(self.values) - 1)
                return
            self._shared[square] = len(self.values) - 1
        self.number.append(self._shared[square])

    def of(self, point: int) -> float:
        """The reading of the grid that belongs to a point."""
        return self.values[self.number[point]]


@dataclass
class _Points:
    """Points as they are met: their numbers by name, square, reading, height (None
    where it is not known), and reading of the grid."""

    numbers: dict[str, int]
    square: list[int] = field(default_factory=list)
    parallax: list[float] = field(default_factory=list)
    height: list[float | None] = field(default_factory=list)
    grid: _GridReadings = field(default_factory=_GridReadings)


def _read_points(
    readings: list[Row], squares: _Squares, deviations: Deviations
) -> _Points:
    """The points of the table of readings. Raises TableError."""
    points = _Points(_number(readings, "point"))
    for name, number in points.numbers.items():
        if name in squares.numbers:
            raise readings[number].error(
                "point",
                found=repr(name),
                expected="a name that no square has: a square's name is that of its "
                "corner",
            )
    grid_file = squares.rows[0].file
    for row in readings:
        name = row.cells["square"]
        if name not in squares.numbers:
            expected = f"a square of {grid_file}"
            raise row.error("square", found=repr(name), expected=expected)
        square = squares.numbers[name]
        own, there = row.cells.get("grid"), squares.parallax(square)
        if own is None and there is None:
            raise row.error(
                "grid",
                found="no reading of the grid",
                expected="the grid read at the point, or a column parallax with that "
                f"of square {name!r} in {grid_file}",
            )
        if own is None:
            points.grid.add(there, square, deviations.grid)
        else:
            points.grid.add(own, None, deviations.grid)
        squares.check(row, "parallax", points.grid.of(-1), square)
        height, over = row.cells.get("height"), squares.over[square]
        if height is not None and not (
            -over < height - squares.datum[square] < over / 2
        ):
            camera_height = over + squares.datum[square]
            raise row.error(
                "height",
                found=repr(height),
                expected="a height from the zero of the grid and of the camera height, "
                f"{camera_height:g}",
            )
        points.square.append(square)
        points.parallax.append(row.cells["parallax"])
        points.height.append(height)
    return points


def _read_legs(
    points: _Points,
    squares: _Squares,
    legs: list[Row],
    deviations: Deviations,
    readings_file: str,
) -> tuple[list[int], list[int]]:
    """The numbers of the points where the legs begin and end; corners of squares become
    points. Raises TableError."""
    start, end = [], []
    for row in legs:
        for column, reading, into in (("from", "back", start), ("to", "fore", end)):
            name = row.cells[column]
            if name not in points.numbers:
                if name not in squares.numbers:
                    raise row.error(
                        column,
                        found=repr(name),
                        expected=f"a point of {readings_file}, or a square of "
                        f"{squares.rows[0].file} for its corner",
                    )
                _add_corner(points, squares, name, row.cells[reading], deviations)
            number = points.numbers[name]
            grid = points.grid.of(number)
            squares.check(row, reading, grid, points.square[number])
            into.append(number)
    return start, end


def _add_corner(
    points: _Points,
    squares: _Squares,
    name: str,
    reading: float,
    deviations: Deviations,
) -> None:
    """The corner of a square as a point of known height, which was read on a leg."""
    square = squares.numbers[name]
    there = squares.parallax(square)
    if there is None:  # the corner is the grid, and this its reading
        points.grid.add(reading, None, 0.0)
    else:
        points.grid.add(there, square, deviations.grid)
    points.numbers[name] = len(points.square)
    points.square.append(square)
    points.parallax.append(points.grid.of(-1))
    points.height.append(squares.datum[square])


def _number(table: list[Row], column: str) -> dict[str, int]:
    """The numbers of the lines by their names, each of which may stand once."""
    numbers: dict[str, int] = {}
    for row in table:
        name = row.cells[column]
        if name in numbers:
            first = table[numbers[name]].line
            raise row.error(
                column,
                found=f"{name!r} a second time (first on line {first})",
                expected=f"each {column} once; of repeated readings give the mean",
            )
        numbers[name] = len(numbers)
    return numbers
