"""What happens to a command that works: a terminal that closes, another process in the
same folder, input that changes, a fork, damaged parts."""

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import command_line
import pytest
import typer
from filelock import FileLock

from jaxro.commands import large, orient
from jaxro.commands.ending import NOT_SHOWN, end
from jaxro.commands.journal import JOURNAL
from jaxro.commands.request import Options
from jaxro.commands.stream import CONVERTED
from jaxro.reports.columns import TABLES
from jaxro.reports.terminal import (
    Spent,
    steady_streams,
    stopwatch,
)
from jaxro.tables import whole
from jaxro.tables.examples import pair as pair_example
from jaxro.tables.fields import TableError
from jaxro.xla import notices

FOCAL = ["--focal", str(pair_example.FOCAL)]
COMMAND = [sys.executable, "-m", "jaxro"]
FILES = {f"{name}.csv" for name in TABLES} | {"summary.json"}


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "in" / "pair.csv"
    path.parent.mkdir()
    path.write_text(pair_example.TABLE)
    return path


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Of processes that share their programs, so that they are compiled once. What JAX
    keeps itself cannot be kept a second time."""
    kept = str(tmp_path_factory.mktemp("kept"))
    return os.environ | {"JAXRO_CACHE": kept, "JAX_COMPILATION_CACHE_DIR": ""}


def run(*arguments):
    return command_line.run("orient", *arguments)


def names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}


def pipe_without_a_reader():
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


@pytest.mark.parametrize(
    ("stream", "code"),
    [
        (lambda: os.fdopen(os.open("/dev/full", os.O_WRONLY), "w"), NOT_SHOWN),
        (pipe_without_a_reader, 0),
        (lambda: None, 0),
    ],
    ids=["full disk", "pipe without a reader", "none"],
)
def test_the_exit_code_where_standard_output_is_refused(
    stream, code, monkeypatch, capfd
):
    """Who reads may stop at any time, and there may be nobody; but a report that is
    lost on a full disk is told."""
    done = []

    def work():
        print("a report")
        done.append("all of it")
        return True

    refused = stream()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", refused)
        with pytest.raises(typer.Exit) as ended:
            end(work)
    with suppress(OSError, AttributeError):
        refused.close()
    assert ended.value.exit_code == code and done
    assert ("files of --out are written" in capfd.readouterr().err) == bool(code)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stream", "code"),
    [
        ("> /dev/full", NOT_SHOWN),
        *(
            pytest.param(stream, 0, marks=pytest.mark.slow)
            for stream in ("| true", ">&-", ">&- 2>&-")
        ),
    ],
)
def test_a_broken_standard_output_costs_no_results(
    stream, code, table, tmp_path, environment
):
    out = tmp_path / "out"
    line = f'"{sys.executable}" -m jaxro orient {table} --focal {pair_example.FOCAL}'
    # pipefail: the exit code of jaxro, not that of who reads it
    shell = ["bash", "-c", f"set -o pipefail; {line} --out {out} {stream}"]
    done = subprocess.run(shell, env=environment, capture_output=True, text=True)
    assert done.returncode == code
    assert names(out) == FILES
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    if code:
        assert "files of --out are written" in done.stderr


def test_letters_that_a_terminal_has_not_got_are_written_in_others(
    example, tmp_path, monkeypatch
):
    lines = example("orient").stdout.splitlines()
    report = "\n".join(line for line in lines if not set("─━") & set(line))
    assert "± sd" in report
    with (tmp_path / "shown").open("w", encoding="ascii") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        with steady_streams() as flush:
            print(report)
            assert flush() is None
        monkeypatch.undo()
    shown = (tmp_path / "shown").read_text()
    assert "+- sd" in shown and "?" not in shown


def test_control_characters_of_names_are_not_shown(tmp_path):
    path = tmp_path / "names.csv"
    lines = pair_example.TABLE.splitlines()
    column = lines[0].split(",").index("point")
    fields = lines[1].split(",")
    fields[column] = "evil\x1b]0;title\x07\u202ename"
    path.write_text("\n".join([lines[0], ",".join(fields), *lines[2:]]))
    done = run(path, *FOCAL)
    assert done.exit_code == 0
    assert "evil" in done.output
    assert not set(done.output) & {"\x1b", "\x07", "\u202e"}
    path.write_text(f"\x1b[31m{'x' * 100_000}\npoint\n")
    done = run(path, *FOCAL)
    assert done.exit_code == 2 and "\x1b" not in done.output
    assert len(done.output) < 1000


def test_two_processes_do_not_write_into_one_folder(table, tmp_path):
    """The second is refused at once, and nothing of it is left."""
    out = tmp_path / "new" / "out"
    out.parent.mkdir()
    with FileLock(out.parent / ".out.lock"):
        for more in ([], ["--parquet"]):
            found = run(table, *FOCAL, "--out", out, *more)
            assert found.exit_code == 2
            assert "another process that writes there" in found.output
    assert not out.exists()
    os.remove(out.parent / ".out.lock")
    stale = out.parent / ".out.123.partial"
    stale.mkdir()
    (stale / "elements.csv").write_text("begun by a process that was killed")
    neighbour = out.parent / ".out.b.123.partial"
    neighbour.mkdir()
    assert run(table, *FOCAL, "--out", out).exit_code == 0
    assert names(out) == FILES
    assert names(out.parent) == {"out", neighbour.name}


@pytest.mark.slow
def test_two_processes_at_once(table, tmp_path, environment):
    out = tmp_path / "out"
    line = [*COMMAND, "orient", table, *FOCAL, "--out", out]
    quiet = {"env": environment, "stderr": subprocess.DEVNULL}
    both = [subprocess.Popen(line, **quiet) for _ in range(2)]
    assert sorted(process.wait() for process in both) == [0, 2]
    assert names(out) == FILES and names(tmp_path) == {"in", "out"}


def test_of_a_refused_call_no_folder_is_left(table, tmp_path):
    found = run(table, "--focal", "-1", "--out", tmp_path / "a" / "b" / "out")
    assert found.exit_code == 2
    assert names(tmp_path) == {"in"}


@pytest.mark.parametrize("parquet", [False, True])
def test_input_that_changes_meanwhile_is_noticed(parquet, table, tmp_path, monkeypatch):
    if parquet:
        place, name = large.Job, "add"
    else:
        place, name = orient, "solve_table"
    before = getattr(place, name)

    def change(*arguments):
        table.write_text(pair_example.TABLE + "\n")
        return before(*arguments)

    monkeypatch.setattr(place, name, change)
    more = ["--parquet"] if parquet else []
    found = run(table, *FOCAL, "--out", tmp_path / "out", *more)
    assert found.exit_code == 2
    assert "another content than at the beginning" in found.output
    assert not (tmp_path / "out").exists()


def test_damaged_parts_are_made_anew(tmp_path, monkeypatch):
    """Whatever byte of a finished part, of the journal, or of the converted table that
    a part is made anew from, is another one: the results are the same."""
    pytest.importorskip("pyarrow")
    header, *points = pair_example.TABLE.splitlines()
    source = tmp_path / "pairs.csv"
    rows = [f"p{k},{line}" for k in range(4) for line in points]
    source.write_text("\n".join([f"pair,{header}", *rows]))
    options = Options(file=source, focal=pair_example.FOCAL, out=tmp_path / "out")

    def work(resume, out):
        wanted = large.Large(resume=resume, part_rows=len(points), tables="elements")
        return large.run(
            Options(file=source, focal=pair_example.FOCAL, out=out), wanted
        )

    assert work(False, tmp_path / "whole")
    expected = {
        path.name: path.read_bytes() for path in (tmp_path / "whole").rglob("*.*")
    }

    def stop(job):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(large.Job, "end", stop)
        with pytest.raises(KeyboardInterrupt):
            work(False, options.out)
    unfinished = tmp_path / "out.unfinished"
    kept = {
        path: path.read_bytes() for path in unfinished.rglob("*.*") if path.is_file()
    }
    part = unfinished / "elements" / "part-00001.parquet"
    journal = unfinished / JOURNAL
    second_line = kept[journal].index(b"\n") + 20
    size = len(kept[part])
    damages = [{part: at} for at in (0, 5, size // 2, size - 1)]
    damages += [{journal: second_line + 30 * k} for k in range(4)]
    converted = unfinished / CONVERTED
    damages += [{part: 5, converted: len(kept[converted]) // k} for k in (2, 3, 4)]
    for number, places in enumerate(damages):
        for file, content in kept.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        for path, at in places.items():
            content = bytearray(kept[path])
            content[at] ^= 1
            path.write_bytes(content)
        assert work(True, options.out)
        found = {path.name: path.read_bytes() for path in options.out.rglob("*.*")}
        assert found == expected
        os.rename(options.out, tmp_path / f"done{number}")

    unfinished.mkdir(exist_ok=True)
    for content in (
        b"\xff\xfe\n",
        b"[" * 100_000 + b"\n",
        b"{}\n",
        b'{"request": 1}\n',
    ):
        journal.write_bytes(content)
        with pytest.raises(TableError, match="journal of a run that was stopped"):
            work(True, options.out)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("pairs.html", "a table to be read"),
        ("out/points.csv", "another result of this call"),
        ("report.html", "another result of this call"),
    ],
)
def test_a_file_takes_the_place_of_no_input_and_no_other_result(name, told, tmp_path):
    """By force neither, and before anything is written."""
    read = tmp_path / "pairs.html"
    read.write_text("a table")
    targets = [
        (tmp_path / "out", whole.check_target),
        (tmp_path / "report.html", whole.check_file),
        (tmp_path / name, whole.check_file),
    ]
    with pytest.raises(TableError, match=told), whole.claim_all(targets, True, [read]):
        pass
    assert names(tmp_path) == {"pairs.html"} and read.read_text() == "a table"


def test_what_was_read_is_compared_with_what_it_was(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("a")
    inputs = whole.Inputs(file, None)
    inputs.check()
    file.write_text("ab")
    with pytest.raises(TableError, match="another content"):
        inputs.check()
    file.unlink()
    with pytest.raises(TableError, match="another content"):
        inputs.check()


FORKED = """
import os, sys, warnings
warnings.simplefilter("ignore")
import numpy as np
import jaxro
from jaxro.geometry.mock_pairs import mock_pair, standard_layout
pair = mock_pair(standard_layout(8))
print(bool(jaxro.orient(pair).usable), flush=True)
child = os.fork()
if child == 0:
    try:
        jaxro.orient(pair)
    except RuntimeError as error:
        print("forked" in str(error), flush=True)
        os._exit(0)
    os._exit(1)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="only where processes fork")
