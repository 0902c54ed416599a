"""Tables of any size: measured coordinates from Parquet, part by part; CSV text made
Parquet first.

Columns are those of `tables`. The rows of a pair stand one behind the other. Names may
be text or whole numbers. A coordinate that is missing or not finite makes its pair
`non_finite_input`, and harms no other.
"""

from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from . import csv as tables
from .fields import TableError
from .measured import (
    COLUMNS,
    DEVIATIONS,
    NUMBERS,
    PHOTOS,
    Table,
    check_accuracy,
    take,
    to_floats,
    to_list,
)

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ModuleNotFoundError:
    raise SystemExit(
        "Parquet tables need pyarrow: pip install 'jaxro[cli,tables]'"
    ) from None

NAMES = ("pair", "point", *PHOTOS)

DAMAGED = OSError, pa.ArrowException, UnicodeDecodeError
"""What Arrow raises for a file that is damaged."""

BATCH = 1 << 18
"""Rows decoded at once."""


class Scan(NamedTuple):
    """Where the pairs of a table begin, with the end of the table behind them; their
    names, an Arrow array, and those of their left and right photos, where the table has
    them."""

    begins: Int[np.ndarray, " pairs+1"]
    names: Any
    photos: tuple[Any, Any] | None = None

    @property
    def lengths(self) -> Int[np.ndarray, " pair"]:
        """Points of every pair."""
        return np.diff(self.begins)


def open_file(path: Path) -> Any:
    """A Parquet file. Raises TableError where it is none."""
    try:
        return pq.ParquetFile(path, pre_buffer=False)
    except DAMAGED as error:
        raise _damaged(path, error) from None


def read_columns(path: Path) -> dict[str, list[Any]]:
    """All columns of a Parquet file by their names, None where an entry is missing.
    Raises TableError."""
    try:
        return open_file(path).read().to_pydict()
    except DAMAGED as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> TableError:
    """What is said of a file that Arrow cannot read."""
    found = f"no Parquet file that can be read ({str(error).splitlines()[0]})"
    return TableError(path, found=found, expected="a Parquet table of measured points")


