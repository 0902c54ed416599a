"""CSV text field by field, and the one error of everything that is read: file, line,
column, what was found there, what was expected. Nothing is skipped or guessed."""

import csv
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

MOST_FOUND = 200
"""Letters of what was found that are told: a whole file may stand in one field."""

MOST_EXPECTED = 500
"""Letters of what was expected that are told: names of the file may be among them."""

DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d*(e[-+]?\d+)?", re.IGNORECASE)
"""A number with a decimal comma."""


def tell(text: str, most: int | None = None) -> str:
    """Text of a user as it may be shown in one line, no longer than `most` letters: line
    ends, control characters and marks of direction as escapes (\\n, \\u202e)."""
    if not (text.isascii() and text.isprintable()):
        text = "".join(
            letter.encode("unicode_escape").decode() if _is_control(letter) else letter
            for letter in text
        )
    if most is not None and len(text) > most:
        text = text[: most - 4] + " ..."
    return text


def tell_lines(text: str) -> str:
    """The same of text whose lines stay lines."""
    return "\n".join(map(tell, text.split("\n")))


def _is_control(letter: str) -> bool:
    """Whether a letter is none but moves, hides or turns others, ends the line, or is
    half of one."""
    return unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp")


class TableError(ValueError):
    """Input that cannot be used: where it is (`line`: its number, or "row 5"), what was
    found there, what was expected."""

    def __init__(
        self,
        file: str | Path,
        *,
        found: str,
        expected: str,
        line: int | str | None = None,
        column: str | None = None,
    ):
        self.file, self.line = tell(str(file)), line
        self.column = None if column is None else tell(column, MOST_FOUND)
        self.found = tell(found, MOST_FOUND)
        self.expected = tell(expected, MOST_EXPECTED)
        place = [self.file]
        if line is not None:
            place.append(line if isinstance(line, str) else f"line {line}")
        if column is not None:
            place.append(f"column {self.column}")
        super().__init__(
            f"{', '.join(place)}: found {self.found}; expected {self.expected}"
        )


