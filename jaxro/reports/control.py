"""Known points of the ground beside what was found of them: control and check
points."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from .pair import digits, table
from .rows import left_out, worst
from .text import escape, number

CONTRADICTED = (
    " No cause that was tried explains it: look at names, axes, units and coordinate "
    "systems of what is known, and at the camera."
)
"""What is to be done where what is known contradicts the photos."""

AXES = ("X", "Y", "Z")
LEVEL = 0.05
"""Probability that any check coordinate exceeds its limit although none is wrong."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Compared:
    """Ground coordinates beside the places of their model points: names, given
    coordinates, which of them there are, `differences` place minus given, and these
    over their standard deviations (`w`, NaN where nothing checks them)."""

    names: list[str]
    given: Float[np.ndarray, "point 3"]
    known: Bool[np.ndarray, "point 3"]
    differences: Float[np.ndarray, "point 3"]
    w: Float[np.ndarray, "point 3"]

    def rms(self) -> list[float]:
        """Of the differences in X, Y, Z; NaN where there are none."""
        return [
            float(np.sqrt(np.mean(d[k] ** 2))) if np.any(k) else np.nan
            for d, k in zip(self.differences.T, self.known.T, strict=True)
        ]


def kinds_in_words(known: Bool[np.ndarray, "point 3"]) -> str:
    """How many points are known in what: 3 full, 2 in plan, 3 in height."""
    plan = np.any(known[:, :2], axis=1)
    kinds = {
        "full": plan & known[:, 2],
        "in plan": plan & ~known[:, 2],
        "in height": known[:, 2] & ~plan,
    }
    return (
        ", ".join(f"{np.sum(k)} {name}" for name, k in kinds.items() if np.any(k))
        or "none"
    )


def in_words(one: Compared, unit: str) -> str:
    """The root mean squares: X 0.021, Y 0.018, Z 0.030 m."""
    found = zip(AXES, one.rms(), strict=True)
    told = [f"{axis} {number(r, digits(r, 1))}" for axis, r in found if np.isfinite(r)]
    return f"{', '.join(told)} {unit}"


def add_rows(
    rows: Table,
    one: Compared,
    limit: float,
    redundancy: Float[np.ndarray, "point 3"] | None = None,
) -> None:
    """A row for each of the worst points: differences, redundancies, largest |w|."""
    sizes = np.max(np.abs(np.nan_to_num(one.w)), axis=1, initial=0.0)
    # one bad point is not to hide the digits of the others
    typical = np.median(np.abs(one.differences[one.known])) if np.any(one.known) else 0
    decimals = digits(float(typical), 1)
    cell = lambda value, there, places: number(value, places) if there else ""
    for k in worst(list(range(len(one.names))), lambda k: -sizes[k]):
        cells = [
            cell(v, there, decimals)
            for v, there in zip(one.differences[k], one.known[k], strict=True)
        ]
        if redundancy is not None:
            cells += [
                cell(r, there, 2)
                for r, there in zip(redundancy[k], one.known[k], strict=True)
            ]
        style = "yellow" if sizes[k] > limit else None
        rows.add_row(escape(one.names[k]), *cells, number(sizes[k], 2), style=style)


def show_checks(
    console: Console, checks: Compared, place: str, unit: str, limit: float
) -> None:
    """The table of check points, if there are any: `place` minus given coordinates."""
    if not checks.names:
        return
    title = (
        f"Check points: {place} minus given [{unit}];\n"
        f"largest |d|/sd, limit {number(limit, 2)}"
    )
    rows = table("point", "dX", "dY", "dZ", "|d|/sd", title=title)
    add_rows(rows, checks, limit)
    console.print(rows)
    left_out(console, len(checks.names), "points, those with the largest shown")


def control_rows(
    one: Compared, role: str, head: str, redundancy: Float[np.ndarray, "point 3"]
) -> list[Row]:
    """What control.csv says of these points; `head`: the name of the test, w or tau."""
    columns = {"": one.given, "v": one.differences, "redundancy_": redundancy}
    columns[f"{head}_"] = one.w
    rows: list[Row] = [{"point": name, "role": role} for name in one.names]
    for start, values in columns.items():
        for axis, name in enumerate(AXES):
            for row, value, known in zip(
                rows, values[:, axis], one.known[:, axis], strict=True
            ):
                row[f"{start}{name}"] = float(value) if known else None
    return rows
