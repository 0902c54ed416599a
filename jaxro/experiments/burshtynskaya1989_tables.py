"""The results of `burshtynskaya1989` beside the print, as tables."""

from dataclasses import astuple
from typing import TYPE_CHECKING

from ..reports.text import table
from .burshtynskaya1989 import NAMED, PAPER, TOLERANCES, Results, Run, common
from .burshtynskaya1989_conclusions import describe

if TYPE_CHECKING:
    from rich.table import Table

ROWS = (
    ("points measured", None),
    ("errors introduced", 1),
    ("by residual parallax", 1),
    ("by Grubbs besides", 1),
    ("good points rejected", 1),
    ("errors missed", 1),
    ("pairs", None),
    ("cleaned by parallax", 6),
    ("cleaned with Grubbs", 6),
    ("that lost a good point", 6),
)
"""The rows, and the row that is their 100 %."""


def tables(results: Results) -> "list[str | Table]":
    """What `jaxro reproduce` prints."""
    pairs = results.runs[0].total.pairs
    return [
        f"Table 2: {pairs} mock pairs, without noise as in the paper and with noise; "
        "eps4 [mm]: tolerance of the first "
        "stage",
        _table_2(results),
        "By class of errors: I 1 sigma, II 10-15 sigma, III 8-10 sigma; lost: good "
        "points",
        _by_class(results),
        "Pairs that the text describes: points rejected by residual parallax; by "
        "Grubbs",
        _described_pairs(results),
        "Tolerances eps4 (mm) with which the first stage rejects just the points that "
        "the text names, by the rows of "
        "the layout (its figure is lost)",
        _fitting(results),
        "The six conclusions, simulated with noise of 0.01 mm, eps4 = "
        f"{TOLERANCES[-1]:g} mm",
        _conclusions(results),
        "The legible part of table 1 contradicts the classes: I-4 and I-5 have 0.02 mm "
        "(2 sigma), III-1 has 0.2 mm (20 "
        "sigma). 'Critical region v < v_q' is the acceptance region; the paper does "
        "not give its level.",
    ]


def _title(run: Run) -> str:
    return f"{run.eps4:g}{', noise' * run.noise}"


def _table_2(results: Results) -> "Table":
    heads = ["noise" if run.noise else f"eps4 {run.eps4:g}" for run in results.runs]
    rows = table("", *heads, "paper")
    columns = [astuple(run.total) for run in results.runs] + [astuple(PAPER)]
    for place, (name, whole) in enumerate(ROWS):
        cells = [
            f"{c[place]}{_share(c[place], c[whole]) if whole else ' ' * 5}"
            for c in columns
        ]
        rows.add_row(name, *cells, end_section=place == 5)
    return rows


def _by_class(results: Results) -> "Table":
    rows = table(
        "eps4",
        "class",
        "errors",
        "parallax",
        "Grubbs",
        "missed",
        "lost",
        "pairs",
        "cleaned",
        left=2,
    )
    for run in results.runs:
        for name, c in run.by_class.items():
            cleaned = c.pairs_by_parallax + c.pairs_by_grubbs
            cells = (
                c.errors,
                c.by_parallax,
                c.by_grubbs,
                c.missed,
                c.good,
                c.pairs,
                cleaned,
            )
            rows.add_row(_title(run), name, *map(str, cells), end_section=name == "III")
    return rows


def _described_pairs(results: Results) -> "Table":
    rows = table(
        "variant",
        "errors [mm]",
        "paper",
        *(f"eps4 {eps4:g}" for eps4 in results.named),
        left=5,
    )
    listed = lambda points: " ".join(map(str, points)) or "-"
    for name, variant in NAMED.items():
        errors = ", ".join(
            f"{point} {error:+g}" for point, error in variant.errors.items()
        )
        found = ["; ".join(map(listed, of[name])) for of in results.named.values()]
        rows.add_row(name, errors, listed(variant.rejected), *found)
    return rows


def _fitting(results: Results) -> "Table":
    rows = table("rows y/b", *NAMED, "all three", left=1)
    for layout, intervals in results.fitting.items():
        rows.add_row(
            layout,
            *(_interval(i) for i in intervals.values()),
            _interval(common(intervals.values())),
        )
    return rows


def _interval(limits: tuple[float, float]) -> str:
    above, up_to = limits
    return f"{above:.4f}-{up_to:.4f}" if above < up_to else "none"


def _conclusions(results: Results) -> "Table":
    rows = table("the paper", "simulated", "", left=3)
    for column in rows.columns:
        column.no_wrap = False
    for cells in describe(results.conclusions):
        rows.add_row(*cells)
    return rows


def _share(part: int, whole: int) -> str:
    return f" {100 * part / whole:3.0f}%" if whole else ""