def test_a_fork_after_the_first_call_is_told(tmp_path):
    line = [sys.executable, "-c", FORKED]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == ["True", "True"], done.stderr


def test_decimal_commas(table, tmp_path):
    spread = tmp_path / "spread.csv"
    header, *points = pair_example.TABLE.strip().splitlines()
    lines = [header.replace(",", ";")]
    lines += [line.replace(",", ";").replace(".", ",") for line in points]
    spread.write_text("\n".join(lines))
    for more in ([], ["--parquet"]):
        outs = [tmp_path / f"{name}{len(more)}" for name in ("comma", "other")]
        assert run(table, *FOCAL, "--out", outs[0], *more).exit_code == 0
        arguments = (spread, *FOCAL, "--out", outs[1], *more)
        assert run(*arguments).exit_code == 0
        if more:
            summaries = [json.loads((out / "summary.json").read_text()) for out in outs]
            assert summaries[0]["results"] == summaries[1]["results"]
        else:
            texts = [(out / "points.csv").read_text() for out in outs]
            assert texts[0].replace("\npair,", "\nspread,") == texts[1]


def test_the_time_for_compiling_is_told_beside_the_work():
    spent = stopwatch()
    with notices.compiling("one program"), notices.compiling("another"):
        time.sleep(0.2)
    time.sleep(0.1)
    found = spent()
    assert 0.2 <= found.compiling < 0.3
    assert 0.1 <= found.work < 0.2
    assert str(Spent(2.04, 0.26)) == "2.0 s, and 0.3 s for compiling"
    assert str(Spent(2.04, 0.04)) == "2.0 s"
