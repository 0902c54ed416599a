"""The results of `dorozhinsky1971` beside the print, as tables."""

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ..geometry import mock_pairs
from ..reports.text import number, table
from .dorozhinsky1971 import (
    ERRORS,
    MEAN_AND_M_Q,
    NOISY,
    READINGS,
    TABLE_1,
    TABLE_2,
    TABLE_2_ELEMENTS,
    TEN_POINTS,
    Decision,
    Results,
)
from .dorozhinsky1971_first_order import EQUATIONS, MISPRINTS, average

if TYPE_CHECKING:
    from rich.table import Table


def tables(results: Results) -> "list[str | Table]":
    """What `jaxro reproduce` prints."""
    return [
        "Table 1: residual parallaxes of the strict solution, hundredths of mm; the "
        "paper's, difference",
        *(_table_1(results, counts) for counts in ((7, 8), (9, 10), (16,))),
        "n = 6, no errors: largest residual "
        f"{np.max(np.abs(results.columns[0].parallax)):.2g} mm. "
        "The sign at point 5, n = 9, is a misprint.",
        "Table 2: residual parallaxes by iteration, hundredths of mm (1: at zero "
        "elements)",
        _by_iteration(results.parallax * 100, TABLE_2, [str(i) for i in range(1, 9)]),
        "Table 2: elements by iteration, arc minutes",
        _by_iteration(
            results.elements,
            TABLE_2_ELEMENTS,
            ["alpha", "chi", "alpha'", "omega'", "chi'"],
        ),
        "Equations (8) and (7'): errors of the elements that an error of point 7 "
        "causes, f = b = y, in parts of it / b",
        _elements_of_7(),
        "Equations (9) and (10): residuals left by an error of point 7, in 36ths of it",
        *(
            part
            for equation in EQUATIONS
            for part in (_equation(results, equation), f"  {MISPRINTS[equation]}")
        ),
        "The text's (6) has 2y1 for 2q1; its (8') is the printed (7').",
        "Ten points, an error of 2.0 mm at point 7 (printed as -2.0): residuals, "
        "hundredths of mm",
        _ten(results),
        f"Condition (3) rejects points {', '.join(map(str, results.ten_rejected))} "
        "(paper 3, 7); 3 has no error.",
        f"Nine residuals of 0.01 mm and one of 0.10 mm: m_q = {results.m_q:.4f} mm "
        "(paper 0.045), "
        f"3 m_q = {3 * results.m_q:.2f} mm (paper 0.13): nothing is rejected",
        "The proposed algorithm: points rejected, in this order. Its 'two iterations' "
        "are one correction of the "
        "elements, since the first is at zero elements (table 2, row 2). The other "
        "reading: two corrections",
        _algorithm(results),
        f"Exactly points 7 and 8 rejected from {NOISY} noisy pairs with errors of 2.0 "
        "and 2.2 mm there: "
        + ", ".join(
            f"{share:.0%} with {n} correction{'s' * (n > 1)}"
            for n, share in results.named_exactly.items()
        ),
        "Where a wrong point is kept and the outcome is 'finished' the mean is below "
        "the tolerance of 0.1 mm, so that "
        "the algorithm reports success. The paper's claim, all errors at any n > 6, "
        "does not hold.",
    ]


def _table_1(results: Results, counts: tuple[int, ...]) -> "Table":
    heads = [what for n in counts for what in (f"n = {n}", "paper", "diff.")]
    rows = table("point", "zone", "error", *heads)
    columns = [c for c in results.columns if c.points in counts]
    for i in range(max(counts)):
        error = (
            number(100 * ERRORS[i], 0)
            if ERRORS[i] and (i != 14 or 16 in counts)
            else ""
        )
        cells = [
            _three(100 * c.parallax[i], TABLE_1[c.points][i])
            if i < c.points
            else ["", "", ""]
            for c in columns
        ]
        rows.add_row(
            str(i + 1), str(mock_pairs.TABLE_1_ZONES[i]), error, *chain(*cells)
        )
    rows.add_section()
    for place, name in enumerate(("mean", "m_q")):
        found = [
            (100 * float(np.mean(np.abs(c.parallax))), 100 * c.m_q)[place]
            for c in columns
        ]
        cells = [
            _three(value, MEAN_AND_M_Q[c.points][place])
            for value, c in zip(found, columns, strict=True)
        ]
        rows.add_row(name, "", "", *chain(*cells))
    return rows


def _three(found: float, printed: float | int) -> list[str]:
    return [number(found, 0), f"{printed:g}", number(found - printed, 0)]


def _by_iteration(found: np.ndarray, printed: tuple, heads: list[str]) -> "Table":
    rows = table("iteration", *heads)
    for i, (ours, theirs) in enumerate(zip(found, np.array(printed), strict=True), 1):
        rows.add_row(f"{i}", *(number(v, 1) for v in ours))
        rows.add_row("  paper", *(f"{v:g}" for v in theirs))
        rows.add_row(
            "  difference", *(number(v, 1) for v in ours - theirs), end_section=True
        )
    return rows


def _elements_of_7() -> "Table":
    zones, _ = EQUATIONS[9]
    found = average(zones, np.eye(len(zones))[6])
    rows = table("", "alpha", "chi", "omega'", "alpha'", "chi'")
    rows.add_row("own rule", *(number(v, 4) for v in found))
    rows.add_row("paper", "-1/4", "1/9", "1/6", "0", "1/6")
    return rows


def _equation(results: Results, equation: int) -> "Table":
    zones, printed = EQUATIONS[equation]
    rows = table(
        f"({equation}), n = {len(zones)}", *(f"v{i}" for i in range(1, len(zones) + 1))
    )
    rows.add_row("paper", *(f"{v:g}" for v in printed))
    rows.add_row(
        "its own rule", *(f"{round(v, 9):g}" for v in results.own_rule[equation] + 0.0)
    )
    rows.add_row(
        "least squares", *(number(v, 2) for v in results.least_squares[equation])
    )
    return rows


def _ten(results: Results) -> "Table":
    rows = table("", *map(str, range(1, len(TEN_POINTS) + 1)))
    rows.add_row("calculated", *(number(100 * v, 0) for v in results.ten))
    rows.add_row("paper", *(f"{v:g}" for v in TEN_POINTS))
    return rows


def _algorithm(results: Results) -> "Table":
    heads = [f"{n} correction{'s' * (n > 1)}" for n in READINGS]
    rows = table(
        "n",
        "wrong points",
        *(what for head in heads for what in (head, "outcome")),
        left=6,
    )
    cases = [(str(c.points), c.wrong, c.decisions) for c in results.columns]
    for name, wrong, decisions in (
        *cases,
        ("table 2", [7, 8], results.pair_of_table_2),
    ):
        rows.add_row(
            name,
            _numbers(wrong),
            *(cell for n in READINGS for cell in _cells(decisions[n])),
        )
    return rows


def _cells(decision: Decision) -> tuple[str, str]:
    return _numbers(
        decision.rejected
    ), f"{decision.outcome}, mean |q| {number(decision.left, 3)} mm"


def _numbers(points: list[int]) -> str:
    return " ".join(map(str, points)) or "-"
