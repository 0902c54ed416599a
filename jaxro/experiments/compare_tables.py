"""A comparison of procedures as tables."""

import math
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING

from ..reports.text import number, table
from .calibration import Calibration
from .compare import Comparison, Estimate, Score

if TYPE_CHECKING:
    from rich.table import Table


def tables(comparison: Comparison) -> "Iterator[str | Table]":
    """What `jaxro compare` prints: for every layout the procedures as they are, then at
    equal false alarms.

    found: wrong points named. good first: pairs in which the first rejection takes a
    good point. exactly: pairs from which all wrong points are rejected and no other.
    """
    for layout, scores in groupby(comparison.scores, key=lambda s: s.setting.layout):
        here = list(scores)
        yield (
            f"{layout}, {here[0].trials} pairs a row; % of points or pairs ± standard "
            "error; angle to the truth, rms"
        )
        yield from _tables([s for s in here if not s.calibrated])
        if comparison.false_alarms:
            share = f"{100 * comparison.false_alarms:g} %"
            yield (
                f"{layout}, every procedure set so that {share} of the pairs without "
                "errors lose a point"
            )
            yield _setting_table(comparison.calibrations[layout])
            yield from _tables([s for s in here if s.calibrated])


def _tables(scores: list[Score]) -> "Iterator[Table]":
    clean, spoiled = (
        [s for s in scores if bool(s.setting.errors) == wrong]
        for wrong in (False, True)
    )
    if clean:
        yield _clean_table(clean)
    if spoiled:
        yield _error_table(spoiled)


def _clean_table(scores: list[Score]) -> "Table":
    rows = table("no errors", "false alarms", "good lost", "undone", "angle [']")
    for s in scores:
        rows.add_row(
            s.procedure, *map(percent, (s.alarms, s.lost, s.unfinished)), _angle(s)
        )
    return rows


def _error_table(scores: list[Score]) -> "Table":
    rows = table(
        "errors",
        "procedure",
        "found",
        "good first",
        "good lost",
        "exactly",
        "undone",
        "angle [']",
        left=2,
    )
    for setting, members in groupby(scores, key=lambda s: s.setting):
        rows.add_section()
        title = f"{setting.errors} x {setting.size:g}σ"
        for s in members:
            shares = map(
                percent, (s.found, s.misnamed, s.lost, s.perfect, s.unfinished)
            )
            rows.add_row(title, s.procedure, *shares, _angle(s))
            title = ""
    return rows


def _setting_table(calibrations: dict[str, Calibration]) -> "Table":
    rows = table("procedure", "set to", left=2)
    for name, c in calibrations.items():
        rows.add_row(name, c.reason or f"{c.name} = {c.value:.3g}")
    return rows


def percent(e: Estimate) -> str:
    return with_error(100 * e.value, 100 * e.error, 1)


def _angle(s: Score) -> str:
    return with_error(*s.angle, 2)


def with_error(value: float, error: float, digits: int) -> str:
    """The value and its standard error, which a single trial does not have; a dash for
    what does not exist."""
    if math.isnan(value):
        return "-"
    return (
        number(value, digits)
        if math.isnan(error)
        else f"{number(value, digits)} ±{number(error, digits)}"
    )
