"""One call of `jaxro orient` or `jaxro clean` with Parquet tables, from its options to
the end of the work."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from .. import __version__
from ..batches.padding import plan_for
from ..batches.ragged import Ragged, concatenate
from ..batches.table_noise import PAIRS
from ..rejection import AbstractProcedure
from ..reports.columns import TABLES
from ..reports.pair import show_causes, table as terminal_table
from ..reports.terminal import Spent, consoles, progress, say_what, stopwatch
from ..reports.text import escape
from ..tables import parquet, whole
from ..tables.cameras import Cameras
from ..tables.conversion import convert
from ..tables.fields import TableError
from ..tables.measured import to_ragged
from . import other_programs, sigma as deviation
from .journal import (
    BYTES,
    CONVERSION,
    DIGESTS,
    DRAFTS,
    JOURNAL,
    SUMMARY,
    Job,
    here,
    previous_request,
)
from .request import (
    MEASURED,
    SYSTEMS,
    Options,
    check_numbers,
    read_cameras,
    units_of,
)
from .solve import Task, is_good
from .stream import CONVERTED, PART_ROWS, Work, file_digest, parts
from .tolerances import check_sigma, tolerances

REPLACED = (*TABLES, "cleaned", SUMMARY, JOURNAL, whole.REPLACED)
"""What may be in a folder whose place the results take."""

PLACES = 8
"""Runs of pairs, from the begin to the end of a table, that tell its noise."""

WORKED_ON = (*REPLACED, CONVERTED, *DRAFTS)
"""What may be in the folder of a run that was stopped."""


@dataclass(frozen=True)
class Large:
    """What the user asked for besides `Options`."""

    tables: str | None = None
    resume: bool = False
    part_rows: int = PART_ROWS
    engine: Callable[[Job, Callable[[int], None]], Iterable[dict[str, Any]]] = here


def run(
    options: Options,
    large: Large,
    procedure: tuple[str, AbstractProcedure] | None = None,
) -> bool:
    """Plan, work, tell. True if every pair is cleaned and usable. Raises TableError;
    finished parts can be resumed."""
    _check_whole(options)
    spent = stopwatch()
    console, errors = consoles()
    told = "Cleaning" if procedure else "Orienting"
    with whole.claim(options.out, check_folder_name, options.force):
        with say_what(f"Reading {options.file} ..."):
            job = prepare(options, large, procedure)
        with progress(errors, told, job.pairs) as tell:
            summary = _work(job, large, tell, options.force)
    show(console, job, summary, spent())
    return good(summary)


def _check_whole(options: Options) -> None:
    """Raises TableError for what is made of a whole table at once."""
    documents = options.documents
    for name, asked in (
        ("--report", documents.report is not None),
        ("--plots", documents.plots is not None),
        ("--json", documents.json),
        ("--g2o", options.g2o is not None),
    ):
        if asked:
            raise TableError(
                name,
                found="it with Parquet results",
                expected="it without --parquet, --resume, --tables and --engine: all "
                "pairs are looked at together then; DIR/elements holds the results of "
                "any number",
            )


def check_folder_name(folder: Path, force: bool) -> None:
    """Raises TableError for a name that no folder can have."""
    whole.check_name(folder, "a name for the folder of results")


def _work(
    job: Job, large: Large, tell: Callable[[int], None], force: bool
) -> dict[str, Any]:
    """All parts that are left, and the summary. Raises TableError."""
    try:
        tell(job.done)
        for entry in large.engine(job, tell):
            job.add(entry)
        # what may have appeared there meanwhile
        _check_place(job.target, force)
        return job.end()
    except parquet.DAMAGED as error:
        raise _refusal(
            job.work.file, job.work.folder, error, "; what is finished --resume keeps"
        ) from None
    except KeyboardInterrupt:
        _, errors = consoles()
        errors.print(
            f"{len(job.entries)} of {len(job.parts)} parts are finished; --resume goes "
            "on",
            markup=False,
        )
        raise


def good(summary: dict[str, Any]) -> bool:
    """Whether every pair is cleaned, where that was asked for, and usable."""
    return is_good(summary["results"], summary.get("outcomes"))


def prepare(
    options: Options, large: Large, procedure: tuple[str, AbstractProcedure] | None
) -> Job:
    """The job, its journal begun or read. Raises TableError, and then leaves nothing
    that was not there before."""
    if options.file is None or options.out is None:
        missing = "FILE" if options.file is None else "--out"
        raise TableError(
            missing,
            found="nothing",
            expected="a table and --out DIR where results are Parquet tables",
        )
    chosen = _tables(large.tables)
    out = options.out.resolve()
    folder = out.with_name(f"{out.name}.unfinished")
    whole.settle(folder)
    if large.resume and not folder.exists() and (out / JOURNAL).exists():
        os.replace(out, folder)  # stopped when only its journal was left to be removed
    _check(options, out, folder, large.resume)
    # a run that was stopped stays until the table and all options are known to be good
    place = folder if large.resume else whole.hidden(folder)
    try:
        job = _plan(options, large, procedure, chosen, place)
        job.go_on() if large.resume and job.has_journal else job.begin()
        if not large.resume:
            job.move(folder)
    except BaseException as error:
        if not large.resume:
            whole.settle(folder)
        if isinstance(error, parquet.DAMAGED):
            raise _refusal(options.file, folder, error) from None
        raise
    return job


def _refusal(
    file: Path, folder: Path, error: BaseException, more: str = ""
) -> TableError:
    """What the disk or a damaged table said."""
    found = getattr(error, "strerror", None) or str(error).splitlines()[0]
    expected = (
        f"a table that can be read and a folder {folder} that can be written{more}"
    )
    return TableError(file, found=found, expected=expected)


def _tables(named: str | None) -> tuple[str, ...]:
    """The tables by their names on the command line. Raises TableError."""
    chosen = tuple(map(str.strip, (named or "elements,residuals,points").split(",")))
    for name in chosen:
        if name not in TABLES:
            expected = f"some of {','.join(TABLES)}"
            raise TableError("--tables", found=repr(name), expected=expected)
    return chosen


def _plan(
    options: Options,
    large: Large,
    procedure: tuple[str, AbstractProcedure] | None,
    chosen: tuple[str, ...],
    folder: Path,
) -> Job:
    """The job that is asked for; what is no Parquet table is converted first."""
    file, out = options.file, options.out
    assert file is not None and out is not None
    inputs = whole.Inputs(file, options.camera)
    source, digest, of_others, known = file, None, None, None
    if other_programs.is_asked(options):
        options, of_others, known = other_programs.read(options)
    if not whole.is_parquet(source):
        source = folder / CONVERTED
        before = previous_request(folder).get(CONVERSION) if large.resume else None
        digest = file_digest(source) if before and source.exists() else None
        if digest is None or digest != before:
            folder.mkdir(parents=True, exist_ok=True)
            if of_others is None:
                convert(file, source)
            else:
                with whole.draft_of(source) as draft:
                    parquet.write(parquet.to_arrow(of_others), draft)
            digest = file_digest(source)
    relative = of_others is not None
    table = parquet.Source(source, file, relative)
    system = SYSTEMS[options.elements or "relative"]
    check_numbers(options, table.has_sigma, str(file), system)
    sigma_known = table.has_sigma or options.sigma is not None
    if procedure is not None:
        check_sigma(*procedure, sigma_known)
    scan = table.scan()
    cameras = known or read_cameras(options, MEASURED)
    cameras.of_all(
        scan.names,
        str(table.path),
        photos=scan.photos,
        one_sigma=sigma_known and not table.has_covariances,
        place=lambda number: table.place(int(scan.begins[number])),
    )
    noise = None
    if options.sigma == deviation.AUTO:
        before = (
            deviation.from_entry(previous_request(folder)) if large.resume else None
        )
        noise = before or deviation.from_residuals(_sample(table, scan, cameras))
    sigma = deviation.parse(options.sigma) if noise is None else noise.sigma
    pieces = parts(scan.begins, large.part_rows)
    wanted = {"elements", *chosen} | ({"residuals"} if procedure else set())
    task = Task(
        system=system,
        tables=tuple(name for name in TABLES if name in wanted),
        sigma_known=sigma_known,
        base=options.base,
        residual=options.residual,
        procedure=procedure[1] if procedure else None,
    )
    asked = _request(replace(options, sigma=sigma), task.tables, procedure)
    single = len(scan.names) == 1
    work = Work(
        source=source.absolute(),
        file=file,
        folder=folder,
        plan=None if single else plan_for(scan.lengths, len(pieces)),
        cameras=cameras,
        sigma=sigma,
        task=task,
        units=units_of(options, table.has_sigma, system),
        relative=relative,
    )
    asked |= deviation.entry(noise)
    if digest is not None:
        asked[CONVERSION] = digest
    return Job(work, pieces, out.resolve(), asked, inputs)


def _sample(table: parquet.Source, scan: parquet.Scan, cameras: Cameras) -> Ragged:
    """The pairs whose residuals tell sigma, which is their unit: all of a small table,
    else PLACES runs of them, evenly spread."""
    count = len(scan.begins) - 1
    run, places = (count, 1) if count <= PAIRS else (PAIRS // PLACES, PLACES)
    runs = []
    for first in np.linspace(0, count - run, places).astype(int):
        part = table.read(scan.begins[first : first + run + 1])
        both = cameras.of_all(part.names, part.file, photos=part.photos)
        runs.append(to_ragged(part, both, 1.0))
    return concatenate(runs)


def _check(options: Options, out: Path, folder: Path, resume: bool) -> None:
    """Raises TableError unless the work may begin, or go on."""
    read = [
        file.resolve() for file in (options.file, options.camera) if file is not None
    ]
    _check_place(out, options.force, read)
    _check_place(folder, True, read, WORKED_ON)
    if resume and not folder.exists():
        raise TableError(
            folder,
            found="no such folder",
            expected="the --out of a run that was stopped, to resume it",
        )
    if folder.exists() and not resume and not options.force:
        expected = "--resume to go on, or --force to begin anew"
        raise TableError(folder, found="a run that was stopped", expected=expected)


def _check_place(
    folder: Path, force: bool, read: Sequence[Path] = (), ours: Sequence[str] = REPLACED
) -> None:
    """Raises TableError unless results may take the place of the whole folder, in which
    nothing else is or is read."""
    whole.check_target(folder, force)
    others = (
        sorted(entry.name for entry in folder.iterdir() if entry.name not in ours)
        if folder.exists()
        else []
    )
    inside = [file for file in read if folder in file.parents]
    if others or inside:
        found = (
            f"{', '.join(others[:5])}, no tables of an earlier run"
            if others
            else f"{inside[0]}, to be read"
        )
        raise TableError(
            folder,
            found=found,
            expected="another --out: Parquet results take the place of the whole folder",
        )


def _request(
    options: Options,
    tables: tuple[str, ...],
    procedure: tuple[str, AbstractProcedure] | None,
) -> dict:
    """What is asked for, as the journal and the summary keep it; another request does
    not resume a run."""
    assert options.file is not None
    asked: dict[str, Any] = {
        "program": f"jaxro {__version__}",
        "file": str(options.file),
    }
    table, cameras = _files(options.file), _files(options.camera)
    asked |= {
        BYTES: sum(file.stat().st_size for file in table),
        DIGESTS: [file_digest(file) for file in (*table, *cameras)],
    }
    asked["tables"] = list(tables)
    named = {
        "camera",
        "focal",
        "principal_point",
        "pixel_size",
        "y_down",
        "sigma",
        "elements",
        "base",
        "residual",
    }
    asked |= {name: _plain(getattr(options, name)) for name in sorted(named | {"unit"})}
    asked["elements"] = options.elements or "relative"
    if procedure is not None:
        asked |= {"procedure": procedure[0], "tolerances": tolerances(procedure[1])}
    return asked


def _files(path: Path | None) -> list[Path]:
    """A file that is read, or those of a folder."""
    if path is None or not path.is_dir():
        return [] if path is None else [path]
    return sorted(file for file in path.iterdir() if file.is_file())


def _plain(value: Any) -> Any:
    return (
        str(value)
        if isinstance(value, Path)
        else list(value)
        if isinstance(value, tuple)
        else value
    )


def show(console: Console, job: Job, summary: dict[str, Any], spent: Spent) -> None:
    """What is wrong with pairs as a whole, how the pairs ended, and where the tables
    are."""
    show_causes(console, summary["causes"], summary["pairs_wrong_as_a_whole"])
    for kind, title in (("outcomes", "cleaning"), ("results", "orientation")):
        if kind in summary:
            rows = terminal_table(title, "pairs", "%")
            for name, number in summary[kind].items():
                rows.add_row(
                    name, f"{number:,}", f"{100 * number / summary['pairs']:.2f}"
                )
            console.print(rows)
    doubles = summary["pairs_with_two_points_of_one_name"]
    if doubles:
        named = ", ".join(doubles[:5]) + (", ..." if len(doubles) > 5 else "")
        console.print(
            f"[yellow]Mind:[/yellow] two points of one name in pairs {escape(named)}"
        )
    noise = deviation.from_entry(job.request)
    if noise is not None:
        console.print(
            deviation.sentence(noise, "in the unit of the table"), markup=False
        )
    pairs = "1 pair" if summary["pairs"] == 1 else f"{summary['pairs']:,} pairs"
    rate = f"{pairs}, {summary['rows']:,} points in {spent}"
    tables = ", ".join(
        name
        for name in (*job.work.task.tables, "cleaned")
        if (job.target / name).exists()
    )
    console.print(
        f"{rate}. Written to {job.target}: {tables}, summary.json", markup=False
    )
