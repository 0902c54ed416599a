"""Tables of any size: the same numbers as one by one, in parts, on a cluster, and after
a run that was killed."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import run

from jaxro.commands import large
from jaxro.commands.journal import JOURNAL, here
from jaxro.commands.request import Options
from jaxro.tables.fields import TableError

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

FOCAL = 100.0
RENAME = os.replace


QUICK = """
from jaxro.xla import settings

def quick():  # compile as the tests do, to end in the same bytes
    settings.COMPILE_FAST.update(settings.COMPILE_FASTEST)

quick()
"""
"""What a process that is compared with this one does first."""


@pytest.fixture(scope="module")
def measured():
    """240 near-vertical pairs of 8 to 12 points with errors of 0.01 mm: columns of a
    table."""
    rng = np.random.default_rng(5)
    columns = {
        name: [] for name in ("pair", "point", "x_left", "y_left", "x_right", "y_right")
    }
    for k in range(240):
        n = int(rng.integers(8, 13))
        ground = np.stack(
            [
                rng.uniform(-20, 80, n),
                rng.uniform(-60, 60, n),
                rng.uniform(-110, -90, n),
            ]
        )
        tilt = rng.uniform(-0.03, 0.03, 3)
        right = ground - np.array([[60.0], [0.0], [0.0]])
        right = (
            right + np.cross(tilt, right.T).T
        )  # a small rotation: what it is does not matter here
        image = [
            -FOCAL * p[:2] / p[2:] + 0.01 * rng.normal(size=(2, n))
            for p in (ground, right)
        ]
        columns["pair"] += [f"p{k:03}"] * n
        columns["point"] += [str(i) for i in range(n)]
        for name, values in zip(list(columns)[2:], (*image[0], *image[1]), strict=True):
            columns[name] += values.tolist()
    return columns


@pytest.fixture(scope="module")
def folder(measured, tmp_path_factory):
    """The same table as table.parquet, in small row groups, and table.csv."""
    folder = tmp_path_factory.mktemp("tables")
    pq.write_table(pa.table(measured), folder / "table.parquet", row_group_size=100)
    with (folder / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows(
            [list(measured), *zip(*measured.values(), strict=True)]
        )
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    """The results of one undisturbed run, in parts of 200 rows."""
    stream(folder / "table.parquet", folder / "whole")
    return folder / "whole"


def options(table, out, **more):
    return Options(file=table, focal=FOCAL, out=out, **more)


def stream(table, out, *, resume=False, engine=here, **more):
    wanted = large.Large(
        resume=resume,
        part_rows=200,
        engine=engine,
        tables="elements,residuals,points,reliability",
    )
    return large.run(options(table, out, **more), wanted)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_every_pair_is_in_one_of_many_parts(whole):
    """What is in them is compared in test_same_figures.py."""
    assert len(list((whole / "elements").iterdir())) >= 12
    assert pq.read_table(whole / "elements").num_rows == 240
    summary = json.loads((whole / "summary.json").read_text())
    assert (summary["pairs"], summary["results"]) == (240, {"successful": 240})


STOPPED = f"""{QUICK}
import sys
from pathlib import Path
from jaxro.commands import large
from jaxro.commands.request import Options

