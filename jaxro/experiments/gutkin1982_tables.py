"""The results of `gutkin1982` beside the print, as tables."""

from itertools import chain
from typing import TYPE_CHECKING

from ..reports.text import number, table
from .gutkin1982 import (
    CASES,
    COLUMNS,
    EXPERIMENT_DEPTH,
    EXPERIMENT_PRINTED,
    MISPRINTS,
    ROWS,
    Results,
)

if TYPE_CHECKING:
    from rich.table import Table


def tables(results: Results) -> "list[str | Table]":
    """What `jaxro reproduce` prints."""
    return [
        "Expected standard deviations of heights over the grid (h) and differences "
        "(dh), mm; the paper's, difference",
        *chain.from_iterable(_case(results, number) for number in range(len(CASES))),
        "The paper's totals follow from its printed terms in all columns. 'exact': "
        "propagation through (1) and (19) "
        "with the dp that belongs to h, -2.2 mm for H = 1500 and B max, where the "
        "paper keeps -0.8.",
        "Numbers of the text",
        *_figures(results),
        "(5) and (6) are printed without p_c2 - p_c1 in the denominator: at the "
        "paper's extremes (p_c = 17.5 and "
        "17.6 mm, dp = -2 mm) a difference is then 0.7 % too large.",
        "The experiment with a model, H = 2100 mm, H:B = 6.4, 22 points; simulated: "
        f"{EXPERIMENT_DEPTH:.0f} mm below the grid, m_dp = 7 µm (h) and 8.5 µm (dh)",
        _experiment(results),
        "1.40 mm lies between the differences of legs within one square, "
        f"{results.legs[0]:.2f} mm (5.6 µm), and those "
        f"between squares, {results.legs[1]:.2f} mm (8.5 µm): a mixture of both kinds "
        "of legs.",
        "(3) has m_dp where m_H is meant; (12), the limit of a misclosure, is lost.",
        "An error of 30 mm in the camera height enlarges the errors of heights over "
        "the grid, not those of "
        "differences.",
    ]


def _case(results: Results, case: int) -> "list[str | Table]":
    """The heights, then the differences, and what is wrong in the print."""
    marks: list[str] = []
    both = [_columns(results, case, begin, marks) for begin in (0, 2)]
    return [*both, *_notes(marks)]


def _columns(results: Results, case: int, begin: int, marks: list[str]) -> "Table":
    """Two columns of the paper, which a narrow terminal has room for."""
    given = CASES[case]
    some = slice(begin, begin + 2)
    rows = table(
        f"H = {given.camera_height:g} mm",
        *chain.from_iterable((c, "paper", "diff.") for c in COLUMNS[some]),
    )
    for row in ROWS:
        digits, cells = (3 if row == "m_pc" else 1), []
        both = zip(results.cells[case, row], given.printed[row], strict=True)
        for column, (found, printed) in list(enumerate(both))[some]:
            mark = _mark(MISPRINTS.get((case, row, column), ""), marks)
            cells += [
                number(found, digits + 1),
                f"{printed:.{digits}f}{mark}",
                number(found - printed, digits + 1),
            ]
        rows.add_row(row, *cells)
    exact = ((number(v, 2), "", "") for v in results.exact[case][some])
    rows.add_row("exact", *chain.from_iterable(exact))
    return rows


def _mark(why: str, marks: list[str]) -> str:
    """The number of a note, which is one of `marks` from now on."""
    if not why:
        return ""
    if why not in marks:
        marks.append(why)
    return f" [{marks.index(why) + 1}]"


def _notes(marks: list[str]) -> list[str]:
    return [f"  [{i}] {why}" for i, why in enumerate(marks, 1)]


def _figures(results: Results) -> "list[str | Table]":
    rows, marks = table("", "calculated", "paper", "diff."), []
    for f in results.figures:
        rows.add_row(
            f.what,
            number(f.found, f.digits),
            f"{f.printed:g}{_mark(f.remark, marks)}",
            number(f.found - f.printed, f.digits),
        )
    return [rows, *_notes(marks)]


def _experiment(results: Results) -> "Table":
    rows = table("", "m_h", "paper", "m_dh", "paper")
    for name, found, printed in zip(
        ("camera height right", "wrong by 30 mm"),
        results.experiment,
        EXPERIMENT_PRINTED,
        strict=True,
    ):
        rows.add_row(
            name,
            *chain.from_iterable(
                (number(a, 2), f"{b:.2f}") for a, b in zip(found, printed, strict=True)
            ),
        )
    return rows