class Source:
    """A Parquet table of measured points. Raises TableError where it is none.

    `told`: the file of which it is made: a CSV table; or one of another program, whose
    standard deviations are `relative`.
    """

    def __init__(self, path: Path, told: Path | None = None, relative: bool = False):
        self.path, self._own = told or path, path
        self._relative = relative
        self._has_lines = self.path != path and not relative
        self._file = open_file(path)
        self.columns = _columns(path, self._file.schema_arrow)
        self._position, self._batches = -1, iter(())
        self._left: Any = None

    @property
    def has_sigma(self) -> bool:
        """Whether the table tells the standard deviations of the coordinates."""
        there = "sigma" in self.columns or self.has_covariances
        return there and not self._relative

    @property
    def has_covariances(self) -> bool:
        """Whether the table has a standard deviation for each coordinate."""
        return DEVIATIONS[0] in self.columns

    @property
    def count(self) -> int:
        """Rows of the table."""
        return self._file.metadata.num_rows

    def scan(self) -> Scan:
        """Where the pairs begin: reads the column `pair` alone. Raises TableError where
        a pair comes in two parts."""
        if not self.count:
            raise TableError(
                self.path,
                found="no points",
                expected="one row for every measured point",
            )
        self._check_points()
        if "pair" not in self.columns:
            for name in PHOTOS:
                if name in self.columns:
                    raise TableError(
                        self.path,
                        column="pair",
                        found=f"no such column beside {name}",
                        expected="the names of the pairs",
                    )
            return Scan(np.array([0, self.count]), pa.chunked_array([[self.path.stem]]))
        begins, names, photos, row, last = [], [], [], 0, None
        wanted = [self.columns[n] for n in ("pair", *PHOTOS) if n in self.columns]
        for batch in self._file.iter_batches(BATCH, columns=wanted):
            column = batch.column(self.columns["pair"])
            if column.null_count:
                self._check_names(column, "pair", np.arange(row, row + len(column)))
            starts = _runs(column, last)
            begins.append(starts + row)
            names.append(column.take(starts))
            if len(wanted) == 3:
                own = [batch.column(self.columns[n]).take(starts) for n in PHOTOS]
                photos.append(own)
            row, last = row + len(column), column[-1].as_py()
        found = np.concatenate(begins)
        every = pa.chunked_array(names)
        self._check_names(every.combine_chunks(), "pair", found)
        self._once(every, found)
        both = None
        if photos:
            left, right = map(pa.chunked_array, zip(*photos, strict=True))
            both = left, right
        return Scan(np.append(found, row), every, both)

    def _check_points(self) -> None:
        """Raises TableError for a point without a name."""
        # by their codes, which are quick to look through. The statistics of the file
        # would be quicker, but Arrow ends the process where they are damaged
        name, row = self.columns["point"], 0
        file = pq.ParquetFile(self._own, pre_buffer=False, read_dictionary=[name])
        for batch in file.iter_batches(BATCH, columns=[name]):
            self._check_names(
                batch.column(0), "point", np.arange(row, row + len(batch))
            )
            row += len(batch)

    def _check_names(self, column: Any, full: str, rows: np.ndarray) -> None:
        """Raises TableError where a name, of these rows, is missing or blank."""
        codes = column
        if not pa.types.is_dictionary(column.type):
            codes = column.dictionary_encode()
        trimmed = pc.utf8_trim_whitespace(codes.dictionary.cast(pa.string()))  # pyright: ignore[reportAttributeAccessIssue]
        blank = pc.equal(trimmed, "")  # pyright: ignore[reportAttributeAccessIssue]
        if not (codes.null_count or blank.null_count or pc.any(blank).as_py()):  # pyright: ignore[reportAttributeAccessIssue]
            return
        unnamed = blank.take(codes.indices).fill_null(True)
        places = np.flatnonzero(unnamed.to_numpy(zero_copy_only=False))
        if len(places):
            raise TableError(
                self.path,
                column=full,
                found=f"nothing in {self.place(int(rows[places[0]]))}",
                expected=f"the name of the {full}",
            )

    def _once(self, names: Any, begins: np.ndarray) -> None:
        if len(names.unique()) == len(names):
            return
        seen: set = set()
        for name, row in zip(names.to_pylist(), begins, strict=True):
            if name in seen:
                found = (
                    f"pair {name!r} again in {self.place(int(row))}, after other pairs"
                )
                raise TableError(
                    self.path,
                    column="pair",
                    found=found,
                    expected="the rows of a pair one behind the other: sort the table",
                )
            seen.add(name)

    def place(self, row: int) -> str:
        """How a row is told of: by its line where the table has been converted."""
        if not self._has_lines:
            return f"row {row + 1}"
        line, *_ = next(islice(tables.lines(self.path), row, None))
        return f"line {line}"

    def read(self, begins: np.ndarray) -> Table:
        """The pairs that begin with these rows, and end before the last of them."""
        rows = self._rows(int(begins[0]), int(begins[-1]))
        own = begins - begins[0]
        if "pair" in rows.column_names:
            names = rows.column("pair").take(pa.array(own[:-1])).combine_chunks()
        else:
            names = pa.array([self.path.stem] * (len(own) - 1))
        photos = None
        if all(name in rows.column_names for name in PHOTOS):
            left, right = (self._once_a_pair(rows.column(n), own, n) for n in PHOTOS)
            photos = left, right
        return Table(
            file=str(self.path),
            names=names,
            begins=own,
            points=rows.column("point"),
            numbers={n: rows.column(n) for n in NUMBERS if n in rows.column_names},
            photos=photos,
            relative=self._relative,
        )

    def _once_a_pair(self, column: Any, begins: np.ndarray, name: str) -> Any:
        """The values of the pairs, of a column with one in each row. Raises TableError
        where a pair has several."""
        of_pairs = column.take(pa.array(begins[:-1]))
        owners = np.repeat(np.arange(len(begins) - 1), np.diff(begins))
        every = of_pairs.take(pa.array(owners))
        if not pc.all(pc.equal(column, every)).as_py():  # pyright: ignore[reportAttributeAccessIssue]
            raise TableError(
                self.path,
                column=name,
                found="several photos in the rows of one pair",
                expected="the same two photos in all rows of a pair",
            )
        return of_pairs.combine_chunks()

    def _rows(self, begin: int, end: int) -> Any:
        """These rows as an Arrow table with the full names of the columns; one behind
        the other is read only once."""
        if begin != self._position:
            self._seek(begin)
        taken, wanted = [], end - begin
        while wanted:
            piece = self._left if self._left is not None else next(self._batches)
            part = piece.slice(0, wanted)
            self._left = piece.slice(len(part)) if len(part) < len(piece) else None
            taken.append(part)
            wanted -= len(part)
        self._position = end
        table = pa.Table.from_batches(taken)
        return table.rename_columns([COLUMNS.full(name) for name in table.column_names])

    def _seek(self, row: int) -> None:
        """The next batch begins with this row."""
        group, before = 0, 0
        while before + self._file.metadata.row_group(group).num_rows <= row:
            before += self._file.metadata.row_group(group).num_rows
            group += 1
        groups = list(range(group, self._file.metadata.num_row_groups))
        self._batches = self._file.iter_batches(
            BATCH, row_groups=groups, columns=list(self.columns.values())
        )
        self._left, skip = None, row - before
        while skip:
            piece = next(self._batches)
            self._left = piece.slice(skip) if skip < len(piece) else None
            skip -= min(skip, len(piece))


