"""One call of `jaxro clean` with CSV results: wrong points found, the rest oriented, both
told and written."""

from ..rejection import PROCEDURES, AbstractProcedure
from ..reports import cleaning as report, files, verdicts as decisions
from ..reports.html.pairs import Cleaned
from ..reports.pair import show_causes
from ..reports.terminal import consoles, progress, say_what
from ..tables.examples import mock_pair as example
from ..tables.fields import TableError
from . import orient as jobs, other_programs, promise, sigma
from .documents import show_json
from .request import Example, Options
from .tolerances import change, check_sigma, tolerances

DEFAULT = "recommended"
"""The procedure of users who name none."""

SIMULATED = Example(example.NAME, example.FOCAL, example.TABLE)


def run(
    options: Options, name: str, changes: list[str], repetitions: int | None = None
) -> bool:
    """Read, clean, orient, write, show. True if every pair is cleaned and usable.
    `repetitions` of the simulation of what the intervals hold, if that is wanted. Raises
    TableError."""
    procedure = change(find_procedure(name), changes)
    console, errors = consoles()
    with jobs.writing(options) as write:
        job = jobs.prepare(options, SIMULATED, procedure)
        check_sigma(name, procedure, job.task.sigma_known)
        jobs.warn_of_table(errors, job)
        with progress(errors, "Cleaning", len(job.table.names)) as told:
            results, verdicts = jobs.solve_table(job, told)
        assert verdicts is not None
        if repetitions is not None:
            with say_what("Simulating pairs like these ..."):
                results = promise.add(job, results, verdicts, repetitions)
        summary = job.summary(results)
        heading = {
            "program": summary["program"],
            "file": summary["file"],
            "procedure": name,
            **sigma.entry(job.noise),
            "tolerances": tolerances(procedure),
        }
        written = write(
            lambda: (
                decisions.texts(verdicts, job.units, heading)
                | other_programs.cameras_text(options, job.known)
                | files.texts(results, summary)
            )
        )
        cleaned = Cleaned(verdicts, name, tolerances(procedure))
        written += jobs.write_documents(job, results, cleaned)
    good = bool(results.usable.all()) and set(verdicts.outcomes) == {"finished"}
    if options.documents.json:
        found = decisions.summary_of(verdicts, heading)
        show_json(found | {"orientation": files.summary_of(results, summary)})
        return good
    jobs.show_sigma(console, job)
    show_causes(console, results.causes_by_name(), results.wrong.size)
    report.show(console, verdicts, name, job.units.photo)
    jobs.show(console, job, results)
    console.print(written, end="", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own pairs: jaxro clean FILE.csv "
            "--focal F",
            markup=False,
        )
    return good


def choose_procedure(name: str, changes: list[str]) -> tuple[str, AbstractProcedure]:
    """The procedure with its changed tolerances, by its name. Raises TableError."""
    return name, change(find_procedure(name), changes)


def find_procedure(name: str) -> AbstractProcedure:
    """The procedure of this name. Raises TableError."""
    if name not in PROCEDURES:
        raise TableError(
            "--procedure", found=repr(name), expected=f"one of {', '.join(PROCEDURES)}"
        )
    return PROCEDURES[name]
