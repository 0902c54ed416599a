"""The files of --out, in full precision: elements.csv, residuals.csv, points.csv, reliability.csv and summary.json.

All or none in a new folder; in one that is there each file takes the place of the old one when all are written.

A number is written as its shortest text that reads back as the same float. What does not exist is an empty cell, null
in JSON. Headers carry the units; angles are degrees.
"""

import csv
import io
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..assessment import Pattern
from . import reading
from .fields import TableError
from .solutions import Element, Solution, Units, pattern_of_all, with_pattern


def check_target(directory: Path, force: bool) -> None:
    """Raises TableError unless a result may be written there."""
    check_name(directory, "a name for the folder of results")
    if directory.exists() and not directory.is_dir():
        raise TableError(directory, None, None, "a file", "the name of a folder for the results")
    if not force and directory.exists() and any(directory.iterdir()):
        raise TableError(directory, None, None, "a folder that is not empty", "a new folder, or --force to overwrite")


def check_name(path: Path, expected: str) -> None:
    """Raises TableError where the disk knows no such name, or none for a draft beside it."""
    whole = path.resolve()
    if not whole.name:
        raise TableError(path, None, None, "the root of all folders", expected)
    try:
        whole.with_name(f".{whole.name}.{os.getpid()}.unfinished.old").lstat()
    except FileNotFoundError:
        pass
    except OSError as error:
        raise TableError(path, None, None, error.strerror or str(error), expected) from None


def is_parquet(file: Path) -> bool:
    """Whether the name of a file says that it is a Parquet table."""
    return file.suffix.lower() in (".parquet", ".pq")


def texts(solved: list[Solution], units: Units, summary: dict[str, Any]) -> dict[str, str]:
    """The content of the files by name."""
    return {
        "elements.csv": csv_text(_element_rows(solved, units)),
        "residuals.csv": csv_text(_point_rows(solved, RESIDUALS, units)),
        "points.csv": csv_text(_point_rows(solved, POINTS, units)),
        "reliability.csv": csv_text(reading.file_rows(solved, units)),
        "summary.json": _json(solved, units, summary),
    }


def write(directory: Path, texts: Mapping[str, str | bytes], read: Sequence[Path | None] = ()) -> None:
    """All files by name, first complete in a folder beside `directory`, then renamed into place.

    Raises TableError, with nothing written, where the disk refuses, or one would take the place of a file that was
    `read`.
    """
    for file in read:
        if file is not None and file.resolve() in [(directory / name).resolve() for name in texts]:
            raise TableError(file, None, None, "a table to be read where a result is to be written", "another --out")
    draft = directory.absolute().with_name(f".{directory.absolute().name}.{os.getpid()}.partial")
    try:
        draft.mkdir(parents=True)
        for name, text in texts.items():
            (draft / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        if directory.exists():
            for name in texts:
                os.replace(draft / name, directory / name)
        else:
            os.replace(draft, directory)
    except OSError as error:
        raise TableError(directory, None, None, error.strerror or str(error), "a folder that can be written") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def check_file(path: Path, force: bool) -> None:
    """Raises TableError unless a single result may be written there."""
    check_name(path, "a name for the file of the result")
    if path.is_dir():
        raise TableError(path, None, None, "a folder", "the name of a file for the result")
    if not force and path.exists():
        raise TableError(path, None, None, "a file that exists", "a new name, or --force to overwrite")


def write_file(path: Path, text: str) -> None:
    """The whole file or none. Raises TableError."""
    draft = path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        draft.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8", newline="")
        os.replace(draft, path)
    except OSError as error:
        raise TableError(path, None, None, error.strerror or str(error), "a file that can be written") from None
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


RESIDUALS = ("q", "v_x_left", "v_y_left", "v_x_right", "v_y_right", "redundancy", "in_front")
POINTS = ("X", "Y", "Z")


def _element_rows(solved: list[Solution], units: Units) -> list[list[Any]]:
    header: list[Any] = ["pair", "result", "points", "degrees_of_freedom", "iterations"]
    for e in solved[0].elements:
        header += [head(e.name, e.unit)] + ([] if e.deviation is None else [head(f"sd_{e.name}", e.unit)])
    rows: list[list[Any]] = [[*header, head("m_q", units.photo), head("sigma0", units.sigma0), "advice"]]
    for s in solved:
        row = [s.measured.name, s.result, len(s.measured.points), *_counts(s).values()]
        for e in s.elements:
            row += [e.value] + ([] if e.deviation is None else [e.deviation])
        rows.append([*row, s.m_q, s.sigma0, s.advice])
    return rows


def _point_rows(solved: list[Solution], keys: tuple[str, ...], units: Units) -> list[list[Any]]:
    unit = {"redundancy": "", "in_front": "", **dict.fromkeys(POINTS, units.model)}
    rows: list[list[Any]] = [["pair", "point", *(head(key, unit.get(key, units.photo)) for key in keys)]]
    for s in solved:
        rows += [[s.measured.name, values["point"], *(values[key] for key in keys)] for values in s.points]
    return rows


def head(name: str, unit: str) -> str:
    """The header of a column."""
    return f"{name}_{unit}" if unit else name


def _counts(s: Solution) -> dict[str, int]:
    o = s.orientation
    return {"degrees_of_freedom": int(o.degrees_of_freedom), "iterations": int(o.iterations)}


def _exists(value: Any) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def csv_text(rows: list[list[Any]]) -> str:
    """Rows as CSV, the first of them the header."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(
        [str(value).lower() if isinstance(value, bool) else value if _exists(value) else "" for value in row]
        for row in rows
    )
    return text.getvalue()


def _pattern(pattern: Pattern | None, units: Units) -> dict[str, float] | None:
    """The test of a pattern in the residuals."""
    if pattern is None:
        return None
    told = {"probability": pattern.probability, "rho": pattern.rho, head("length", units.photo): pattern.length}
    return {name: float(value) for name, value in told.items()}


def _json(solved: list[Solution], units: Units, summary: dict[str, Any]) -> str:
    tested = {id(s) for s in with_pattern(solved)}
    pairs = [
        {
            "pair": s.measured.name,
            "result": s.result,
            "usable": s.usable,
            "advice": s.advice,
            "points": len(s.measured.points),
            **_counts(s),
            "m_q": s.m_q,
            "sigma0": s.sigma0,
            "elements": {e.name: _element(e) for e in s.elements},
            "correlations": s.correlations,
            "pattern": _pattern(s.pattern if id(s) in tested else None, units),
            "cameras": [
                {
                    "focal": c.focal,
                    "principal_point": list(c.principal_point),
                    "pixel_size": c.pixel_size,
                    "y_down": c.y_down,
                }
                for c in s.cameras
            ],
        }
        for s in solved
    ]
    whole = {
        **summary,
        "units": {"photo": units.photo, "model": units.model, "sigma0": units.sigma0 or None, "angles": "deg"},
        "pattern": _pattern(pattern_of_all(solved), units),
        "pairs": pairs,
    }
    return json_text(whole)


def _element(e: Element) -> dict[str, Any]:
    value = {"unit": e.unit or None, "value": e.value, "sd": e.deviation}
    return value if e.half_width is None else value | {"half_width": e.half_width}


def json_text(value: Any) -> str:
    """The value as JSON."""
    return json.dumps(_clean(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _clean(value: Any) -> Any:
    """The value with null for every number that does not exist."""
    if isinstance(value, dict):
        return {key: _clean(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(entry) for entry in value]
    return value if _exists(value) else None
