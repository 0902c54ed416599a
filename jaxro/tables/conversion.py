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
from .measured import COLUMNS, NUMBERS
from .parquet import BATCH, NAMES, encoding, pa, pc, pq


def convert(source: Path, target: Path) -> None:
    """A CSV table as a Parquet table, in bounded memory. Raises TableError with line
    and column."""
    with whole.draft_of(target) as draft:
        try:
            _convert_quickly(source, draft)
        except (pa.ArrowInvalid, pa.ArrowKeyError):
            _convert_carefully(source, draft)  # or says what is wrong where


def _convert_quickly(source: Path, draft: Path) -> None:
    """By Arrow, which is to find what `tables` would. Raises ArrowInvalid where it
    might not."""
    line, header = 1, []
    with (
        suppress(OSError, UnicodeDecodeError, csv.Error),
        source.open(encoding="utf-8-sig", newline="") as file,
    ):
        rows = csv.reader(file, skipinitialspace=True)
        header = next((row for row in rows if any(entry.strip() for entry in row)), [])
        line = rows.line_num
    if not header or _odd(source):
        raise pa.ArrowInvalid("for the careful reader")
    COLUMNS.places(header, str(source), line)
    full = [COLUMNS.full(name) for name in header]
    types = {c: pa.string() if c in NAMES else pa.float64() for c in full}
    reader = arrow_csv.open_csv(
        source,
        parse_options=arrow_csv.ParseOptions(invalid_row_handler=_blank),
        read_options=arrow_csv.ReadOptions(
            column_names=full, skip_rows=line, block_size=1 << 24
        ),
        convert_options=arrow_csv.ConvertOptions(column_types=types, null_values=[]),
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
    lines, writer = tables.lines(source), None
    while rows := list(islice(lines, BATCH)):
        _, pairs, points, values = zip(*rows, strict=True)
        columns = {"pair": pairs} if pairs[0] else {}
        batch = pa.table(
            columns
            | {"point": points}
            | dict(zip(NUMBERS, zip(*values, strict=True), strict=False))
        )
        writer = writer or pq.ParquetWriter(
            draft, batch.schema, **encoding(batch.schema)
        )
        writer.write_table(batch)
    if writer is None:
        raise tables.no_points(str(source), 1)
    writer.close()


def _odd(source: Path) -> bool:
    """Whether a quotation begins behind blanks, of which Arrow makes a part of the
    name."""
    with (
        source.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text,
    ):
        return re.search(rb'[,\n] +"', text) is not None


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
            name == "sigma" and not np.all(values > 0)
        ):
            raise pa.ArrowInvalid(f"a number that cannot be used in column {name}")
