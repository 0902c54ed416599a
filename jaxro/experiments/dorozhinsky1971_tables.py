"""The results of `dorozhinsky1971` beside the print, as tables."""

from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from .. import simulation
from .dorozhinsky1971 import EQUATIONS, ERRORS, MEAN_AND_M_Q, TABLE_1, TABLE_2, TABLE_2_ELEMENTS, Results
from .tables import number, table

if TYPE_CHECKING:
    from rich.table import Table


def tables(results: Results) -> "list[str | Table]":
    """What `jaxro reproduce` prints."""
    return [
        "Table 1: residual parallaxes of the strict solution, hundredths of mm; the paper's, difference",
        *(_table_1(results, counts) for counts in ((7, 8), (9, 10), (16,))),
        f"n = 6, no errors: largest residual {np.max(np.abs(results.columns[0].parallax)):.2g} mm. "
        "The sign at point 5, n = 9, is a misprint.",
        "Table 2: residual parallaxes by iteration, hundredths of mm (1: at zero elements)",
        _by_iteration(results.parallax * 100, TABLE_2, [str(i) for i in range(1, 9)]),
        "Table 2: elements by iteration, arc minutes",
        _by_iteration(results.elements, TABLE_2_ELEMENTS, ["alpha", "chi", "alpha'", "omega'", "chi'"]),
        "Equations (9) and (10): residuals left by an error of point 7, in 36ths of it",
        *(_equation(results, equation) for equation in EQUATIONS),
        "The printed forms come from an averaged solution, not from least squares.",
        f"Nine residuals of 0.01 mm and one of 0.10 mm: m_q = {results.m_q:.4f} mm (paper 0.045), "
        f"3 m_q = {3 * results.m_q:.2f} mm (paper 0.13): nothing is rejected",
        "The proposed algorithm on the pairs of table 1: rejected in this order, mean |q| left",
        _algorithm(results),
        "Where a wrong point is kept the mean is below its tolerance of 0.1 mm, so that the algorithm reports success.",
    ]


def _table_1(results: Results, counts: tuple[int, ...]) -> "Table":
    heads = [what for n in counts for what in (f"n = {n}", "paper", "diff.")]
    rows = table("point", "zone", "error", *heads)
    columns = [c for c in results.columns if c.points in counts]
    for i in range(max(counts)):
        error = number(100 * ERRORS[i], 0) if ERRORS[i] and (i != 14 or 16 in counts) else ""
        cells = [_three(100 * c.parallax[i], TABLE_1[c.points][i]) if i < c.points else ["", "", ""] for c in columns]
        rows.add_row(str(i + 1), str(simulation.TABLE_1_ZONES[i]), error, *chain(*cells))
    rows.add_section()
    for place, name in enumerate(("mean", "m_q")):
        found = [(100 * float(np.mean(np.abs(c.parallax))), 100 * c.m_q)[place] for c in columns]
        cells = [_three(value, MEAN_AND_M_Q[c.points][place]) for value, c in zip(found, columns, strict=True)]
        rows.add_row(name, "", "", *chain(*cells))
    return rows


def _three(found: float, printed: float | int) -> list[str]:
    return [number(found, 0), f"{printed:g}", number(found - printed, 0)]


def _by_iteration(found: np.ndarray, printed: tuple, heads: list[str]) -> "Table":
    rows = table("iteration", *heads)
    for i, (ours, theirs) in enumerate(zip(found, np.array(printed), strict=True), 1):
        rows.add_row(f"{i}", *(number(v, 1) for v in ours))
        rows.add_row("  paper", *(f"{v:g}" for v in theirs))
        rows.add_row("  difference", *(number(v, 1) for v in ours - theirs), end_section=True)
    return rows


def _equation(results: Results, equation: int) -> "Table":
    zones, printed = EQUATIONS[equation]
    exact = results.exact[equation]
    rows = table(f"({equation}), n = {len(zones)}", *(f"v{i}" for i in range(1, len(zones) + 1)))
    rows.add_row("least squares", *(number(v, 2) for v in exact))
    rows.add_row("paper", *(f"{v:g}" for v in printed))
    rows.add_row("difference", *(number(v, 2) for v in exact - np.array(printed)))
    return rows


def _algorithm(results: Results) -> "Table":
    rows = table("n", "wrong points", "rejected", "missed", "good lost", "mean |q|", "outcome", left=5)
    for c in results.columns:
        cells = [" ".join(map(str, numbers)) or "-" for numbers in (c.wrong, c.rejected, c.missed, c.lost)]
        rows.add_row(str(c.points), *cells, f"{number(c.left, 3)} mm", c.outcome)
    return rows
