"""CSV tables of any size as Parquet tables: by Arrow where it reads them as `tables`
does, else line by line."""

import csv
import mmap
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as arrow_csv

from . import csv as tables, whole
from .fields import find_separator
from .measured import (
    COLUMNS,
    COVARIANCES,
    DEVIATIONS,
    OF_CLEANING,
    PHOTOS,
    check_accuracy,
)
from .parquet import BATCH, NAMES, encoding, pa, pc, pq


def convert(source: Path, target: Path) -> None:
    """A CSV table as a Parquet table, in bounded memory. Raises TableError with line and
    column."""
    with whole.draft_of(target) as draft:
        for point in ".,":
            with suppress(pa.ArrowInvalid, pa.ArrowKeyError):
                return _convert_quickly(source, draft, point)
        # or says what is wrong where
        _convert_carefully(source, draft)


def _convert_quickly(source: Path, draft: Path, point: str) -> None:
    """By Arrow, which is to find what `tables` would, with this decimal point. Raises
    ArrowInvalid where it might not."""
    line, header, separator = 1, [], ","
    with (
        suppress(OSError, UnicodeDecodeError, csv.Error),
        source.open(encoding="utf-8-sig", newline="") as file,
    ):
        separator, lines = find_separator(file)
        rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
        header = next((row for row in rows if any(entry.strip() for entry in row)), [])
        line = rows.line_num
    if not header or point == separator or _odd(source, separator):
        raise pa.ArrowInvalid("for the careful reader")
    COLUMNS.places(header, str(source), line)
    check_accuracy([COLUMNS.full(name) for name in header], str(source))
    full = [COLUMNS.full(name) for name in header]
    if set(PHOTOS) & set(full) or OF_CLEANING[0] in full:
        raise pa.ArrowInvalid("for the careful reader")
    types = {c: pa.string() if c in NAMES else pa.float64() for c in full}
    reader = arrow_csv.open_csv(
        source,
        parse_options=arrow_csv.ParseOptions(
            delimiter=separator, invalid_row_handler=_blank
        ),
        read_options=arrow_csv.ReadOptions(
            column_names=full, skip_rows=line, block_size=1 << 24
        ),
        convert_options=arrow_csv.ConvertOptions(
            column_types=types, null_values=[], decimal_point=point
        ),
    )
    schema, count = pa.schema(types), 0
    with pq.ParquetWriter(draft, schema, **encoding(schema)) as writer:
        for batch in reader:
            _check(batch)
            for place, name in enumerate(batch.schema.names):
                if name in NAMES:
                    trimmed = pc.utf8_trim_whitespace(batch.column(place))  # pyright: ignore
                    batch = batch.set_column(place, name, trimmed)
            writer.write_batch(batch)
            count += len(batch)
    if not count:
        raise pa.ArrowInvalid("no rows")


def _convert_carefully(source: Path, draft: Path) -> None:
    """Line by line, a tenth as fast. Raises TableError."""
    lines = (line for line in tables.lines(source) if line.kept)
    writer = None
    while rows := list(islice(lines, BATCH)):
        _, pairs, points, values, photos, names, _ = zip(*rows, strict=True)
        columns = {"pair": pairs} if pairs[0] else {}
        if photos[0]:
            columns |= dict(zip(PHOTOS, zip(*photos, strict=True), strict=True))
        batch = pa.table(
            columns
            | {"point": points}
            | dict(zip(names[0], zip(*values, strict=True), strict=True))
        )
        writer = writer or pq.ParquetWriter(
            draft, batch.schema, **encoding(batch.schema)
        )
        writer.write_table(batch)
    if writer is None:
        raise tables.no_points(str(source), 1)
    writer.close()


def _odd(source: Path, separator: str) -> bool:
    """Whether a quotation mark does not open or close a whole field of one line: the
    two readers might think differently of it."""
    ends = rf"{separator}\r\n"
    opening = rf'(?<=[{separator}\n]")(?![^"\r\n]*"[{ends}])'
    others = rf'(?<![{separator}\n]")(?![{ends}])'
    odd = re.compile(rf'"(?:(?<=[ \t]")|{opening}|{others})'.encode())
    with (
        source.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text,
    ):
        return odd.search(text) is not None


def _blank(row: Any) -> str:
    """Lines of blanks are no rows, as in `tables`."""
    return "error" if row.text.strip() else "skip"


def _check(batch: Any) -> None:
    """Raises ArrowInvalid for what the careful reader would not take."""
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        if name in NAMES:
            if any(not text.strip() for text in column.unique().to_pylist()):
                raise pa.ArrowInvalid(f"an empty field in column {name}")
        elif not np.all(np.isfinite(values := column.to_numpy())) or (
            name in ("sigma", *DEVIATIONS) and not np.all(values > 0)
        ):
            raise pa.ArrowInvalid(f"a number that cannot be used in column {name}")
    for side, name in enumerate(COVARIANCES):
        if name in batch.schema.names:
            x, y = (batch.column(n).to_numpy() for n in DEVIATIONS[2 * side :][:2])
            if not np.all(np.abs(batch.column(name).to_numpy()) < x * y):
                raise pa.ArrowInvalid(f"a number that cannot be used in column {name}")
