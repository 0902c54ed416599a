"""A process that is killed at any call that writes: the next one ends in the same bytes,
and nothing that was there before is lost meanwhile.

No process is killed here. The calls that write are counted, and from one of them on all
of them raise, as if nobody were there any more to make them: nothing is tidied up.
"""

import io
import os
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from jaxro.commands import journal, large, stream
from jaxro.commands.journal import JOURNAL
from jaxro.commands.request import Options
from jaxro.tables import conversion, parquet, whole as places
from jaxro.tables.examples import pair as example
from jaxro.tables.fields import TableError

pytest.importorskip("pyarrow")

PAIRS = 3


class Killed(BaseException):
    """The process is not there any more."""


class Life:
    """Counts the calls that write below a folder, and ends at the one of this
    number."""

    def __init__(self, folder: Path, end: int):
        self.folder, self.end = str(folder), end
        self.calls, self.over = 0, False

    def step(self) -> None:
        """An instant between two things that the disk does."""
        if not self.over:
            self.calls += 1
            self.over = self.calls == self.end
        if self.over:
            raise Killed

    def around(self, call):
        """A call that may end before it has done anything, and after it has."""

        def counted(*arguments, **keywords):
            if not self._counts(arguments, keywords):
                return call(*arguments, **keywords)
            self.step()
            result = call(*arguments, **keywords)
            self.step()
            return result

        return counted

    def _counts(self, arguments, keywords) -> bool:
        """Whether a call concerns the folder; paths of open folders do."""
        paths = [str(a) for a in arguments if isinstance(a, str | Path)]
        return "dir_fd" in keywords or any(p.startswith(self.folder) for p in paths)

    def opened(self, file, mode="r", *arguments, **keywords):
        """`open`, which makes an empty file of what is to be written."""
        if set(mode) <= set("rbt") or not str(file).startswith(self.folder):
            return OPEN(file, mode, *arguments, **keywords)
        self.step()
        stream = OPEN(file, mode, *arguments, **keywords)
        try:
            self.step()
        except Killed:
            stream.close()
            raise
        return Written(stream, self)

    def write_table(self, table, path, **keywords):
        """A table, of which only one half may be there."""
        self.step()
        WRITE_TABLE(table, path, **keywords)
        content = Path(path).read_bytes()
        os.truncate(path, len(content) // 2)
        self.step()
        with OPEN(path, "wb") as file:
            file.write(content)
        self.step()


class Written:
    """An open file, of which only one half may be written."""

    def __init__(self, stream, life: Life):
        self.stream, self.life = stream, life

    def write(self, content):
        half = len(content) // 2
        for part in (content[:half], content[half:]):
            self.stream.write(part)
            self.stream.flush()
            self.life.step()

    def writelines(self, lines):
        for line in lines:
            self.write(line)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stream.close()

    def __getattr__(self, name):
        return getattr(self.stream, name)


OPEN, WRITE_TABLE = io.open, parquet.pq.write_table
CALLS = ("open", "replace", "mkdir", "rmdir", "unlink", "chmod")
"""Calls of the system that change folders."""


@contextmanager
def life_until(end: int, folder: Path):
    """Within the block a process lives that is killed at the call of this number."""
    life, locks, lock = Life(folder, end), [], places._lock

    def locked(*arguments):
        locks.append(lock(*arguments))
        return locks[-1]

    with pytest.MonkeyPatch.context() as patch, suppress(Killed):
        patch.setattr(places, "_lock", locked)
        for name in CALLS:
            patch.setattr(os, name, life.around(getattr(os, name)))
        flush = os.fsync
        patch.setattr(os, "fsync", lambda number: (life.step(), flush(number)))
        patch.setattr(io, "open", life.opened)
        patch.setattr(parquet.pq, "write_table", life.write_table)
        for name in ("_convert_quickly", "_convert_carefully"):
            whole = life.around(getattr(conversion, name))
            patch.setattr(conversion, name, whole)
        yield life
    for held in locks:  # the system takes them from a process that ends
        held.release(force=True)


def lives(folder: Path, prepare, call, every: int = 1):
    """`call` in a life that ends at every call that writes (or every third, ...), one
    after the other, each from what `prepare` makes; within the loop it has just
    ended."""
    end = 0
    while True:
        end += every
        prepare()
        with life_until(end, folder) as life:
            call()
        if not life.over:
            assert end > 10
            return
        yield end


def contents(folder: Path) -> dict[str, bytes]:
    """All files, by their names."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def visible(folder: Path) -> dict[str, bytes]:
    """The same without what is about to be removed."""
    return {n: c for n, c in contents(folder).items() if places.REPLACED not in n}


def clear(folder: Path) -> None:
    """Empty a folder."""
    for path in sorted(folder.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()


OLD, NEW = (
    {f"{k}.csv": f"{word} {k}".encode() for k in "abc"} for word in ("old", "new")
)
REPORT = b"a report"


def write(out: Path, files: dict[str, bytes], force: bool) -> None:
    """What a command does with results that it has at once."""
    with places.claim(out, places.check_target, force):
        places.write(out, files)


@pytest.mark.parametrize("before", ["nothing", "an empty folder", "results"])
def test_results_are_those_before_or_those_after(before, tmp_path):
    """Not a file of one beside a file of the other; and none are lost."""
    out = tmp_path / "out"

    def prepare():
        clear(tmp_path)
        if before == "results":
            write(out, OLD, force=False)
        elif before == "an empty folder":
            out.mkdir()

    for _ in lives(tmp_path, prepare, lambda: write(out, NEW, force=True)):
        there = [visible(path.parent) for path in tmp_path.rglob("a.csv")]
        assert before != "results" or OLD in there or NEW in there
        assert visible(out) in ({}, OLD, NEW)
        with suppress(TableError):  # where results are there
            write(out, NEW, force=False)
        assert contents(out) in (OLD, NEW)
        write(out, NEW, force=True)
        assert contents(tmp_path) == {f"out/{n}": c for n, c in NEW.items()}


def test_whatever_else_is_in_the_folder_stays(tmp_path):
    """Then each file is one or the other, and a second call makes all of them new. A
    report in the folder is one of them."""
    out = tmp_path / "out"
    report = out / "report.html"
    targets = [(report, places.check_file), (out, places.check_target)]

    def call():
        with places.claim_all(targets, True):
            places.write(out, NEW)
            places.write_file(report, REPORT)

    def prepare():
        clear(tmp_path)
        write(out, OLD, force=False)
        (out / "mine.txt").write_bytes(b"mine")

    for _ in lives(tmp_path, prepare, call):
        found = contents(out)
        assert found["mine.txt"] == b"mine"
        assert all(found[name] in (OLD[name], NEW[name]) for name in NEW)
        call()
        expected = NEW | {"mine.txt": b"mine", "report.html": REPORT}
        assert contents(tmp_path) == {f"out/{n}": c for n, c in expected.items()}


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Pairs of the example, and those of another measurement."""
    folder = tmp_path_factory.mktemp("tables")
    header, *points = example.TABLE.splitlines()
    for name, some in (("pairs", points), ("others", points[1:])):
        rows = [f"p{k},{line}" for k in range(PAIRS) for line in some]
        (folder / f"{name}.csv").write_text("\n".join([f"pair,{header}", *rows]))
    return folder / "pairs.csv"


@pytest.fixture
def calculated_once(monkeypatch):
    """What is found of pairs is kept, and not shown: the files are the subject."""
    kept, solve = {}, stream.solve

    def once(pairs, *arguments):
        key = pairs.x_left.tobytes()
        if key not in kept:
            kept[key] = solve(pairs, *arguments)
        return kept[key]

    monkeypatch.setattr(stream, "solve", once)
    monkeypatch.setattr(large, "show", lambda *_: None)


def parts(table: Path, out: Path, force: bool = False, resume: bool = False) -> bool:
    """Parquet results, a pair in each part."""
    options = Options(file=table, focal=example.FOCAL, out=out, force=force)
    return large.run(options, large.Large("elements", resume, part_rows=1))


def resumed(table: Path, out: Path) -> None:
    """What a user does: --resume, where there is something to go on with, else anew."""
    unfinished = out.with_name(f"{out.name}.unfinished")
    if unfinished.exists() or (out / JOURNAL).exists():
        assert parts(table, out, resume=True, force=True)
    else:
        assert parts(table, out, force=True)


@pytest.mark.parametrize(
    ("before", "every"),
    [
        ("both", 11),
        *(
            pytest.param(before, 1, marks=pytest.mark.slow)
            for before in ("nothing", "results", "a stopped run", "both")
        ),
    ],
)
@pytest.mark.usefixtures("calculated_once")
def test_a_run_in_parts_ends_in_the_same_bytes(before, every, table, tmp_path):
    out, others = tmp_path / "out", table.with_name("others.csv")
    parts(table, out)
    expected = contents(tmp_path)

    def prepare():
        clear(tmp_path)
        if before in ("results", "both"):
            parts(others, out)
        if before in ("a stopped run", "both"):
            with life_until(60, tmp_path) as life:
                parts(table, out, force=True)
            assert life.over and (tmp_path / "out.unfinished").exists()

    call = lambda: parts(table, out, force=True)
    for end in lives(tmp_path, prepare, call, every):
        resumed(table, out)
        assert contents(tmp_path) == expected, end


@pytest.mark.usefixtures("calculated_once")
@pytest.mark.parametrize("stray", ["summary.partial", "journal.partial"])
def test_a_draft_of_a_run_that_was_stopped_stops_no_other(stray, table, tmp_path):
    unfinished = tmp_path / "out.unfinished"
    unfinished.mkdir()
    (unfinished / stray).touch()
    assert parts(table, tmp_path / "out", resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.usefixtures("calculated_once")
def test_a_part_that_the_disk_has_not_kept_is_told_at_the_end(table, tmp_path):
    def spoiled(job, told):
        for entry in journal.here(job, told):
            yield entry
            part = stream.part_file(job.work.folder, "elements", 0)
            part.write_bytes(part.read_bytes()[:-1] + b"?")

    options = Options(file=table, focal=example.FOCAL, out=tmp_path / "out")
    wanted = large.Large("elements", part_rows=1, engine=spoiled)
    with pytest.raises(TableError, match="part 0 with another content"):
        large.run(options, wanted)
    assert parts(table, options.out, resume=True)
    assert len(contents(options.out)) == PAIRS + 1
