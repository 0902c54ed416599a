"""How far the work on a table of any size is: a journal in the folder of its results.

    DIR.unfinished/       while the work goes on; no DIR until all of it is there
        journal.jsonl     what was asked for, then one line for each finished part
        elements/part-00000.parquet, residuals/..., points/...
    DIR/                  the same folder, renamed at the end; last its journal goes

The files of a part are complete and on the disk before its line in the journal is, so
that a run that was stopped at any moment goes on with the first part that has no line,
and ends in the same bytes. Every line tells its own SHA-256 and those of its files:
what has been damaged is made anew.
"""

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ..reports.files import json_text
from ..tables import whole
from ..tables.fields import TableError
from .stream import CONVERTED, NAMED, Part, Work, Worker, file_digest, part_file

JOURNAL = "journal.jsonl"

BYTES = "bytes"
"""The size of the table that is read."""

DIGESTS = "sha256"
"""The SHA-256 of the files that are read: part of a request, by which another content
is known, not of a summary."""

CONVERSION = "converted_sha256"
"""The SHA-256 of the Parquet table that another file was converted into: likewise."""

SUMMARY = "summary.json"

DRAFTS = tuple(map(whole.draft_name, (JOURNAL, CONVERTED, SUMMARY)))
"""What a run that was stopped may have begun to write in its folder; the drafts of parts
are in folders of their tables."""


class Job:
    """A table of any size, what is to be done with it, and how far it is."""

    def __init__(
        self,
        work: Work,
        parts: list[Part],
        target: Path,
        request: dict[str, Any],
        inputs: whole.Inputs,
    ):
        self.work, self.parts, self.target, self.request = work, parts, target, request
        self._inputs = inputs
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
    def has_journal(self) -> bool:
        """Whether there is a journal that says what was asked for."""
        return _has_lines(self.work.folder / JOURNAL)

    def move(self, folder: Path) -> None:
        """The folder takes another name, and the place of a run that was stopped
        there."""
        work = self.work
        whole.swap(work.folder, folder)
        converted = CONVERSION in self.request
        source = folder / work.source.name if converted else work.source
        self.work = replace(work, folder=folder, source=source)

    def begin(self) -> None:
        """A new journal. Raises TableError where the folder cannot be written."""
        with whole.telling(self.work.folder, "a folder that can be written"):
            self.work.folder.mkdir(parents=True, exist_ok=True)
            self._rewrite()

    def go_on(self) -> None:
        """What an earlier run finished. Raises TableError where it was asked for
        something else."""
        path = self.work.folder / JOURNAL
        before, *entries = _read(path)
        for key in sorted(set(before) | set(self.request)):
            one, other = before.get(key), self.request.get(key)
            if one != other:
                found = f"{key} = {one!r} in the run to be resumed, {other!r} now"
                if key in (BYTES, DIGESTS):
                    found = "another content of the files that are read than now"
                raise TableError(
                    path,
                    line=1,
                    found=found,
                    expected="the same table and options, or a new --out",
                )
        finished = {e["part"]: e for e in entries if self._stands(e)}
        self.entries = list(finished.values())
        self._rewrite()  # without lines that cannot be believed

    def add(self, entry: dict[str, Any]) -> None:
        """A part is written: its line in the journal. Raises TableError where the input
        is not any more what it was."""
        self._inputs.check()
        _append(self.work.folder / JOURNAL, entry)
        self.entries.append(entry)

    def end(self) -> dict[str, Any]:
        """The summary, when every part is finished; the folder takes its name. Raises
        TableError where the input or a part is not any more what it was."""
        self._inputs.check()
        self._verify()
        told = self._totals()
        own = DIGESTS, CONVERSION
        asked = {key: value for key, value in self.request.items() if key not in own}
        sigma0 = self.work.units.sigma0 or None
        units = asdict(self.work.units) | {"sigma0": sigma0, "angles": "deg"}
        with whole.draft_of(self.work.folder / SUMMARY) as draft:
            draft.write_text(
                json_text({**asked, **told, "units": units}), encoding="utf-8"
            )
        self._rename()
        return told

    def _totals(self) -> dict[str, Any]:
        """The numbers of pairs, rows, results and outcomes in all parts."""
        self.entries.sort(key=lambda entry: entry["part"])
        told: dict[str, Any] = {
            "pairs": self.done,
            "rows": sum(entry["rows"] for entry in self.entries),
        }
        for key in ("results", "outcomes"):
            total: Counter = Counter()
            for entry in self.entries:
                total.update(entry[key])
            told |= {key: dict(sorted(total.items()))} if total else {}
        causes = [each for entry in self.entries for each in entry["causes"].items()]
        doubles = [name for entry in self.entries for name in entry["doubles"]]
        return told | {
            "pairs_wrong_as_a_whole": sum(entry["wrong"] for entry in self.entries),
            "causes": dict(causes[:NAMED]),
            "pairs_with_two_points_of_one_name": doubles,
        }

    def _verify(self) -> None:
        """Raises TableError for a part that the disk has not kept."""
        for entry in self.entries:
            if not self._stands(entry):
                raise TableError(
                    self.work.folder,
                    found=f"part {entry['part']} with another content than was written",
                    expected="a disk that keeps it; --resume makes the part anew",
                )

    def _rename(self) -> None:
        """The folder takes its name, and the place of one of that name."""
        folder, target = self.work.folder, self.target
        for stray in (*folder.rglob("*.partial"), folder / CONVERTED):
            stray.unlink(missing_ok=True)
        whole.swap(folder, target)
        # last: a run that is stopped before can still be resumed
        (target / JOURNAL).unlink()

    def _rewrite(self) -> None:
        """The journal of what is known, whole or as it was."""
        with whole.draft_of(self.work.folder / JOURNAL) as draft:
            _append(draft, {"request": self.request}, *self.entries)

    def _stands(self, entry: dict[str, Any]) -> bool:
        """Whether the files of a finished part are what they were."""
        for name, digest in entry["files"].items():
            path = part_file(self.work.folder, name, entry["part"])
            if not path.exists() or file_digest(path) != digest:
                return False
        return True