@dataclass(frozen=True)
class Columns:
    """The columns of a kind of table, in any order and any case; `short`: other names
    of some, `foreign`: those that they have in other programs; `texts`: those that hold
    names, where the others hold numbers; `results`: columns that jaxro writes beside
    these, and reads again without a use for them where the first one is there."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    short: Mapping[str, str] = field(default_factory=dict)
    texts: tuple[str, ...] = ("pair", "point")
    results: tuple[str, ...] = ()
    foreign: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        short = f" (or {','.join(self.short)})" if self.short else ""
        optional = f", optionally {', '.join(self.optional)}" if self.optional else ""
        return f"the columns {','.join(self.required)}{short}{optional}"

    def full(self, given: str) -> str:
        """The name of a column as it is written here."""
        name = given.strip().lower()
        without_unit = name.partition("_")[0]
        if without_unit in self.results:
            return without_unit
        return self.short.get(name, self.foreign.get(name, name))

    def places(self, header: list[str], file: str, line: int | None) -> dict[str, int]:
        """The place of every column by its full name. Raises TableError."""
        if len(header) == 1 and any(mark in header[0].strip() for mark in " |:"):
            raise TableError(
                file,
                line=line,
                found=f"the header {header[0]!r}",
                expected="fields separated by commas, semicolons or tabs",
            )
        known = self.required + self.optional
        if any(self.full(entry) in self.results[:1] for entry in header):
            known += self.results
        places: dict[str, int] = {}
        for place, entry in enumerate(header):
            given, full = entry.strip().lower(), self.full(entry)
            if full not in known:
                what = (
                    f"an unknown column {entry!r}"
                    if given
                    else f"no name in field {place + 1} of the header"
                )
                raise TableError(
                    file,
                    line=line,
                    column=given or None,
                    found=what,
                    expected=f"{self}; delete or rename it, none is ignored",
                )
            if full in places:
                found = "this column a second time"
                raise TableError(
                    file,
                    line=line,
                    column=given,
                    found=found,
                    expected="each column once; delete one of the two",
                )
            places[full] = place
        for name in self.required:
            if name not in places:
                raise TableError(
                    file,
                    line=line,
                    column=name,
                    found="no such column",
                    expected=str(self),
                )
        return places


def read_text(path: Path, most: int = -1) -> str:
    """The UTF-8 text of a file. Raises TableError if it cannot be read, is not UTF-8, or
    has more than `most` bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(most if most < 0 else most + 1)
    except OSError as error:
        expected = "a readable file; check the path and its permissions"
        raise TableError(
            path,
            found=f"no file that can be read ({error.strerror or error})",
            expected=expected,
        ) from None
    if 0 <= most < len(data):
        raise TableError(
            path,
            found=f"more than {most / 1e6:g} million bytes",
            expected="a smaller file; is it the one that is meant?",
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        found = f"the byte 0x{data[error.start]:02x}"
        raise TableError(
            path,
            line=line,
            found=found,
            expected="UTF-8 text; save the table as CSV UTF-8",
        ) from None


def text_lines(path: Path) -> Iterator[str]:
    """The lines of a UTF-8 file, one at a time, each with its end. Raises TableError as
    `read_text` does."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            yield from file
    except (OSError, UnicodeDecodeError):
        read_text(path)  # says which


def find_separator(text: Iterable[str]) -> tuple[str, Iterator[str]]:
    """What separates the fields of a table, and its lines: the semicolon or the tab that
    its header has, which no column has in its name, or else the comma."""
    lines, first = iter(text), []
    for line in lines:
        first.append(line)
        if any(letter.isalnum() for letter in line):
            break
    header = first[-1] if first else ""
    return next((mark for mark in ";\t" if mark in header), ","), chain(first, lines)


def header_of(path: Path) -> list[str]:
    """The entries of the header of a table, none of an empty file. Raises TableError."""
    separator, lines = find_separator(text_lines(path))
    return next((row for _, row in _rows(lines, str(path), separator)), [])


def lines_of(
    text: Iterable[str],
    file: str,
    columns: Columns,
    header: Sequence[str] | None = None,
) -> Iterator[tuple[int, dict[str, str]]]:
    """(line number, fields by the full names of their columns) of every line that is
    not blank; `header`: that of a text without one. Raises TableError.

    Where semicolons or tabs separate the fields, decimals may be written with a comma,
    which becomes a point.
    """
    separator, lines = find_separator(text)
    rows = _rows(lines, file, separator)
    line = 1
    if header is None:
        line, header = next(rows, (1, None))
    if header is None:
        raise TableError(
            file,
            line=1,
            found="no text at all",
            expected=f"a header line with {columns}",
        )
    places = columns.places(list(header), file, line)
    for line, row in rows:
        if len(row) < len(places):
            missing = next(name for name, place in places.items() if place == len(row))
            raise TableError(
                file,
                line=line,
                column=missing,
                found=f"{len(row)} fields",
                expected=f"{len(places)}, as in the header",
            )
        if len(row) > len(places):
            expected = (
                f"{len(places)}, as in the header; names that hold a separator stand "
                "in quotes; decimals with a comma need semicolons or tabs between fields"
            )
            raise TableError(
                file, line=line, found=f"{len(row)} fields", expected=expected
            )
        cells = {name: row[place].strip() for name, place in places.items()}
        if separator != ",":
            for column in cells.keys() - columns.texts:
                cells[column] = _with_point(cells[column])
        yield line, cells


def _with_point(number: str) -> str:
    """A number with its decimal comma made a point; anything else as it is."""
    is_decimal = DECIMAL_COMMA.fullmatch(number)
    return number.replace(",", ".") if is_decimal else number


def name(text: str, file: str, line: int, column: str) -> str:
    """A name. Raises TableError if it is empty."""
    if not text:
        raise TableError(
            file,
            line=line,
            column=column,
            found="an empty field",
            expected=f"the name of the {column}",
        )
    return text


def number(text: str, file: str, line: int, column: str, advice: str = "") -> float:
    """A finite number. Raises TableError, with the advice."""
    try:
        value = float(text)
    except ValueError:
        value = None
    if (
        value is None or "_" in text
    ):  # Python reads 1_0 as 10; a measuring table does not
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(text) if text else "an empty field",
            expected=f"a number such as -12.345{advice}",
        )
    if not math.isfinite(value):
        raise TableError(
            file,
            line=line,
            column=column,
            found=repr(text),
            expected=f"a finite number{advice}",
        )
    return value


def _rows(
    text: Iterable[str], file: str, separator: str
) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not blank."""
    reader = csv.reader(text, delimiter=separator, strict=True, skipinitialspace=True)
    while True:
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            expected = (
                "fields with separators between them, each quotation closed on its line"
            )
            raise TableError(
                file, line=reader.line_num, found=str(error), expected=expected
            ) from None
        if any(entry.strip() for entry in row):
            yield reader.line_num, row
