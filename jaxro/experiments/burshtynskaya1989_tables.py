"""The results of `burshtynskaya1989` beside the print, as tables."""

from dataclasses import astuple
from typing import TYPE_CHECKING

from .burshtynskaya1989 import NAMED, PAPER, Results, Run
from .tables import table

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
        f"Table 2: {pairs} mock pairs, without noise as in the paper and with noise; eps4 [mm]: tolerance of the first "
        "stage",
        _table_2(results),
        "By class of errors: I 1 sigma, II 10-15 sigma, III 8-10 sigma; lost: good points",
        _by_class(results),
        "Pairs that the text describes: points rejected by residual parallax; by Grubbs",
        _named(results),
    ]


def _title(run: Run) -> str:
    return f"{run.eps4:g}{', noise' * run.noise}"


def _table_2(results: Results) -> "Table":
    heads = ["noise" if run.noise else f"eps4 {run.eps4:g}" for run in results.runs]
    rows = table("", *heads, "paper")
    columns = [astuple(run.total) for run in results.runs] + [astuple(PAPER)]
    for place, (name, whole) in enumerate(ROWS):
        cells = [f"{c[place]}{_share(c[place], c[whole]) if whole else ' ' * 5}" for c in columns]
        rows.add_row(name, *cells, end_section=place == 5)
    return rows


def _by_class(results: Results) -> "Table":
    rows = table("eps4", "class", "errors", "parallax", "Grubbs", "missed", "lost", "pairs", "cleaned", left=2)
    for run in results.runs:
        for name, c in run.by_class.items():
            cleaned = c.pairs_by_parallax + c.pairs_by_grubbs
            cells = (c.errors, c.by_parallax, c.by_grubbs, c.missed, c.good, c.pairs, cleaned)
            rows.add_row(_title(run), name, *map(str, cells), end_section=name == "III")
    return rows


def _named(results: Results) -> "Table":
    rows = table("variant", "errors [mm]", "paper", *(f"eps4 {eps4:g}" for eps4 in results.named), left=5)
    listed = lambda points: " ".join(map(str, points)) or "-"
    for name, variant in NAMED.items():
        errors = ", ".join(f"{point} {error:+g}" for point, error in variant.errors.items())
        found = ["; ".join(map(listed, of[name])) for of in results.named.values()]
        rows.add_row(name, errors, listed(variant.rejected), *found)
    return rows


def _share(part: int, whole: int) -> str:
    return f" {100 * part / whole:3.0f}%" if whole else ""
