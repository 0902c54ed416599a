"""`jaxro orient` and `jaxro clean` of tables of any size: Parquet in, Parquet out, part
by part.

    DIR.unfinished/       while the work goes on; no DIR until all of it is there
        journal.jsonl     what was asked for, then one line for each finished part
        elements/part-00000.parquet, residuals/..., points/...
    DIR/                  the same folder, renamed at the end

A part is a number of whole pairs. Its files are complete before its line in the journal
is, so that a run that was stopped at any moment goes on with the first part that has no
line, and ends in the same bytes.
"""

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..batches.padding import Plan
from ..batches.ragged import clean_ragged, orient_ragged
from ..rejection import AbstractProcedure, Rejection
from ..reports import records
from ..reports.files import json_text
from ..reports.records import Recorder
from ..reports.solutions import NAMES, Units
from ..reports.verdicts import NAMES as OUTCOMES, decision, unusable
from ..tables import cameras as camera_files, parquet
from ..tables.fields import TableError

PART_ROWS = 1 << 19
"""Rows of a part at most: its arrays take some 300 MB."""

JOURNAL = "journal.jsonl"

MODIFIED = "modified_ns"
"""When the files that were read were written: part of a request, by which another one
is known, not of a summary."""

CONVERTED = "input.parquet"
"""A CSV table while it is worked on."""

