"""One call of `jaxro orient` with CSV results, from its options to its reports, and what
`jaxro clean` shares with it: a whole table at once."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from .. import __version__
from ..batches.padding import plan_for
from ..batches.ragged import Ragged
from ..batches.table_noise import TableNoise
from ..rejection import AbstractProcedure
from ..reports import files, pair as report, reliability
from ..reports.columns import TABLES, Units
from ..reports.model import Results, find_patterns
from ..reports.terminal import consoles, progress, say_what
from ..reports.verdicts import Verdicts
from ..tables import csv as tables, whole
from ..tables.measured import CameraPairs, Table, to_ragged
from . import sigma as deviation
from .request import (
    MEASURED,
    SYSTEMS,
    Example,
    Options,
    check_numbers,
    read_cameras,
    units_of,
)
from .solve import Task, Told, make_results, make_verdicts, solve


@dataclass(frozen=True)
class Job:
    """A table that is worked on at once, read and checked."""

    options: Options
    table: Table
    cameras: CameraPairs
    pairs: Ragged
    task: Task
    units: Units
    noise: TableNoise | None = None

    @property
    def is_single(self) -> bool:
        """Whether the table has one pair only."""
        return len(self.table.names) == 1

    @property
    def system_name(self) -> str:
        """The system by its name on the command line."""
        return next(name for name, kind in SYSTEMS.items() if kind is self.task.system)

    def summary(self, results: Results) -> dict[str, Any]:
        """What summary.json says of all pairs together."""
        usable = int(results.usable.sum())
        level = {"confidence": self.options.confidence}
        return {
            "program": f"jaxro {__version__}",
            "file": self.table.file,
            "elements": self.system_name,
            "residual": self.options.residual,
            "base": self.options.base,
            "sigma": self.options.sigma,
            **deviation.entry(self.noise),
            **({} if self.options.confidence is None else level),
            "usable": usable,
            "failed": len(results) - usable,
            "warnings": list(self.table.warnings),
        }


def prepare(
    options: Options,
    otherwise: Example = MEASURED,
    procedure: AbstractProcedure | None = None,
) -> Job:
    """Everything read and checked; `otherwise`: the table where no file is named.
    Raises TableError."""
    system = SYSTEMS[options.elements or ("relative" if options.file else "dependent")]
    if options.file is None:
        table = tables.parse(otherwise.table, otherwise.name, otherwise.name)
    else:
        with say_what(f"Reading {options.file} ..."):
            table = tables.read(options.file, options.semicolons)
    known = read_cameras(options, otherwise)
    check_numbers(options, table.has_sigma, table.file, system)
    sigma_known = table.has_sigma or options.sigma is not None
    cameras = known.of_all(
        table.names,
        table.file,
        photos=table.photos,
        one_sigma=sigma_known,
        place=table.first_line,
    )
    noise = None
    if options.sigma == deviation.AUTO:
        noise = deviation.from_residuals(to_ragged(table, cameras, 1.0))
    sigma = deviation.parse(options.sigma) if noise is None else noise.sigma
    task = Task(
        system=system,
        tables=_tables(table, options.out, sigma_known, procedure is not None),
        sigma_known=sigma_known,
        base=options.base,
        residual=options.residual,
        procedure=procedure,
        rounds=options.out is not None,
    )
    return Job(
        options=replace(options, sigma=sigma),
        table=table,
        cameras=cameras,
        pairs=to_ragged(table, cameras, sigma),
        task=task,
        units=units_of(options, table.has_sigma, system),
        noise=noise,
    )


def _tables(
    table: Table, out: Path | None, sigma_known: bool, cleaned: bool
) -> tuple[str, ...]:
    """The tables that files and the terminal need."""
    if out is not None:
        return TABLES
    if len(table.names) > 1:
        return ("elements", "residuals") if cleaned else ("elements",)
    testable = sigma_known or table.lengths[0] > 6
    return TABLES if testable else TABLES[:-1]


def solve_table(job: Job, told: Told) -> tuple[Results, Verdicts | None]:
    """What is found of every pair; of cleaned ones with the decisions."""
    plan = None if job.is_single else plan_for(job.table.lengths)
    found = solve(job.pairs, job.task, plan, told=told)
    used, verdicts = job.pairs, None
    if found.decided is not None:
        used = used._replace(mask=used.mask & found.decided["kept"])
        verdicts = make_verdicts(job.table, found)
    rigorous = job.options.residual == "rigorous"
    results = make_results(
        job.table,
        job.cameras,
        found,
        job.task,
        job.units,
        confidence=job.options.confidence,
        patterns=find_patterns(used, found.of_pairs) if rigorous else {},
    )
    return results, verdicts


def run(options: Options) -> bool:
    """Read, orient, show, write. True if every pair is usable. Raises TableError, with
    nothing written."""
    console, errors = consoles()
    with writing(options) as write:
        job = prepare(options)
        warn(errors, job)
        with progress(errors, "Orienting", len(job.table.names)) as told:
            results, _ = solve_table(job, told)
        written = ""
        if options.out is not None:
            written = write(files.texts(results, job.summary(results)))
    show_sigma(console, job)
    show(console, job, results)
    console.print(written, end="", markup=False)
    if options.file is None:
        console.print(
            "This was the embedded example. Your own pairs: jaxro orient FILE.csv "
            "--focal F",
            markup=False,
        )
    return bool(results.usable.all())


def warn(errors: Console, job: Job) -> None:
    """What a careful reader of the table should be told."""
    for warning in job.table.warnings:
        errors.print(f"Warning: {warning}", style="yellow", markup=False)


@contextmanager
def writing(options: Options) -> Iterator[Callable[[dict[str, str]], str]]:
    """Within the block --out is written to by this process alone, by the function that
    it gets: the files by name, and where they are as a line. Raises TableError, then
    nothing is written, also where the input is not any more what it was."""
    read = (options.file, options.camera)
    inputs = whole.Inputs(*read)

    def write(texts: dict[str, str]) -> str:
        assert options.out is not None
        inputs.check()
        whole.write(options.out, texts, read)
        return f"Written to {options.out}: {', '.join(texts)}\n"

    with whole.claim(options.out, whole.check_target, options.force):
        yield write


def show_sigma(console: Console, job: Job) -> None:
    """The standard deviation that was taken, where it was not given."""
    if job.noise is not None:
        each = [job.cameras] if isinstance(job.cameras, tuple) else job.cameras
        plain = all(camera.pixel_size == 1 for both in each for camera in both)
        unit = job.units.photo if plain else "in the unit of the table"
        console.print(deviation.sentence(job.noise, unit), markup=False)


def show(console: Console, job: Job, results: Results) -> None:
    """The orientations on the terminal."""
    subtitle = f"{job.system_name} elements, {job.options.residual} residuals"
    report.show(console, results, subtitle)
    reliability.show(console, results)