def _columns(path: Path, schema: Any) -> dict[str, str]:
    """The columns in the table by their full names. Raises TableError for missing,
    unknown or unsuitable ones."""
    places = COLUMNS.places(schema.names, str(path), None)
    check_accuracy(tuple(places), str(path))
    for full, place in places.items():
        field = schema.field(place)
        named = full in NAMES
        t = field.type.value_type if pa.types.is_dictionary(field.type) else field.type
        text = pa.types.is_string(t) or pa.types.is_large_string(t)
        good = (
            text or pa.types.is_integer(t)
            if named
            else pa.types.is_floating(t) or pa.types.is_integer(t)
        )
        if not good:
            expected = "text or whole numbers" if named else "numbers"
            raise TableError(
                path,
                column=field.name,
                found=f"values of type {field.type}",
                expected=expected,
            )
    return {full: schema.names[place] for full, place in places.items()}


def _runs(column: Any, last: Any) -> np.ndarray:
    """Where another value begins; `last`: the value before the first."""
    codes = (
        column.dictionary_encode().indices.to_numpy()
        if not pa.types.is_dictionary(column.type)
        else None
    )
    codes = column.indices.to_numpy() if codes is None else codes
    starts = np.flatnonzero(np.diff(codes)) + 1
    return (
        starts
        if last is not None and column[0].as_py() == last
        else np.concatenate([[0], starts])
    )


def read_whole(path: Path) -> Table:
    """All pairs of a table together, in NumPy as those of CSV text. Raises
    TableError."""
    source = Source(path)
    table = source.read(source.scan().begins)
    twice = repeat_points(table)
    if len(twice):
        raise TableError(
            path,
            column="point",
            found=f"a point a second time in pair {to_list(table.names)[twice[0]]!r}",
            expected="each point once in a pair; rename it or delete one of the two",
        )
    texts = lambda column: np.array([str(name) for name in to_list(column)], object)
    left, right = map(texts, table.photos or ((), ()))
    return replace(
        table,
        names=texts(table.names),
        points=texts(table.points),
        numbers={name: to_floats(column) for name, column in table.numbers.items()},
        photos=None if table.photos is None else (left, right),
    )


def repeat_points(table: Table) -> np.ndarray:
    """The numbers of the pairs that have two points of one name."""
    begins = table.begins
    codes = table.points.combine_chunks()
    codes = codes if pa.types.is_dictionary(codes.type) else codes.dictionary_encode()
    codes = codes.indices.to_numpy(zero_copy_only=False).astype(np.int64)
    rising = np.diff(codes) > 0
    rising[begins[1:-1] - 1] = True
    if np.all(rising):  # the names come in one order in every pair: none can come twice
        return np.zeros(0, int)
    key = np.sort(table.owners * (int(codes.max()) + 1) + codes)
    return np.unique(key[1:][np.diff(key) == 0] // (int(codes.max()) + 1))


def to_arrow(table: Table) -> Any:
    """The pairs as an Arrow table that `Source` reads."""
    pairs = {"pair": take(table.names, table.owners), **table.photos_of_rows}
    columns = {**pairs, "point": table.points, **table.numbers}
    return pa.table({name: pa.array(column) for name, column in columns.items()})


def write(table: Any, path: Path) -> None:
    """The table as a Parquet file."""
    pq.write_table(table, path, **encoding(table.schema))


def encoding(schema: Any) -> dict[str, Any]:
    """How tables are written: only names are worth a dictionary."""
    repeated = [
        f.name
        for f in schema
        if not (pa.types.is_floating(f.type) or pa.types.is_boolean(f.type))
    ]
    return {"use_dictionary": repeated, "compression": "snappy"}