WARNED = 5
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
    gave."""

    source: Path
    file: Path
    folder: Path
    plan: Plan
    cameras: camera_files.Cameras
    sigma: float | None
    recorder: Recorder
    keywords: dict[str, Any]
    units: Units
    procedure: AbstractProcedure | None = None


class Worker:
    """Works on one part after another; its programs stay compiled."""

    def __init__(self, work: Work, threads: int | None = None):
        self._work, self._source, self._threads = (
            work,
            parquet.Source(work.source, work.file),
            threads,
        )

    def __call__(
        self, part: Part, told: Callable[[int], None] = lambda done: None
    ) -> dict[str, Any]:
        """The part read, worked on and written; its line for the journal."""
        w = self._work
        table = self._source.rows(int(part.begins[0]), int(part.begins[-1]))
        begins = part.begins - part.begins[0]
        names = parquet.names(table, begins[:-1], str(w.file))
        pairs = parquet.ragged(
            table, begins, w.cameras.of_all(names, str(w.file)), w.sigma
        )
        how = {"plan": w.plan, "threads": self._threads}
        kept, outcomes, tables = None, None, {}
        if w.procedure is not None:
            outcomes, decided = clean_ragged(pairs, w.procedure, select=_decided, **how)
            kept = decided["kept"]
            # of unusable points the orientation tells
            pairs = pairs._replace(
                mask=pairs.mask & (kept | unusable(kept, decided["order"]))
            )
        progress = lambda done, total: told(done)
        of_pair, of_points = orient_ragged(
            pairs, read=w.recorder, progress=progress, **how, **w.keywords
        )
        points = (
            pairs.lengths
            if kept is None
            else np.add.reduceat(kept.astype(int), begins[:-1])
        )
        tables["elements"] = self._elements(points, names, of_pair, outcomes)
        rows = {
            "pair": names.take(parquet.owners(begins)),
            "point": table.column("point"),
        }
        if kept is not None:
            tables["cleaned"] = self._cleaned(
                table, rows, decided, of_points["residuals"]["q"]
            )
        for name, columns in of_points.items():
            tables[name] = records.table(
                rows, {c: columns[c] for c in records.COLUMNS[name]}, w.units
            )
            if kept is not None:
                tables[name] = tables[name].filter(kept)
        doubles = parquet.twice(table, begins)
        return {
            "part": part.number,
            "pairs": len(names),
            "rows": len(table),
            "results": _counted(of_pair["result"], NAMES),
            "outcomes": {} if outcomes is None else _counted(outcomes, OUTCOMES),
            "doubles": [str(name) for name in names.take(doubles[:WARNED]).to_pylist()],
            "files": self._written(part.number, tables),
        }

    def _elements(
        self,
        points: np.ndarray,
        names: Any,
        of_pair: dict[str, np.ndarray],
        outcomes: np.ndarray | None,
    ) -> Any:
        values = of_pair | {
            "result": records.names_of(of_pair["result"], NAMES),
            "points": points,
        }
        ordered = {
            c: values[c] for c in records.element_columns(self._work.recorder.system)
        }
        outcome = (
            {}
            if outcomes is None
            else {"outcome": records.names_of(outcomes, OUTCOMES)}
        )
        return records.table({"pair": names}, outcome | ordered, self._work.units)

    def _cleaned(
        self,
        table: Any,
        rows: dict[str, Any],
        decided: dict[str, np.ndarray],
        q: np.ndarray,
    ) -> Any:
        """Every row of the input with its verdict."""
        measured = {
            name: table.column(name) for name in table.column_names if name not in rows
        }
        order = records.where(decided["order"].astype(np.int32), ~decided["kept"])
        verdict = {
            "kept": decided["kept"],
            "undecided": decided["undecided"],
            "order": order,
        }
        verdict |= {"statistic": decided["statistic"]}
        return records.table(
            {**rows, **measured},
            verdict | {"limit": decided["limit"], "q": q},
            self._work.units,
        )

    def _written(self, number: int, tables: dict[str, Any]) -> dict[str, int]:
        """The sizes of the files of a part, each of them whole or not there at all."""

        def write(name: str, table: Any) -> int:
            path = self._work.folder / name / f"part-{number:05}.parquet"
            path.parent.mkdir(exist_ok=True)
            draft = path.with_suffix(".partial")
            parquet.write(table, draft)
            os.replace(draft, path)
            return path.stat().st_size

        with ThreadPoolExecutor(len(tables)) as pool:
            return dict(
                zip(tables, pool.map(write, tables, tables.values()), strict=True)
            )


def _decided(rejection: Rejection) -> tuple[Any, dict[str, Any]]:
    """The outcome of a pair; of every point what `verdicts.decision` says."""
    found = decision(rejection)._asdict()
    return found.pop("outcome"), found


def _counted(numbers: np.ndarray, names: dict[int, str]) -> dict[str, int]:
    return {names[int(k)]: int(n) for k, n in sorted(Counter(numbers.tolist()).items())}


class Job:
    """A table of any size, what is to be done with it, and how far it is."""

    def __init__(
        self, work: Work, parts: list[Part], target: Path, request: dict[str, Any]
    ):
        self.work, self.parts, self.target, self.request = work, parts, target, request
        self.entries: list[dict[str, Any]] = []

    @property
    def pairs(self) -> int:
        """All pairs of the table."""
        return sum(len(part.begins) - 1 for part in self.parts)

    @property
    def left(self) -> list[Part]:
        """The parts that are not finished."""
        done = {entry["part"] for entry in self.entries}
        return [part for part in self.parts if part.number not in done]

    @property
    def done(self) -> int:
        """Pairs in finished parts."""
        return sum(entry["pairs"] for entry in self.entries)

    @property
    def begun(self) -> bool:
        """Whether there is a journal that says what was asked for."""
        path = self.work.folder / JOURNAL
        return path.exists() and any(True for _ in _whole_lines(path))

    def begin(self) -> None:
        """A new journal. Raises TableError where the folder cannot be written."""
        try:
            self.work.folder.mkdir(parents=True, exist_ok=True)
            self._rewritten()
        except OSError as error:
            found = error.strerror or str(error)
            raise TableError(
                self.work.folder, found=found, expected="a folder that can be written"
            ) from None

    def go_on(self) -> None:
        """What an earlier run finished. Raises TableError where it was asked for
        something else."""
        path = self.work.folder / JOURNAL
        lines = list(_whole_lines(path))
        before = lines[0].get("request", {})
        for key in sorted(set(before) | set(self.request)):
            if before.get(key) != self.request.get(key):
                found = (
                    f"{key} = {before.get(key)!r} in the run to be resumed, "
                    f"{self.request.get(key)!r} now"
                )
                raise TableError(
                    path,
                    line=1,
                    found=found,
                    expected="the same table and options, or a new --out",
                )
        self.entries = [entry for entry in lines[1:] if self._stands(entry)]
        self._rewritten()  # without a line that was cut off

    def finished(self, entry: dict[str, Any]) -> None:
        """A part is written: its line in the journal."""
        _append(self.work.folder / JOURNAL, entry)
        self.entries.append(entry)

    def end(self) -> dict[str, Any]:
        """The summary, when every part is finished; the folder takes its name."""
        folder = self.work.folder
        self.entries.sort(key=lambda entry: entry["part"])
        whole: dict[str, Any] = {
            "pairs": self.done,
            "rows": sum(entry["rows"] for entry in self.entries),
        }
        for key in ("results", "outcomes"):
            total: Counter = Counter()
            for entry in self.entries:
                total.update(entry[key])
            whole |= {key: dict(sorted(total.items()))} if total else {}
        doubles = [name for entry in self.entries for name in entry["doubles"]]
        whole["pairs_with_two_points_of_one_name"] = doubles
        asked = {key: value for key, value in self.request.items() if key != MODIFIED}
        units = asdict(self.work.units) | {
            "sigma0": self.work.units.sigma0 or None,
            "angles": "deg",
        }
        summary = {**asked, **whole, "units": units}
        (folder / "summary.json").write_text(json_text(summary), encoding="utf-8")
        for stray in (*folder.rglob("*.partial"), folder / CONVERTED):
            stray.unlink(missing_ok=True)
        if self.target.exists():
            old = self.target.with_name(f".{self.target.name}.{os.getpid()}.old")
            os.replace(self.target, old)
        os.replace(folder, self.target)
        replaced = re.compile(
            rf"\.{re.escape(self.target.name)}\.\d+\.old"
        )  # by this run, or by one that was killed
        for old in filter(
            lambda path: replaced.fullmatch(path.name),
            list(self.target.parent.iterdir()),
        ):
            shutil.rmtree(old)
        (
            self.target / JOURNAL
        ).unlink()  # last: a run that is stopped before can still be resumed
        return whole

    def _rewritten(self) -> None:
        """The journal of what is known, whole or as it was."""
        path = self.work.folder / JOURNAL
        draft = path.with_suffix(".partial")
        draft.unlink(missing_ok=True)
        _append(draft, {"request": self.request}, *self.entries)
        os.replace(draft, path)

    def _stands(self, entry: dict[str, Any]) -> bool:
        """Whether the files of a finished part are what they were."""
        place = lambda name: (
            self.work.folder / f"{name}/part-{entry['part']:05}.parquet"
        )
        return all(
            place(n).exists() and place(n).stat().st_size == size
            for n, size in entry["files"].items()
        )


def _append(path: Path, *entries: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.writelines(json.dumps(entry) + "\n" for entry in entries)
        file.flush()
        os.fsync(file.fileno())


def _whole_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of a journal up to one that was cut off."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError:
        raise TableError(
            path,
            found="no journal",
            expected="the --out of a run that was stopped, to resume it",
        ) from None
    for line in text.splitlines(keepends=True):
        try:
            entry = json.loads(line) if line.endswith("\n") else None
        except json.JSONDecodeError:
            entry = None
        if not isinstance(entry, dict):
            return
        yield entry


def asked_before(folder: Path) -> dict[str, Any]:
    """What the run in this folder was asked for; nothing where it has no journal."""
    lines = _whole_lines(folder / JOURNAL) if (folder / JOURNAL).exists() else iter(())
    return next(lines, {}).get("request", {})


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


def here(job: Job, told: Callable[[int], None]) -> Iterable[dict[str, Any]]:
    """The lines of all parts that are left, worked on in this process."""
    worker, done = Worker(job.work), job.done
    for part in job.left:
        entry = worker(part, lambda number, before=done: told(before + number))
        done += entry["pairs"]
        yield entry
