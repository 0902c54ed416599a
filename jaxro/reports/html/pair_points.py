"""The table of all points of a pair: residuals, tests, what errors do, the model."""

import math
from typing import SupportsFloat

import numpy as np

from ..model import One
from ..pair import (
    AXES,
    CORRECTIONS,
    decimals_of_model,
    decimals_of_photo,
    digits,
    unit_name,
)
from ..reliability import test_columns
from ..rows import most_rows, worst
from ..text import number
from .page import Row, Table, Tone


def points_table(one: One) -> Table:
    """A row for each point; of many those with the largest |q|."""
    units, residuals = one.results.units, one.of_points("residuals")
    model = one.of_points("points") if one.usable else {}
    tests = test_columns(one)
    q, front = residuals["q"], residuals["in_front"] > 0
    photo, extent = decimals_of_photo(residuals), decimals_of_model(model)
    w = "|w|" if one.results.sigma_known else "tau"
    of_model = unit_name(units.model)
    heads = [
        "point",
        f"q [{units.photo}]",
        *("v xl", "v yl", "v xr", "v yr"),
        "r",
        *((w, "found from", f"moving Z [{of_model}]") if tests else ()),
        *((f"{axis} [{of_model}]" for axis in AXES) if model else ()),
    ]
    limit = float(np.nanmax(tests["limit"])) if tests else math.inf
    rows = []
    for i in worst(list(range(one.count)), lambda i: (front[i], -abs(q[i]))):
        cells = [number(residuals[key][i], photo) for key in ("q", *CORRECTIONS)]
        cells.append(number(residuals["redundancy"][i], 2))
        size = abs(float(tests["w"][i])) if tests else 0.0
        if tests:
            cells += [
                number(size, 2),
                _with_two_digits(tests["detectable_y_right"][i]),
                _with_two_digits(tests["effect_on_Z_of_y_right"][i]),
            ]
        if model:
            cells += [number(model[axis][i], extent) for axis in AXES]
        tone = Tone.bad if not front[i] else Tone.mind if size > limit else Tone.plain
        rows.append(Row([one.points[i], *cells], tone))
    note = f"limit of {w}: {limit:.2f}. " if tests else ""
    if one.count > most_rows():
        note += (
            f"{most_rows()} of {one.count} points, those with the largest |q|; --out "
            "DIR writes all. "
        )
    if not np.all(front):
        note += "Points marked ✗ lie behind a photo. "
    return Table(
        title=f"y-parallax q, corrections v, redundancy r{', tests' * bool(tests)}, model",
        heads=heads,
        numbers=[False] + [True] * (len(heads) - 1),
        rows=rows,
        note=note.strip(),
    )


def _with_two_digits(value: SupportsFloat) -> str:
    return number(value, digits(value, 1))
