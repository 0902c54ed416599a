"""`jaxro orient` and `jaxro clean` of tables of any size: Parquet in, Parquet out, part
by part. A part is a number of whole pairs.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..batches.padding import Plan
from ..reports.arrow import arrow_table
from ..reports.columns import OUTCOME_NAMES, RESULT_NAMES, Units
from ..tables import cameras as camera_files, parquet, whole
from ..tables.measured import take, to_list, to_ragged
from .causes import name_causes, tell_causes
from .model_accuracy import add_model_errors
from .solve import Task, in_use, make_results, make_verdicts, solve

PART_ROWS = 1 << 19
"""Rows of a part at most: its arrays take some 300 MB."""

CONVERTED = "input.parquet"
"""A CSV table while it is worked on."""

NAMED = 5
"""Pairs of a part that are named in a warning."""


class Part(NamedTuple):
    """Whole pairs that are worked on together: the rows where they begin, and the end
    behind them."""

    number: int
    begins: np.ndarray


@dataclass(frozen=True)
class Work:
    """Everything that one part needs: the same on this machine or another. Reads
    `source`, writes below `folder`; `file` is the table by the name that the user
    gave, and `relative` whether its standard deviations are. `plan` is None where the
    table has one pair only."""

    source: Path
    file: Path
    folder: Path
    plan: Plan | None
    cameras: camera_files.Cameras
    sigma: float | None
    task: Task
    units: Units
    relative: bool = False


class Worker:
    """Works on one part after another; its programs stay compiled."""

    def __init__(self, work: Work, threads: int | None = None):
        self._work, self._threads = work, threads
        relative = work.relative
        self._source = parquet.Source(work.source, work.file, relative=relative)

    def __call__(
        self, part: Part, told: Callable[[int], None] = lambda done: None
    ) -> dict[str, Any]:
        """The part read, worked on and written; its line for the journal."""
        work = self._work
        table = self._source.read(part.begins).with_sigma(work.sigma)
        cameras = work.cameras.of_all(table.names, table.file, photos=table.photos)
        pairs = to_ragged(table, cameras, work.sigma)
        task, plan, units = work.task, work.plan, work.units
        found = solve(pairs, task, plan, self._threads, told)
        found = name_causes(pairs, found, task, plan)
        used = in_use(pairs, found)
        if "points" in task.tables:
            found = add_model_errors(used, found, task, plan)
        causes = tell_causes(used, found.of_pairs, task.sigma_known, units.photo)
        results = make_results(table, cameras, found, task, units, causes=causes)
        written = {name: results.written(name) for name in work.task.tables}
        outcomes = {}
        if found.outcome is not None:
            written["cleaned"] = make_verdicts(table, found).written()
            outcomes = _count(found.outcome, OUTCOME_NAMES)
        doubles = parquet.repeat_points(table)[:NAMED]
        return {
            "part": part.number,
            "pairs": len(table.names),
            "rows": len(table.points),
            "results": _count(found.of_pairs["result"], RESULT_NAMES),
            "outcomes": outcomes,
            "wrong": results.wrong.size,
            "causes": results.causes_by_name(NAMED),
            "doubles": list(map(str, to_list(take(table.names, doubles)))),
            "files": self._write(part.number, written),
        }

    def _write(self, number: int, tables: dict[str, Any]) -> dict[str, str]:
        """The digests of the files of a part, each of them whole or not there at
        all."""

        def write(name: str) -> str:
            path = part_file(self._work.folder, name, number)
            path.parent.mkdir(exist_ok=True)
            with whole.draft_of(path) as draft:
                parquet.write(arrow_table(*tables[name], self._work.units), draft)
                return file_digest(draft)

        with ThreadPoolExecutor(len(tables)) as pool:
            return dict(zip(tables, pool.map(write, tables), strict=True))


def file_digest(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def part_file(folder: Path, table: str, number: int) -> Path:
    """The file of a part of a table."""
    return folder / table / f"part-{number:05}.parquet"


def _count(numbers: np.ndarray, names: Mapping[int, str]) -> dict[str, int]:
    return {names[int(k)]: int(n) for k, n in sorted(Counter(numbers.tolist()).items())}


def parts(begins: np.ndarray, rows: int) -> list[Part]:
    """Whole pairs of at most so many rows together, or one pair."""
    out, first = [], 0
    while first < len(begins) - 1:
        end = max(
            int(np.searchsorted(begins, begins[first] + rows, side="right")) - 1,
            first + 1,
        )
        out.append(Part(len(out), begins[first : end + 1]))
        first = end
    return out
