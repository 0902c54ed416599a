"""Tables of measured image coordinates: CSV text in, one `Measurements` per pair out, or one clear error.

Columns, in any order: point, x_left, y_left, x_right, y_right and optionally pair, sigma; `id,xl,yl,xr,yr` is the short
form of the first five. Coordinates and sigma are in the units of the measurement; cameras turn them into photo
coordinates. Nothing is skipped or guessed: whatever does not fit stops the reading with file, line and column.
"""

import csv
import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

REQUIRED = ("point", "x_left", "y_left", "x_right", "y_right")
OPTIONAL = ("pair", "sigma")
SHORT = {"id": "point", "xl": "x_left", "yl": "y_left", "xr": "x_right", "yr": "y_right"}
ACCEPTED = f"the columns {','.join(REQUIRED)} (or {','.join(SHORT)}), optionally {' and '.join(OPTIONAL)}"


class TableError(ValueError):
    """Input that cannot be used: where it is, what was found there, what was expected."""

    def __init__(self, file: str | Path, line: int | None, column: str | None, found: str, expected: str):
        self.file, self.line, self.column, self.found, self.expected = str(file), line, column, found, expected
        place = [self.file]
        if line is not None:
            place.append(f"line {line}")
        if column is not None:
            place.append(f"column {column}")
        super().__init__(f"{', '.join(place)}: found {found}; expected {expected}")


@dataclass
class Measurements:
    """The measured points of one pair; `lines` are their lines in the file."""

    name: str
    points: list[str] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)

    @property
    def coordinates(self) -> Float[np.ndarray, "4 point"]:
        """x_left, y_left, x_right, y_right"""
        return np.asarray(self.rows, np.float64)[:, :4].T

    @property
    def sigma(self) -> Float[np.ndarray, " point"] | None:
        """Standard deviations of the coordinates, where the table has them."""
        return np.asarray(self.rows, np.float64)[:, 4] if len(self.rows[0]) == 5 else None


@dataclass
class Table:
    """All pairs of one file in the order of their first points, and what a careful reader should be told."""

    file: str
    pairs: list[Measurements]
    warnings: list[str]

    @property
    def has_sigma(self) -> bool:
        """True where the table has a column sigma."""
        return self.pairs[0].sigma is not None


def read_text(path: Path) -> str:
    """The UTF-8 text of a file. Raises TableError if it cannot be read or is not UTF-8."""
    try:
        data = path.read_bytes()
    except OSError as error:
        expected = "a readable file; check the path and its permissions"
        raise TableError(path, None, None, f"no file that can be read ({error.strerror or error})", expected) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        found = f"the byte 0x{data[error.start]:02x}"
        raise TableError(path, line, None, found, "UTF-8 text; save the table as CSV UTF-8") from None


def read(path: Path) -> Table:
    """The pairs of a CSV file; without a column `pair` one pair, named after the file. Raises TableError."""
    return parse(read_text(path), str(path), path.stem)


def parse(text: str, file: str, name: str) -> Table:
    """The pairs of CSV text. `file` is named in errors, `name` is the pair's where the table has no column `pair`."""
    line = 1
    pairs: dict[str, Measurements] = {}
    seen: dict[str, dict[str, int]] = {}
    places: dict[tuple, str] = {}
    twins: dict[str, list[str]] = {}
    for line, pair, point, values in checked(io.StringIO(text, newline=""), file, name):
        first = seen.setdefault(pair, {}).setdefault(point, line)
        if first != line:
            found = f"{point!r} a second time in pair {pair!r} (first on line {first})"
            raise TableError(
                file, line, "point", found, "each point once in a pair; rename it or delete one of the two"
            )
        twin = places.setdefault((pair, *values[:4]), point)
        if twin != point:
            twins.setdefault(pair, []).append(f"{point} = {twin} (line {line})")
        measured = pairs.setdefault(pair, Measurements(pair))
        measured.points.append(point)
        measured.rows.append(values)
        measured.lines.append(line)
    if not pairs:
        raise TableError(file, line + 1, None, "no points", "one line for every measured point below the header")
    return Table(file, list(pairs.values()), [_twins(file, pair, found) for pair, found in twins.items()])