source, out = map(Path, sys.argv[1:])
wanted = large.Large(part_rows=200, tables="elements,residuals,points,reliability")
large.run(Options(file=source, focal={FOCAL}, out=out), wanted)
"""


def stopped(folder: Path, out: Path, parts: int) -> None:
    """A run in a process of its own, killed when its journal has so many parts."""
    process = subprocess.Popen(
        [sys.executable, "-c", STOPPED, str(folder / "table.parquet"), str(out)]
    )
    journal = out.with_name(f"{out.name}.unfinished") / JOURNAL
    until = time.monotonic() + 120
    while not (journal.exists() and journal.read_text().count("\n") > parts):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()


INTERRUPTED = """
import signal, sys
from jaxro.cli import app
# one that runs in the background may ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)
app(["orient", sys.argv[1], "--focal", "100", "--out", sys.argv[2]], prog_name="jaxro")
"""


@pytest.mark.slow
def test_an_interrupt_ends_at_once_and_what_was_done_is_kept(folder):
    """While programs are compiled, too, of which XLA then goes on reading the text."""
    out, unfinished = folder / "interrupted", folder / "interrupted.unfinished"
    leave = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")  # compiles as long as with users
    environment = {
        name: value for name, value in os.environ.items() if name not in leave
    }
    command = [sys.executable, "-c", INTERRUPTED, folder / "table.parquet", out]
    process = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 120
    while not (unfinished / JOURNAL).exists():
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    time.sleep(3)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "0 of 1 parts are finished; --resume goes on" in told and told.endswith(
        "Aborted.\n"
    )
    assert not out.exists() and unfinished.exists()


@pytest.mark.slow
def test_a_killed_run_is_resumed_to_the_same_bytes(folder, measured, whole):
    out = folder / "killed"
    stopped(folder, out, 3)
    unfinished = out.with_name("killed.unfinished")
    assert not out.exists() and unfinished.exists()
    again = run("orient", folder / "table.parquet", "--focal", FOCAL, "--out", out)
    assert again.exit_code == 2 and "--resume" in again.output
    other = run(
        "orient",
        folder / "table.parquet",
        "--focal",
        FOCAL + 1,
        "--out",
        out,
        "--resume",
    )
    assert (
        other.exit_code == 2
        and "focal = 100.0 in the run to be resumed, 101.0 now" in other.output
    )
    # other numbers of the same time; then the same ones of another time
    table = folder / "table.parquet"
    times, before = table.stat(), table.read_bytes()
    other = {**measured, "x_left": measured["x_left"][::-1]}
    pq.write_table(pa.table(other), table, row_group_size=100)
    os.utime(table, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(TableError, match="another content of the files"):
        stream(table, out, resume=True)
    table.write_bytes(before)
    # a line that was cut off, a file that is not whole, and one that nobody knows of
    with (unfinished / JOURNAL).open("a") as file:
        file.write('{"part": 4, "pai')
    (unfinished / "points" / "part-00001.parquet").write_bytes(b"PAR1")
    (unfinished / "points" / "part-00009.partial").write_bytes(b"PAR1")
    before = (unfinished / "elements" / "part-00000.parquet").stat().st_mtime_ns
    assert stream(folder / "table.parquet", out, resume=True)
    assert (
        out / "elements" / "part-00000.parquet"
    ).stat().st_mtime_ns == before  # not done twice
    assert contents(out) == contents(whole)
    assert not unfinished.exists()


def test_the_exit_code_tells_of_pairs_that_are_not_cleaned(folder):
    """As that of CSV tables: a pair that nothing was decided about is no success,
    whatever its orientation."""
    finished = {"results": {"successful": 3, "two_solutions": 1}, "pairs": 4}
    assert large.good(finished) and large.good(finished | {"outcomes": {"finished": 4}})
    assert not large.good(finished | {"outcomes": {"finished": 3, "no_consensus": 1}})
    assert not large.good({"results": {"successful": 3, "diverged": 1}, "pairs": 4})


def test_a_run_that_is_killed_at_its_very_end_is_resumed(folder, whole, monkeypatch):
    """Everything written, but the folder not yet renamed: no part is done again."""
    out = folder / "last"
    with monkeypatch.context() as stop:
        stop.setattr(
            os,
            "replace",
            lambda a, b: (
                (_ for _ in ()).throw(KeyboardInterrupt) if b == out else RENAME(a, b)
            ),
        )
        with pytest.raises(KeyboardInterrupt):
            stream(folder / "table.parquet", out)
    assert not out.exists()
    assert stream(
        folder / "table.parquet",
        out,
        resume=True,
        engine=lambda job, told: [job.left[0]] if job.left else [],
    )
    assert contents(out) == contents(whole)


@pytest.mark.slow
def test_a_run_that_is_killed_before_its_journal_is_gone_is_resumed(
    folder, whole, monkeypatch
):
    """The folder has its name and the journal is still in it, or the journal has not
    got its first line yet."""
    out, remove = folder / "named", Path.unlink

    def killed(path, missing_ok=False):
        if path == out / JOURNAL:
            raise KeyboardInterrupt
        remove(path, missing_ok)

    with monkeypatch.context() as stop:
        stop.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            stream(folder / "table.parquet", out)
    assert (out / JOURNAL).exists()
    nothing_left = lambda job, told: [job.left[0]] if job.left else []
    assert stream(folder / "table.parquet", out, resume=True, engine=nothing_left)
    assert contents(out) == contents(whole)
    torn = folder / "torn.unfinished"
    torn.mkdir()
    (torn / JOURNAL).write_text('{"request": {"prog')
    assert stream(folder / "table.parquet", folder / "torn", resume=True)
    assert contents(folder / "torn") == contents(whole)


def test_force_replaces_results_and_nothing_else(folder, tmp_path):
    """Whatever else is in the folder is not lost, least of all the table."""
    table = tmp_path / "mine" / "table.parquet"
    table.parent.mkdir()
    table.write_bytes((folder / "table.parquet").read_bytes())
    found = run("orient", table, "--focal", FOCAL, "--out", table.parent, "--force")
    assert (
        found.exit_code == 2
        and "table.parquet, no tables of an earlier run" in found.output
    )
    assert list(tmp_path.rglob("*.parquet")) == [table]
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "real")
    (tmp_path / "real").mkdir()
    for _ in range(2):
        assert (
            run("orient", table, "--focal", FOCAL, "--out", link, "--force").exit_code
            == 0
        )
        assert (tmp_path / "real" / "summary.json").exists() and link.is_symlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "mine", "real"]


def test_force_takes_the_place_of_no_folder_but_that_of_a_stopped_run(folder, tmp_path):
    inside = tmp_path / "out.unfinished" / "table.parquet"
    inside.parent.mkdir()
    inside.write_bytes((folder / "table.parquet").read_bytes())
    for table in (inside, folder / "table.parquet"):
        found = run(
            "orient", table, "--focal", FOCAL, "--out", tmp_path / "out", "--force"
        )
        assert (
            found.exit_code == 2
            and "table.parquet, no tables of an earlier run" in found.output
        )
        assert list(tmp_path.rglob("*")) == [inside.parent, inside]


def test_force_removes_nothing_that_only_looks_like_work(folder, tmp_path):
    for name in ("input.parquet", "mine.partial"):
        mine = tmp_path / name / name
        mine.parent.mkdir()
        mine.write_text("mine")
        found = run(
            "orient",
            folder / "table.parquet",
            "--focal",
            FOCAL,
            "--out",
            mine.parent,
            "--force",
        )
        assert (
            found.exit_code == 2
            and f"{name}, no tables" in found.output
            and mine.read_text() == "mine"
        )


def test_a_stopped_run_outlives_a_call_that_cannot_work(folder, whole, tmp_path):
    stopped = tmp_path / "out.unfinished"
    with pytest.raises(KeyboardInterrupt):
        stream(folder / "table.parquet", tmp_path / "out", engine=interrupted)
    before = contents(stopped)
    assert len(before) > 3
    for table, options in (
        ("typo.parquet", []),
        ("table.parquet", ["--camera", tmp_path / "typo.toml"]),
    ):
        found = run(
            "orient",
            folder / table,
            *(options or ["--focal", FOCAL]),
            "--out",
            tmp_path / "out",
            "--force",
        )
        assert (
            found.exit_code == 2
            and "typo" in found.output
            and contents(stopped) == before
        )
    assert list(tmp_path.iterdir()) == [stopped]
    assert stream(folder / "table.parquet", tmp_path / "out", resume=True)
    assert contents(tmp_path / "out") == contents(whole)


@pytest.mark.slow
def test_what_appears_in_the_folder_of_results_while_they_are_made_is_not_lost(
    folder, whole, tmp_path
):
    def disturbed(job, told):
        yield from here(job, told)
        job.target.mkdir()
        (job.target / "mine.txt").write_text("mine")

    with pytest.raises(TableError, match="not empty"):
        stream(folder / "table.parquet", tmp_path / "out", engine=disturbed)
    os.replace(tmp_path / "out" / "mine.txt", tmp_path / "mine.txt")
    assert stream(folder / "table.parquet", tmp_path / "out", resume=True)
    assert contents(tmp_path / "out") == contents(whole)


def interrupted(job, told):
    yield next(iter(here(job, told)))
    raise KeyboardInterrupt


def test_what_judges_by_sigma_is_not_run_without_one(folder):
    found = run(
        "clean",
        folder / "table.parquet",
        "--focal",
        FOCAL,
        "--out",
        folder / "unjudged",
    )
    assert found.exit_code == 2 and "neither --sigma nor a column sigma" in found.output
    assert (
        not (folder / "unjudged").exists()
        and not (folder / "unjudged.unfinished").exists()
    )


def test_cameras_that_do_not_fit_are_told_before_anything_is_done(folder, tmp_path):
    """By the table and the line that the user knows, and nothing is left that had to be
    resumed."""
    (tmp_path / "camera.toml").write_text(
        "[photo.1]\nfocal = 100\n[photo.2]\nfocal = 100\n"
    )
    for table, place in (("table.csv", "line 2"), ("table.parquet", "row 1")):
        out = tmp_path / "out"
        found = run(
            "orient",
            folder / table,
            "--camera",
            tmp_path / "camera.toml",
            "--parquet",
            "--out",
            out,
        )
        assert (
            found.exit_code == 2
            and f"{table}, {place}, column pair: found 'p000'" in found.output
        )
    (tmp_path / "camera.toml").write_text(
        "[left]\nfocal = 100\n[right]\nfocal = 100\npixel_size = 2\n"
    )
    options = ("--camera", tmp_path / "camera.toml", "--sigma", 0.01)
    found = run("orient", folder / "table.parquet", *options, "--out", tmp_path / "out")
    assert (
        found.exit_code == 2
        and "pixel sizes 1.0 (left) and 2.0 (right)" in found.output
    )
    assert [path.name for path in tmp_path.iterdir()] == ["camera.toml"]


def test_a_table_without_pairs_has_the_name_of_its_file(folder, measured):
    rows = measured["pair"].count("p000")
    with (folder / "alone.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(list(measured)[1:])
        writer.writerows(
            list(zip(*measured.values(), strict=True))[k][1:] for k in range(rows)
        )
        file.write("   \n")
    found = run(
        "orient",
        folder / "alone.csv",
        "--focal",
        FOCAL,
        "--parquet",
        "--out",
        folder / "alone",
    )
    assert found.exit_code == 0, found.output
    assert pq.read_table(folder / "alone" / "elements").column("pair").to_pylist() == [
        "alone"
    ]


def test_names_are_those_of_csv_tables(folder, measured):
    """Blanks around a name do not make it another one."""
    spaced = dict(
        measured,
        pair=[f"{name} " if i % 2 else name for i, name in enumerate(measured["pair"])],
    )
    with (folder / "spaced.csv").open("w", newline="") as file:
        csv.writer(file).writerows([list(spaced), *zip(*spaced.values(), strict=True)])
    assert (
        run(
            "orient",
            folder / "spaced.csv",
            "--focal",
            FOCAL,
            "--parquet",
            "--out",
            folder / "spaced",
        ).exit_code
        == 0
    )
    assert pq.read_table(folder / "spaced" / "elements").column(
        "pair"
    ).to_pylist() == sorted({*measured["pair"]})


def test_a_pair_with_a_missing_number_harms_no_other(folder, measured, whole):
    holes = dict(measured, x_left=list(measured["x_left"]))
    holes["x_left"][measured["pair"].index("p007")] = None
    pq.write_table(pa.table(holes), folder / "holes.parquet")
    assert not stream(folder / "holes.parquet", folder / "holes")
    one, other = (
        pq.read_table(place / "elements").to_pylist()
        for place in (whole, folder / "holes")
    )
    assert other[7]["result"] == "non_finite_input" and other[7]["omega_deg"] is None
    assert [a for a in one if a["pair"] != "p007"] == [
        b for b in other if b["pair"] != "p007"
    ]
    points = pq.read_table(
        folder / "holes" / "points", filters=[("pair", "==", "p007")]
    )
    assert points.column("X_bases").null_count == points.num_rows > 0


BAD = {
    "again": (
        lambda t: t | {"pair": [*t["pair"][1:], t["pair"][0]]},
        "pair 'p000' again in row",
    ),
    "missing": (
        lambda t: {k: v for k, v in t.items() if k != "y_left"},
        "column y_left: found no such column",
    ),
    "unknown": (lambda t: t | {"z": t["x_left"]}, "column z: found an unknown column"),
    "type": (
        lambda t: t | {"x_left": [str(x) for x in t["x_left"]]},
        "column x_left: found values of type string",
    ),
    "unnamed": (
        lambda t: t | {"pair": [None, *t["pair"][1:]]},
        "column pair: found nothing in row 1",
    ),
    "nameless": (
        lambda t: t | {"point": [*t["point"][:-1], None]},
        "column point: found nothing in row",
    ),
    "blank": (
        lambda t: t | {"point": [*t["point"][:-1], " "]},
        "column point: found nothing in row",
    ),
    "empty": (
        lambda t: {k: v[:0] for k, v in pa.table(t).to_pydict().items()},
        "found no",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_tables_say_what_is_wrong(folder, measured, name):
    spoil, said = BAD[name]
    path = folder / f"bad_{name}.parquet"
    table = pa.table(measured)
    spoiled = table.slice(0, 0) if name == "empty" else pa.table(spoil(dict(measured)))
    pq.write_table(spoiled, path)
    found = run("orient", path, "--focal", FOCAL, "--out", folder / name)
    assert found.exit_code == 2 and said in found.output and path.name in found.output
    assert not (folder / name).exists() and not (folder / f"{name}.unfinished").exists()


def test_bad_csv_names_the_line(folder, measured):
    text = (folder / "table.csv").read_text().splitlines()
    text[300] = text[300].replace(text[300].split(",")[3], "1O.5")
    (folder / "letter.csv").write_text("\n".join(text))
    found = run(
        "orient",
        folder / "letter.csv",
        "--focal",
        FOCAL,
        "--parquet",
        "--out",
        folder / "letter",
    )
    assert (
        found.exit_code == 2 and "line 301, column y_left: found '1O.5'" in found.output
    )
    assert not (folder / "letter.unfinished").exists()
    (folder / "letter.csv").write_text("point,x_left,y_left,x_right,y_right\n\n")
    found = run(
        "orient",
        folder / "letter.csv",
        "--focal",
        FOCAL,
        "--parquet",
        "--out",
        folder / "letter",
    )
    assert found.exit_code == 2 and "line 2: found no points" in found.output


def test_a_cluster_that_does_not_answer_is_told(folder, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    found = run(
        "orient",
        folder / "table.parquet",
        "--focal",
        FOCAL,
        "--engine",
        "ray",
        "--out",
        tmp_path / "out",
    )
    assert found.exit_code == 2 and "RAY_ADDRESS: found 127.0.0.1:1" in found.output


CLUSTER = f"""{QUICK}
import os, signal, subprocess, sys, pathlib
import ray
from jaxro.commands import cluster
from jaxro.commands import large
from jaxro.commands.request import Options

if __name__ == "__main__":
    ray.init(
        num_cpus=2,
        log_to_driver=False,
        runtime_env={{"worker_process_setup_hook": quick}},
    )

    def engine(job, told):
        for number, entry in enumerate(cluster.on_ray(job, told)):
            if number == 0:  # one of the two dies in the middle of its work
                search = ["pgrep", "-f", "ray::MapWorker"]
                alive = subprocess.run(search, capture_output=True, text=True).stdout.split()
                assert len(alive) == 2, alive
                os.kill(int(alive[0]), signal.SIGKILL)
            yield entry

    source, out = map(pathlib.Path, sys.argv[1:])
    tables = "elements,residuals,points,reliability"
    wanted = large.Large(part_rows=200, tables=tables, engine=engine)
    assert large.run(Options(file=source, focal=100.0, out=out), wanted)
"""


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_ends_in_the_same_bytes(folder, whole):
    pytest.importorskip("ray")
    script = folder / "cluster.py"
    script.write_text(CLUSTER)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [
        sys.executable,
        str(script),
        str(folder / "table.parquet"),
        str(folder / "cluster"),
    ]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert contents(folder / "cluster") == contents(whole)
