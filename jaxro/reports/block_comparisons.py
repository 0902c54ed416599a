"""An adjusted block beside the same one by conditions, and beside the classical
adjustment of independent models, on the terminal."""

from collections.abc import Sequence

import numpy as np
from rich.console import Console

from ..block.classical_comparison import Compared
from ..block.conditions import ConditionAdjustment
from .block_model import Done
from .pair import table
from .text import number


def show_conditions(console: Console, done: Done, found: ConditionAdjustment) -> None:
    """One sentence: how far both solutions are from each other."""
    used = done.adjusted.residuals[~done.oriented.wrong.rays]
    apart = float(np.nanmax(np.abs(found.residuals - used)))
    freedom = done.adjusted.degrees_of_freedom
    squares = done.adjusted.sigma0**2 * freedom
    console.print(
        f"By conditions (1982, equations 1 to 9): V'RV {found.squares:.9g} with "
        f"{found.degrees_of_freedom} conditions in excess, by photos and points "
        f"{squares:.9g} with {freedom}; largest difference of a residual {apart:.1e} "
        f"{done.photo_unit}",
        markup=False,
    )


def show_classical(console: Console, rows: Sequence[Compared], unit: str) -> None:
    """The table of estimators: true deviations, and what each claims of them."""
    first = rows[0]
    title = (
        f"Classical adjustment of independent models: true standard deviations of new "
        f"points [{unit}], over the rigorous ones; claimed over true"
    )
    heads = (
        "plan",
        "height",
        "plan/r.",
        "height/r.",
        "median",
        "least",
        "most",
        "prior",
    )
    shown = table("estimator", *heads, title=title)
    for row in rows:
        least, median, most = row.claimed
        over = row.plan / first.plan, row.height / first.height
        cells = [number(value, 3) for value in (row.plan, row.height)]
        cells += [number(v, 2) for v in (*over, median, least, most, row.prior)]
        shown.add_row(row.estimator, *cells)
    console.print(shown)
    console.print(
        "claimed over true: with the sigma0 of each adjustment (median, least, most), "
        "and the median with weights taken at their word (prior)",
        markup=False,
    )
