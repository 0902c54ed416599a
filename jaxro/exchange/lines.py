"""Lines of numbers in the text files of other programs, one behind the other, each told
by its number where it does not fit."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..tables.fields import DECIMAL_COMMA, TableError, text_lines

DIGITS = 18
"""Most digits of a whole number, which fits into 64 bits then."""


class Lines:
    """The lines of a UTF-8 file. `number`: of the line that was read last."""

    def __init__(self, path: Path):
        self.file, self.number = str(path), 0
        self._lines = text_lines(path)

    def next_of_any(self) -> str | None:
        """The next line, whatever it holds; None behind the last one. Raises TableError
        where the file cannot be read."""
        line = next(self._lines, None)
        self.number += 1
        return None if line is None else line.strip()

    def next(self) -> str | None:
        """The next line that is neither blank nor a comment; None behind the last."""
        line = self.next_of_any()
        while line is not None and (not line or line.startswith("#")):
            line = self.next_of_any()
        return line

    def fields(self, what: str) -> list[str]:
        """The fields of the next line up to a comment. Raises TableError at the end of
        the file; `what`: the line was to hold."""
        line = self.next()
        if line is None:
            raise self.error("the end of the file", what)
        fields = line.split()
        comments = (k for k, field in enumerate(fields) if field.startswith("#"))
        return fields[: next(comments, None)]

    def numbers_of_line(self, what: str, names: Sequence[str]) -> list[float]:
        """The next line as so many numbers with these names, nan for a field that is no
        number. Raises TableError for another count of fields."""
        fields = self.fields(f"{what}: {' '.join(names)}")
        if len(fields) != len(names):
            found = f"{len(fields)} fields for {what}"
            raise self.error(found, f"{len(names)}: {' '.join(names)}")
        return [
            self.value(field, f"{what}, {name}")
            for field, name in zip(fields, names, strict=True)
        ]

    def value(self, field: str, column: str) -> float:
        """The number of a field, nan where it is none (some programs write -1.#IND).
        Raises TableError for a decimal comma, which all numbers of a file then have."""
        try:
            return np.nan if "_" in field else float(field)
        except ValueError:
            if DECIMAL_COMMA.fullmatch(field):
                found = f"{field!r}, a comma in a number"
                raise self.error(found, "decimals with a point", column) from None
            return np.nan

    def number_of(self, field: str, column: str) -> float:
        """The finite number of a field. Raises TableError."""
        value = self.value(field, column)
        if not np.isfinite(value):
            raise self.error(repr(field), "a finite number such as -12.345", column)
        return value

    def whole(self, field: str, column: str) -> int:
        """The whole number of a field that is not negative. Raises TableError."""
        if not is_whole(field):
            self.value(field, column)  # tells a comma
            raise self.error(repr(field), "a whole number such as 12", column)
        return int(field)

    def error(
        self,
        found: str,
        expected: str,
        column: str | None = None,
        line: int | None = None,
    ) -> TableError:
        """The error at this line, or at another one."""
        line = self.number if line is None else line
        return TableError(
            self.file, line=line, column=column, found=found, expected=expected
        )


def is_whole(field: str) -> bool:
    """Whether a field is a whole number that is not negative."""
    return field.isascii() and field.isdigit() and len(field) <= DIGITS