def _append(path: Path, *entries: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.writelines(_line(entry) for entry in entries)
        file.flush()
        os.fsync(file.fileno())


DIGEST = re.compile(rb'(.*), "sha256": "([0-9a-f]{64})"}', re.DOTALL)
"""The digest at the end of a line, of all that stands before it."""


def _line(entry: dict[str, Any]) -> str:
    """An entry as a line that tells its own digest."""
    text = json.dumps(entry)[:-1]
    return f'{text}, "sha256": "{hashlib.sha256(text.encode()).hexdigest()}"}}\n'


def _entry(line: bytes) -> dict[str, Any] | None:
    """The entry of a line, None where it is cut off or another than was written."""
    found = DIGEST.fullmatch(line)
    if found is None or hashlib.sha256(found[1]).hexdigest() != found[2].decode():
        return None
    return json.loads(found[1] + b"}")


def _has_lines(path: Path) -> bool:
    """Whether a journal is there, and more than a first line that was cut off."""
    return path.exists() and b"\n" in path.read_bytes()


def _read(path: Path) -> Iterator[dict[str, Any]]:
    """The request, and then the entries that can be believed. Raises TableError where
    the request cannot."""
    with whole.telling(path, "the --out of a run that was stopped, to resume it"):
        lines = path.read_bytes().split(b"\n")
    first, *others = map(_entry, lines)
    if first is None or "request" not in first:
        raise TableError(
            path,
            line=1,
            found="another line than was written there",
            expected="the journal of a run that was stopped; --force begins anew",
        )
    yield first["request"]
    yield from (entry for entry in others if entry is not None)


def previous_request(folder: Path) -> dict[str, Any]:
    """What the run in this folder was asked for; nothing where it has no journal."""
    path = folder / JOURNAL
    return next(_read(path)) if _has_lines(path) else {}


def here(job: Job, told: Callable[[int], None]) -> Iterable[dict[str, Any]]:
    """The lines of all parts that are left, worked on in this process."""
    worker, done = Worker(job.work), job.done
    for part in job.left:
        entry = worker(part, lambda number, before=done: told(before + number))
        done += entry["pairs"]
        yield entry