def checked(lines: Iterable[str], file: str, name: str = "") -> Iterator[tuple[int, str, str, tuple[float, ...]]]:
    """(line number, pair, point, numbers) of every line below the header, each field looked at. Raises TableError."""
    rows = _rows(lines, file)
    line, header = next(rows, (1, None))
    if header is None:
        raise TableError(file, 1, None, "no text at all", f"a header line with {ACCEPTED}")
    columns = _columns(header, file, line)
    numbers = [c for c in (*REQUIRED[1:], "sigma") if c in columns]
    for line, row in rows:
        _check_length(row, columns, file, line)
        point = _name(row[columns["point"]], file, line, "point")
        pair = _name(row[columns["pair"]], file, line, "pair") if "pair" in columns else name
        yield line, pair, point, tuple(_number(row[columns[c]], file, line, c) for c in numbers)


def _twins(file: str, pair: str, found: list[str]) -> str:
    named = ", ".join(found[:5]) + (f" and {len(found) - 5} more" if len(found) > 5 else "")
    return (
        f"{file}: in pair {pair!r} the coordinates of a point occur again under another name: {named}. "
        "Each counts in the degrees of freedom; delete what was measured only once."
    )


def _rows(lines: Iterable[str], file: str) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not blank."""
    reader = csv.reader(lines, strict=True, skipinitialspace=True)
    while True:
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            expected = "comma-separated fields, each quotation closed on its line"
            raise TableError(file, reader.line_num, None, str(error), expected) from None
        if any(entry.strip() for entry in row):
            yield reader.line_num, row


def _columns(header: list[str], file: str, line: int) -> dict[str, int]:
    """The place of every column by its full name."""
    columns: dict[str, int] = {}
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise TableError(
            file, line, None, f"the header {header[0]!r}", "fields separated by commas, decimals by points"
        )
    for place, entry in enumerate(header):
        given = entry.strip().lower()
        full = SHORT.get(given, given)
        if full not in REQUIRED + OPTIONAL:
            what = f"an unknown column {entry!r}" if given else f"no name in field {place + 1} of the header"
            raise TableError(file, line, given or None, what, f"{ACCEPTED}; delete or rename it, none is ignored")
        if full in columns:
            raise TableError(file, line, given, "this column a second time", "each column once; delete one of the two")
        columns[full] = place
    for name in REQUIRED:
        if name not in columns:
            raise TableError(file, line, name, "no such column", ACCEPTED)
    return columns


def _check_length(row: list[str], columns: dict[str, int], file: str, line: int) -> None:
    if len(row) < len(columns):
        missing = next(name for name, place in columns.items() if place == len(row))
        raise TableError(file, line, missing, f"{len(row)} fields", f"{len(columns)}, as in the header")
    if len(row) > len(columns):
        expected = f"{len(columns)}, as in the header; decimals are written with a point, names with commas in quotes"
        raise TableError(file, line, None, f"{len(row)} fields", expected)


def _name(text: str, file: str, line: int, column: str) -> str:
    if not text.strip():
        raise TableError(file, line, column, "an empty field", f"the name of the {column}")
    return text.strip()


def _number(text: str, file: str, line: int, column: str) -> float:
    """A finite number; positive for sigma."""
    try:
        value = float(text)
    except ValueError:
        value = None
    if value is None or "_" in text:  # Python reads 1_0 as 10; a measuring table does not
        found = repr(text) if text.strip() else "an empty field"
        raise TableError(file, line, column, found, "a number such as -12.345; delete the line to leave the point out")
    if not math.isfinite(value):
        raise TableError(file, line, column, repr(text), "a finite number; delete the line to leave the point out")
    if column == "sigma" and value <= 0:
        raise TableError(file, line, column, repr(text), "a positive standard deviation in the unit of the coordinates")
    return value
