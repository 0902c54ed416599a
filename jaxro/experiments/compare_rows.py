"""What procedures find of the wrong rows of an adjustment, a network above all, and what
they cost, by simulation. All of them see the same trials; settings, estimates and their
standard errors are those of pairs (`compare`)."""

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from ..reports.text import table
from ..statistics.promise import draw_errors
from ..statistics.rows import Rows
from .compare import Estimate, Setting, estimate, root_mean_square
from .compare_tables import percent, with_error
from .row_procedures import AbstractRowProcedure, Errors, Found, displaced

if TYPE_CHECKING:
    from rich.table import Table

FURTHER = 3
"""Rounds beyond the number of wrong rows."""


class RowScore(NamedTuple):
    """The results of one procedure in one setting, as shares of 1.

    `noticed`: trials in which something is suspected; without errors, the false alarms.
    `among`: a wrong row is among those suspected first; `misnamed`: one row alone is
    suspected first, and it is a good one. `found`: wrong rows left out, of all wrong
    rows. `lost`: good rows left out. `exactly`: trials that end with just the wrong rows
    left out, the mean success rate. `undecided`: trials that come to no end. `off`: root
    mean square of the errors of all parameters in the standard deviations that they have
    with all rows; 1 without errors.
    """

    setting: Setting
    procedure: str
    trials: int
    noticed: Estimate
    among: Estimate
    misnamed: Estimate
    found: Estimate
    lost: Estimate
    exactly: Estimate
    undecided: Estimate
    off: Estimate


def compare_rows(
    name: str,
    given: Rows,
    procedures: Mapping[str, AbstractRowProcedure],
    *,
    errors: Sequence[int] = (0, 1, 2),
    sizes: Sequence[float] = (4.0, 6.0, 10.0),
    trials: int = 1000,
    seed: int = 0,
    level: float = 0.05,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[RowScore]:
    """Every procedure in every setting of a network with this `name`. `level`: of all
    tests together, where there is no error."""
    settings = [
        Setting(name, number, size)
        for number in errors
        for size in (sizes if number else (0.0,))
    ]
    total, scores = len(settings) * len(procedures), []
    for setting in settings:
        words = f"{setting.errors} {setting.size}"
        key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(words.encode()))
        drawn, wrong = draw_errors(given, key, setting.errors, setting.size, trials)
        for own, procedure in procedures.items():
            rounds = setting.errors + FURTHER
            found = procedure(given, drawn, level=level, rounds=rounds, seed=seed)
            scores.append(_score(setting, own, given, drawn, wrong, found))
            progress(len(scores), total)
    return scores


def _score(
    setting: Setting,
    procedure: str,
    given: Rows,
    errors: Errors,
    wrong: Bool[np.ndarray, "trial row"],
    found: Found,
) -> RowScore:
    first, out = found.first, found.left_out
    good = given.use & ~wrong

    def share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
        number = np.sum(whole, axis=1)
        return np.sum(part, axis=1) / np.where(number > 0, number, np.nan)

    exactly = np.all(out == wrong, axis=1) & found.finished
    alone = np.sum(first, axis=1) == 1
    squares = np.mean(displaced(given, ~out, errors) ** 2, axis=1)
    return RowScore(
        setting,
        procedure,
        len(errors),
        noticed=estimate(np.any(first, axis=1)),
        among=estimate(np.any(first & wrong, axis=1)),
        misnamed=estimate(alone & np.any(first & good, axis=1)),
        found=estimate(share(out & wrong, wrong)),
        lost=estimate(share(out & good, good)),
        exactly=estimate(exactly),
        undecided=estimate(~found.finished),
        off=root_mean_square(np.sqrt(squares)),
    )


def tables_of_rows(scores: Sequence[RowScore]) -> "Iterator[str | Table]":
    """What `jaxro compare` prints of a network: without errors, then with them."""
    first = scores[0]
    yield (
        f"{first.setting.layout}, {first.trials} networks a row; % of networks or "
        "measurements ± standard error; off: error of the points in their standard "
        "deviations, rms"
    )
    calm = [s for s in scores if not s.setting.errors]
    if calm:
        rows = table("no errors", "false alarms", "lost", "undecided", "off")
        for s in calm:
            shares = map(percent, (s.noticed, s.lost, s.undecided))
            rows.add_row(s.procedure, *shares, with_error(*s.off, 2))
        yield rows
    wrong = [s for s in scores if s.setting.errors]
    if not wrong:
        return
    heads = ("noticed", "among", "good first", "found", "good lost", "exactly")
    rows = table("errors", "procedure", *heads, "undecided", "off", left=2)
    for setting, members in groupby(wrong, key=lambda s: s.setting):
        rows.add_section()
        title = f"{setting.errors} x {setting.size:g}σ"
        for s in members:
            shares = s.noticed, s.among, s.misnamed, s.found, s.lost, s.exactly
            cells = map(percent, (*shares, s.undecided))
            rows.add_row(title, s.procedure, *cells, with_error(*s.off, 2))
            title = ""
    yield rows


def cells_of_rows(scores: Sequence[RowScore]) -> list[list]:
    """The scores as rows of a table; shares of 1, se: standard error."""
    estimates = RowScore._fields[3:]
    header = ["network", "errors", "size_sigma", "procedure", "trials"]
    header += [name for one in estimates for name in (one, f"{one}_se")]
    found: list[list] = [header]
    for s in scores:
        numbers = [number for one in s[3:] for number in one]
        found.append([*s.setting, s.procedure, s.trials, *numbers])
    return found
