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
        _figures(results),
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
    given, marks = CASES[case], []
    rows = table(
        f"H = {given.camera_height:g} mm",
        *chain.from_iterable((c, "paper", "diff.") for c in COLUMNS),
    )
    for row in ROWS:
        digits, cells = (3 if row == "m_pc" else 1), []
        for column, (found, printed) in enumerate(
            zip(results.cells[case, row], given.printed[row], strict=True)
        ):
            why = MISPRINTS.get((case, row, column))
            if why and why not in marks:
                marks.append(why)
            mark = f" [{marks.index(why) + 1}]" if why else ""
            cells += [
                number(found, digits + 1),
                f"{printed:.{digits}f}{mark}",
                number(found - printed, digits + 1),
            ]
        rows.add_row(row, *cells)
    rows.add_row(
        "exact",
        *chain.from_iterable((number(v, 2), "", "") for v in results.exact[case]),
    )
    return [rows, *(f"  [{i}] {why}" for i, why in enumerate(marks, 1))]


def _figures(results: Results) -> "Table":
    rows = table("", "calculated", "paper", "diff.", "remark")
    rows.columns[-1].justify = "left"
    for f in results.figures:
        rows.add_row(
            f.what,
            number(f.found, f.digits),
            f"{f.printed:g}",
            number(f.found - f.printed, f.digits),
            f.remark,
        )
    return rows


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
