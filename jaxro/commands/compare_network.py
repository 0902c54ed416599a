"""One call of `jaxro compare NETWORK.csv`."""

from pathlib import Path
from typing import TYPE_CHECKING

from ..experiments.compare_rows import cells_of_rows, compare_rows, tables_of_rows
from ..experiments.row_procedures import ROW_PROCEDURES, AbstractRowProcedure
from ..reports import files
from ..reports.terminal import consoles, progress
from ..tables import whole
from ..tables.fields import TableError
from . import adjust
from .simulate import check_trials, numbers

if TYPE_CHECKING:
    from .simulate import Wanted


def run_network(options: adjust.Options, wanted: "Wanted") -> bool:
    """Compare procedures on the network of a file. Raises TableError."""
    procedures = _procedures(wanted.procedures)
    errors = numbers("--errors", wanted.errors, int)
    sizes = numbers("--size", wanted.sizes, float)
    check_trials(wanted.trials)
    if not 0 < wanted.false_alarms < 1:
        raise TableError(
            "--false-alarms",
            found=repr(wanted.false_alarms),
            expected="a share between 0 and 1, the level of all tests of a network",
        )
    if wanted.plot is not None:
        raise TableError(
            "--plot",
            found="it with a network",
            expected="no picture, or a table of pairs",
        )
    console, warnings = consoles()
    read = options.file, options.points
    inputs = whole.Inputs(*read)
    with whole.claim_all([(wanted.out, whole.check_file)], wanted.force, read):
        done = adjust.calculate(options)
        _check(done, options.file, errors)
        with progress(warnings, "Comparing", None) as told:
            found = compare_rows(
                f"{done.title}, {len(done.lines)} measurements",
                done.rows,
                procedures,
                errors=errors,
                sizes=sizes,
                trials=wanted.trials,
                seed=wanted.seed,
                level=wanted.false_alarms,
                progress=told,
            )
        inputs.check()
        if wanted.out is not None:
            whole.write_file(wanted.out, files.csv_text(cells_of_rows(found)))
    for part in tables_of_rows(found):
        console.print(part, markup=False)
    if wanted.out is not None:
        console.print(f"Written to {wanted.out}", markup=False)
    return True


def _procedures(names: list[str]) -> dict[str, AbstractRowProcedure]:
    for name in names:
        if name not in ROW_PROCEDURES:
            raise TableError(
                "--procedure",
                found=repr(name),
                expected=f"of a network one of {', '.join(ROW_PROCEDURES)}",
            )
    return {name: ROW_PROCEDURES[name] for name in names or ROW_PROCEDURES}


def _check(done: adjust.Done, file: Path | None, errors: list[int]) -> None:
    """Raises TableError for a network that cannot be simulated."""
    place = str(file)
    if done.result != "successful" or done.freedom < 2:
        raise TableError(
            place,
            found=f"a network with {max(done.freedom, 0)} degrees of freedom: "
            f"{done.result}",
            expected="points that are determined, and measurements that check each other",
        )
    if not done.is_scalar:
        raise TableError(
            place, found="vectors", expected="measurements that are single numbers"
        )
    if max(errors) >= done.freedom:
        raise TableError(
            "--errors",
            found=str(max(errors)),
            expected=f"less than the {done.freedom} degrees of freedom",
        )
