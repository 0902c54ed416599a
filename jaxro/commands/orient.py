"""One call of `jaxro orient` with CSV results, from its options to its reports, and what
`jaxro clean` shares with it: a whole table at once."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from rich.console import Console

from .. import __version__
from ..batches import table_neighbours
from ..batches.padding import plan_for
from ..batches.ragged import Ragged
from ..batches.table_noise import TableNoise
from ..rejection import AbstractProcedure
from ..reports import files, pair as report, reliability
from ..reports.columns import TABLES, Units
from ..reports.html.pairs import Cleaned, page_of_pairs
from ..reports.model import Results, find_intervals, find_patterns, find_rotations
from ..reports.terminal import consoles, progress, say_what, warn
from ..reports.verdicts import Verdicts
from ..tables import csv as tables, whole
from ..tables.cameras import Cameras
from ..tables.fields import TableError
from ..tables.measured import CameraPairs, Table, tell_copies, to_ragged
from . import closures, neighbours, other_programs, sigma as deviation
from .causes import name_causes, tell_causes
from .documents import settings, show_json
from .model_accuracy import add_model_errors
from .request import (
    MEASURED,
    SYSTEMS,
    Example,
    Options,
    check_numbers,
    read_cameras,
    read_table,
    units_of,
)
from .solve import Found, Task, Told, in_use, make_results, make_verdicts, solve


@dataclass(frozen=True)
class Job:
    """A table that is worked on at once, read and checked."""

    options: Options
    table: Table
    cameras: CameraPairs
    pairs: Ragged
    task: Task
    units: Units
    known: Cameras
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
    options, table, known = _read(options, otherwise)
    check_numbers(options, table.has_sigma, table.file, system)
    sigma_known = table.has_sigma or options.sigma is not None
    cameras = known.of_all(
        table.names,
        table.file,
        photos=table.photos,
        one_sigma=sigma_known and not table.has_covariances,
        place=table.first_line,
    )
    noise = None
    if options.sigma == deviation.AUTO:
        noise = deviation.from_residuals(to_ragged(table, cameras, 1.0))
    sigma = deviation.parse(options.sigma) if noise is None else noise.sigma
    task = Task(
        system=system,
        tables=_tables(table, options, sigma_known, procedure is not None),
        sigma_known=sigma_known,
        base=options.base,
        residual=options.residual,
        procedure=procedure,
        rounds=options.out is not None,
    )
    pairs = to_ragged(table, cameras, sigma)
    return Job(
        options=replace(options, sigma=sigma),
        table=tell_copies(table.with_sigma(sigma), pairs),
        cameras=cameras,
        pairs=pairs,
        task=task,
        units=units_of(options, table.has_sigma, system),
        known=known,
        noise=noise,
    )


def _read(options: Options, otherwise: Example) -> tuple[Options, Table, Cameras]:
    """The options with the unit of the file, its pairs and their cameras. Raises
    TableError."""
    if options.file is None:
        table = tables.parse(otherwise.table, otherwise.name, otherwise.name)
        return options, table, read_cameras(options, otherwise)
    with say_what(f"Reading {options.file} ..."):
        if other_programs.is_asked(options):
            return other_programs.read(options)
        table = read_table(options)
    return options, table, read_cameras(options, otherwise)


def _tables(
    table: Table, options: Options, sigma_known: bool, cleaned: bool
) -> tuple[str, ...]:
    """The tables that files and the terminal need."""
    if options.out is not None or options.documents:
        return TABLES
    if len(table.names) > 1:
        return ("elements", "residuals") if cleaned else ("elements",)
    testable = sigma_known or table.lengths[0] > 6
    return TABLES if testable else TABLES[:-1]


def solve_table(job: Job, told: Told) -> tuple[Results, Verdicts | None]:
    """What is found of every pair; of cleaned ones with the decisions."""
    plan = None if job.is_single else plan_for(job.table.lengths)
    found = solve(job.pairs, job.task, plan, told=told)
    found = name_causes(job.pairs, found, job.task, plan)
    used = in_use(job.pairs, found)
    verdicts = None if found.decided is None else make_verdicts(job.table, found)
    told_of: dict[str, Any] = {"rotations": find_rotations(used, found.of_pairs)}
    if job.options.residual == "rigorous":
        patterns = find_patterns(used, found.of_pairs)
        together = table_neighbours.pool(patterns)
        system = job.task.system
        of_pairs, growth = neighbours.allow(used, found.of_pairs, system, together)
        told_of |= {"patterns": patterns, "growth": growth}
        if growth is None:  # the misfit tells nothing of errors that agree
            told_of["intervals"] = _intervals(job, used, found)
        found = found._replace(of_pairs=of_pairs)
        told_of["closures"] = closures.find(
            job.table, job.known, used, of_pairs, system, job.task.sigma_known
        )
    if job.options.out is not None:
        found = add_model_errors(used, found, job.task, plan)
    known, unit = job.task.sigma_known, job.units.photo
    told_of["causes"] = tell_causes(used, found.of_pairs, known, unit)
    results = make_results(
        job.table,
        job.cameras,
        found,
        job.task,
        job.units,
        confidence=job.options.confidence,
        **told_of,
    )
    return results, verdicts


def _intervals(job: Job, used: Ragged, found: Found) -> dict[int, Any]:
    """The intervals by likelihood of pairs whose deviations do not say it all."""
    task, confidence = job.task, job.options.confidence
    return find_intervals(
        used, found.of_pairs, task.system, task.sigma_known, confidence
    )


def run(options: Options) -> bool:
    """Read, orient, show, write. True if every pair is usable. Raises TableError, with
    nothing written."""
    console, errors = consoles()
    with writing(options) as write:
        job = prepare(options)
        warn_of_table(errors, job)
        with progress(errors, "Orienting", len(job.table.names)) as told:
            results, _ = solve_table(job, told)
        summary = job.summary(results)
        write_graph = prepare_pose_graph(job)
        written = write(lambda: files.texts(results, summary))
        written += write_documents(job, results) + write_graph()
    if options.documents.json:
        show_json(files.summary_of(results, summary))
        return bool(results.usable.all())
    show_sigma(console, job)
    report.show_causes(console, results.causes_by_name(), results.wrong.size)
    show(console, job, results)
    console.print(written, end="", markup=False)
    if options.file is None:
        console.print(
            "This was the embedded example. Your own pairs: jaxro orient FILE.csv "
            "--focal F",
            markup=False,
        )
    return bool(results.usable.all())


def warn_of_table(errors: Console, job: Job) -> None:
    """What a careful reader of the table should be told."""
    for warning in job.table.warnings:
        warn(errors, warning)


Texts = Callable[[], dict[str, str]]
"""Makes files by name."""


@contextmanager
def writing(options: Options) -> Iterator[Callable[[Texts], str]]:
    """Within the block --out and the documents are written to by this process alone. The
    function that it gets writes the files of --out, if it is asked for, and says where
    they are. Raises TableError, then nothing is written, also where the input is not any
    more what it was."""
    inputs = whole.Inputs(*options.read)

    def write(texts: Texts) -> str:
        inputs.check()
        if options.out is None:
            return ""
        made = texts()
        whole.write(options.out, made, options.read)
        return f"Written to {options.out}: {', '.join(made)}\n"

    others = (options.out, whole.check_target), (options.g2o, whole.check_file)
    with options.documents.claimed(*others, force=options.force, read=options.read):
        yield write


def prepare_pose_graph(job: Job) -> Callable[[], str]:
    """A function that writes the pose graph that is asked for, and says so in a line.
    Raises TableError where there is none, before anything is written."""
    options = job.options
    file = options.g2o
    if file is None:
        return lambda: ""
    from .pose_graph import graph_text, write_graph

    if options.file is None:
        raise TableError(
            "--g2o",
            found="it without FILE.csv",
            expected="a table whose pairs name their photos",
        )
    text, told = graph_text(
        job.table,
        job.known,
        job.pairs,
        job.task.sigma_known,
        residual=job.task.keywords["residual"],
    )
    return lambda: write_graph(file, text, told)


def write_documents(job: Job, results: Results, cleaned: Cleaned | None = None) -> str:
    """Make the report and the pictures that are asked for; a line for each."""
    options = job.options
    if not options.documents:
        return ""
    from .plots import pictures_of_pairs

    known = None if job.noise is None else deviation.sentence(job.noise, "")
    told = settings(
        options,
        options.read,
        Elements=job.system_name,
        Residuals=options.residual,
        Sigma=known and known.removeprefix("sigma "),
        Procedure=cleaned and cleaned.in_words,
    )
    return options.documents.write(
        page=lambda: page_of_pairs(results, cleaned, told),
        pictures=lambda: pictures_of_pairs(results, cleaned and cleaned.verdicts),
        read=options.read,
    )


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
