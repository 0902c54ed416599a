"""One call of `jaxro reproduce` or `jaxro compare`."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp

from ..experiments import REPRODUCTIONS
from ..experiments.compare import LEAST, Comparison, compare
from ..experiments.compare_tables import tables
from ..geometry import mock_pairs
from ..geometry.pairs import Pair, pad
from ..orientation.orient import orient
from ..rejection import PROCEDURES
from ..reports import files
from ..reports.columns import RESULT_ADVICE, RESULT_NAMES
from ..reports.terminal import consoles, progress
from ..tables import whole
from ..tables.fields import TableError
from ..tables.measured import one_pair
from . import orient as jobs, sigma as deviation
from .clean import find_procedure
from .plots import check_picture, picture_of_comparison
from .request import Options

SIGMA = 0.01
"""mm, of the standard layout, as in the papers."""

T = TypeVar("T", int, float)


@dataclass(frozen=True)
class Wanted:
    """What to compare; lists as they were written, 0,1,2,3."""

    procedures: list[str]
    errors: str
    sizes: str
    trials: int
    seed: int
    false_alarms: float
    out: Path | None
    plot: Path | None
    force: bool


def reproduce(name: str, trials: int | None, seed: int | None) -> bool:
    """Calculate and show an experiment of a paper. Raises TableError."""
    if name not in REPRODUCTIONS:
        raise TableError(
            "NAME", found=repr(name), expected=f"one of {', '.join(REPRODUCTIONS)}"
        )
    experiment = REPRODUCTIONS[name]
    for option, value in (("--trials", trials), ("--seed", seed)):
        if value is not None and not experiment.random:
            raise TableError(
                option,
                found=f"it with {name}",
                expected="no such option: nothing is random there",
            )
    check_trials(trials)
    console, errors = consoles()
    with progress(errors, "Calculating", None if experiment.random else 1) as told:
        random = (experiment.trials if trials is None else trials, seed or 0, told)
        results = experiment.run(*random) if experiment.random else experiment.run()
    for part in experiment.tables(results):
        console.print(part, markup=False)
    return True


def run_comparison(options: Options, wanted: Wanted) -> bool:
    """Compare procedures on the layout of the first pair of the file, or the standard
    one. Raises TableError."""
    procedures = {
        name: find_procedure(name) for name in wanted.procedures or PROCEDURES
    }
    errors = numbers("--errors", wanted.errors, int)
    sizes = numbers("--size", wanted.sizes, float)
    check_trials(wanted.trials)
    if not 0 <= wanted.false_alarms < 1:
        raise TableError(
            "--false-alarms",
            found=repr(wanted.false_alarms),
            expected="a share: 0, or less than 1",
        )
    check_picture(wanted.plot)
    console, warnings = consoles()
    inputs = whole.Inputs(*options.read)
    targets = [(file, whole.check_file) for file in (wanted.out, wanted.plot)]
    with whole.claim_all(targets, wanted.force, options.read):
        layouts = layouts_of(options, warnings)
        _check_errors(errors, layouts)
        with progress(warnings, "Comparing", None) as told:
            found = compare(
                layouts,
                procedures,
                errors=errors,
                sizes=sizes,
                trials=wanted.trials,
                seed=wanted.seed,
                false_alarms=wanted.false_alarms,
                progress=told,
            )
        inputs.check()
        if wanted.out is not None:
            whole.write_file(wanted.out, files.csv_text(rows(found)))
        if wanted.plot is not None:
            picture = picture_of_comparison(found, wanted.plot)
            whole.write_file(wanted.plot, picture)
    for part in tables(found):
        console.print(part, markup=False)
    for written in filter(None, (wanted.out, wanted.plot)):
        console.print(f"Written to {written}", markup=False)
    return True


def _check_errors(errors: list[int], layouts: dict[str, Pair]) -> None:
    """Raises TableError where so many wrong points leave too few good ones."""
    most = max(int(exact.count) for exact in layouts.values())
    if max(errors) > most - LEAST:
        expected = (
            f"at most {most - LEAST} of {most} points, so that {LEAST} good ones are "
            "left"
        )
        raise TableError("--errors", found=str(max(errors)), expected=expected)


def layouts_of(options: Options, warnings: Any) -> dict[str, Pair]:
    """The errorless pairs that trials are made of, by name; their sigma is that of the
    simulated coordinates."""
    if options.file is None:
        return _standard(options)
    job = jobs.prepare(options)
    jobs.warn_of_table(warnings, job)
    measured, pair = job.table.pairs[0], one_pair(job.pairs, 0)
    solved = orient(pair)
    if not bool(solved.usable):
        advice = RESULT_ADVICE[RESULT_NAMES[int(solved.result._value)]]
        raise TableError(
            job.table.file,
            line=measured.lines[0],
            found=f"pair {measured.name!r}: {advice}",
            expected="usable elements",
        )
    sigma = pair.sigma if job.task.sigma_known else pair.sigma * solved.sigma0
    if not float(jnp.max(sigma)) > 0:
        raise TableError(
            "--sigma",
            found="none, and no sigma0 from the pair",
            expected="the standard deviation to simulate",
        )
    x_left, y_left, x_right, y_right = solved.corrections(pair)
    exact = mock_pairs.plant(
        pair, x_left=x_left, y_left=y_left, x_right=x_right, y_right=y_right
    )
    size = f"{float(jnp.mean(sigma)):.3g} {options.unit}"
    return {
        f"{measured.name}, {len(measured.points)} points, sigma {size}": _with_sigma(
            exact, sigma
        )
    }


def _standard(options: Options) -> dict[str, Pair]:
    """The sixteen points of 1989 and the eight of 1971, f = b = y = 70 mm.

    The eight points are padded to sixteen, so that the same compiled programs serve
    both layouts.
    """
    for name, value in (
        ("--camera", options.camera),
        ("--focal", options.focal),
        ("--principal-point", options.principal_point),
        ("--pixel-size", options.pixel_size),
        ("--y-down", options.y_down or None),
        ("--unit", None if options.unit == "mm" else options.unit),
    ):
        if value is not None:
            raise TableError(
                name,
                found="it without FILE.csv",
                expected="the table that it belongs to",
            )
    given = deviation.parse(options.sigma)
    sigma = SIGMA if given is None else given
    rows = mock_pairs.mock_pair(mock_pairs.row_layout())
    eight = pad(
        mock_pairs.mock_pair(mock_pairs.standard_layout(8)), rows.x_left.shape[0]
    )
    named = (("eight rows, 16 points", rows), ("standard zones, 8 points", eight))
    return {
        f"{name}, f = b = 70 mm, sigma {sigma:g} mm": _with_sigma(
            exact, jnp.full_like(exact.sigma, sigma)
        )
        for name, exact in named
    }


def _with_sigma(pair: Pair, sigma) -> Pair:
    return eqx.tree_at(lambda p: p.sigma, pair, sigma)


def rows(found: Comparison) -> list[list[Any]]:
    """The scores as rows of a table; shares of 1, angles in arc minutes, se: standard
    error."""
    estimates = (
        "found",
        "good_first",
        "good_lost",
        "named_exactly",
        "alarms",
        "unfinished",
        "angle_arcmin",
    )
    header: list[Any] = [
        "layout",
        "errors",
        "size_sigma",
        "procedure",
        "calibrated",
        "field",
        "value",
        "trials",
    ]
    table = [header + [name for e in estimates for name in (e, f"{e}_se")]]
    for s in found.scores:
        set_to = (
            found.calibrations[s.setting.layout][s.procedure] if s.calibrated else None
        )
        field, value = (set_to.name, set_to.value) if set_to else ("", None)
        shares = s.found, s.misnamed, s.lost, s.perfect, s.alarms, s.unfinished
        values = [number for e in (*shares, s.angle) for number in e]
        table.append(
            [*s.setting, s.procedure, s.calibrated, field, value, s.trials, *values]
        )
    return table


def numbers(option: str, text: str, kind: Callable[[str], T]) -> list[T]:
    """Numbers of a list such as 8,10,15; whole ones from 0, others above 0."""
    try:
        values = [kind(part) for part in text.split(",")]
        good = all(
            math.isfinite(value) and (value > 0 or (kind is int and value == 0))
            for value in values
        )
    except ValueError:
        values, good = [], False
    if not good:
        expected = (
            "numbers such as 0,1,2,3"
            if kind is int
            else "positive numbers such as 8,10,15"
        )
        raise TableError(option, found=repr(text), expected=expected)
    return list(dict.fromkeys(values))


def check_trials(trials: int | None) -> None:
    if trials is not None and trials < 1:
        raise TableError("--trials", found=repr(trials), expected="1 or more")
