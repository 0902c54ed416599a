"""How far the measurements of a pair check one another: for the terminal a table and
sentences, for --out a file."""

from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from ..assessment import Pattern
from ..assessment.reliability import BOUNDS, CONTROL, Reliability
from .pair import digits, left_out, table, worst
from .solutions import Solution, Units, pattern_of_all
from .text import number

COORDINATES = ("x_left", "y_left", "x_right", "y_right")

DOUBTFUL = 0.05
"""Probability of sigma0 below which it is mentioned."""


def show(console: Console, s: Solution, units: Units) -> None:
    """The table of the points, if any can be tested, and what a surveyor should
    mind."""
    if s.reading is not None and np.any(s.reading.testable):
        _points(console, s, s.reading, units)
    for sentence in sentences(s, units):
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def show_of_all(console: Console, solved: list[Solution], units: Units) -> None:
    """What to mind of all pairs together."""
    for sentence in pattern_sentences(
        pattern_of_all(solved), units, " of all pairs together"
    ):
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def _points(console: Console, s: Solution, reading: Reliability, units: Units) -> None:
    """r, |w|, the error of y_right that is just found, and what it does."""
    w = "|w|" if reading.known else "tau"
    title = (
        f"r; {w}, limit {float(reading.limit):.2f}; error of y_right found from "
        f"[{units.photo}],\n"
        f"moving Z of its point [{_unit(units)}] and elements [sd]"
    )
    rows = table("point", "r", w, "found from", "moving Z", "elements", title=title)
    every = range(len(s.measured.points))
    found_from, moved, suspicious = (
        reading.detectable[3],
        reading.external,
        reading.suspicious,
    )
    for i in worst(list(every), lambda i: -abs(float(reading.w[i]))):
        size, found, moves = (
            abs(float(reading.w[i])),
            float(found_from[i]),
            float(reading.effect_height[3][i]),
        )
        cells = [
            number(float(reading.redundancy[i]), 2),
            number(size, 2),
            number(found, digits(found, 1)),
        ]
        cells += [number(moves, digits(moves, 1)), number(float(moved[i]), 1)]
        style = "yellow" if suspicious[i] else None
        rows.add_row(escape(s.measured.points[i]), *cells, style=style)
    console.print(rows)
    left_out(console, len(every), "points, those with the largest |w| shown")


def sentences(s: Solution, units: Units) -> list[str]:
    """What to mind of a usable orientation."""
    if not s.usable:
        return []
    freedom, reading = int(s.orientation.degrees_of_freedom), s.reading
    if freedom == 0:
        return ["Five points: no measurement checks another, and no error would show."]
    said = []
    if reading is None and freedom == 1:
        said.append(
            "One degree of freedom: an error would enlarge sigma0, but no point can be "
            "tested. Measure more points, or "
            "give --sigma."
        )
    if reading is not None:
        said += _doubts(s, reading)
    said += pattern_sentences(s.pattern, units)
    redundancy = s.orientation.redundancy[: len(s.measured.points)]
    names = [
        [
            p
            for p, r in zip(s.measured.points, redundancy, strict=True)
            if low <= r < high
        ]
        for low, high in zip((-np.inf, BOUNDS[0]), BOUNDS[:2], strict=True)
    ]
    if names[0]:
        said.append(
            f"Nothing checks {_listed(names[0])} (redundancy below {BOUNDS[0]}): an "
            "error there never shows."
        )
    if names[1]:
        every = (
            []
            if reading is None
            else zip(s.measured.points, reading.detectable[3], strict=False)
        )
        hidden = [found for name, found in every if name in names[1]]
        most = max((float(h) for h in hidden if np.isfinite(h)), default=None)
        size = (
            ""
            if most is None
            else (
                f"; an error of {number(most, digits(most, 1))} {units.photo} in y may "
                "not show"
            )
        )
        said.append(
            f"Poorly checked (redundancy below {BOUNDS[1]}): {_listed(names[1])}{size}."
        )
    return said


def pattern_sentences(pattern: Pattern | None, units: Units, of: str = "") -> list[str]:
    """What a pattern in the residuals means, if there is one."""
    if pattern is None or not pattern.flagged:
        return []
    rho, length, chance = (
        float(x) for x in (pattern.rho, pattern.length, pattern.probability)
    )
    return [
        f"The standard deviations assume independent errors; here neighbours{of} agree "
        f"by {number(rho, 1)}, over about "
        f"{number(length, digits(length, 0))} {units.photo} (probability "
        f"{chance:.1g}): they are too small."
    ]


def _doubts(s: Solution, reading: Reliability) -> list[str]:
    """What the tests of sigma0 and of the points found."""
    said = []
    if reading.known:
        ratio, chance = (
            float(reading.estimated / reading.sigma0),
            float(reading.global_p()),
        )
        if chance < DOUBTFUL and ratio > 1:
            said.append(
                f"The coordinates are {ratio:.1f} times less accurate than their sigma "
                "says (probability "
                f"{chance:.1g}): sigma is too small, or points are wrong."
            )
        elif chance < DOUBTFUL:
            said.append(
                f"The coordinates are {1 / ratio:.1f} times more accurate than their "
                "sigma says (probability "
                f"{chance:.1g}): sigma is too large."
            )
    w = np.where(reading.testable, np.abs(reading.w), 0.0)
    if w.size and np.max(w) > reading.limit:
        others = int(np.sum(w > reading.limit)) - 1
        also = (
            f"; so has {others} other point{'s' * (others != 1)}, perhaps because of it"
            if others
            else ""
        )
        said.append(
            f"Point {s.measured.points[int(np.argmax(w))]} has "
            f"|{'w' if reading.known else 'tau'}| = {np.max(w):.2f} "
            f"where {float(reading.limit):.2f} "
            f"is allowed{also}. Measure it again, or see jaxro clean."
        )
    return said


def _listed(names: list[str]) -> str:
    some = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
    return f"point{'s' * (len(names) > 1)} {some}"


def _unit(units: Units) -> str:
    return {"base_units": "units of the base"}.get(units.model, units.model)


def file_rows(solved: list[Solution], units: Units) -> list[list[Any]]:
    """reliability.csv: every point of every pair; empty where nothing checks it."""
    photo, model = f"_{units.photo}", f"_{units.model}"
    heads = ["pair", "point", "redundancy", "w", "limit", "external_reliability"]
    heads += [f"control_{c}" for c in COORDINATES] + [
        f"detectable_{c}{photo}" for c in COORDINATES
    ]
    rows: list[list[Any]] = [
        heads + [f"effect_on_Z_of_{c}{model}" for c in COORDINATES]
    ]
    for s in solved:
        if s.reading is None or not s.usable:
            rows += [
                [s.measured.name, name] + [None] * (len(rows[0]) - 2)
                for name in s.measured.points
            ]
            continue
        reading = s.reading
        control = [
            np.searchsorted(BOUNDS, r, side="right")
            for r in reading.coordinate_redundancy
        ]
        tested, external, sizes = (
            reading.testable,
            reading.external,
            (*reading.detectable, *reading.effect_height),
        )
        for i, name in enumerate(s.measured.points):
            row = [s.measured.name, name, float(reading.redundancy[i])]
            row += (
                [float(reading.w[i]), float(reading.limit)]
                if tested[i]
                else [None, None]
            )
            row += [float(external[i]), *(CONTROL[c[i]] for c in control)]
            rows.append([*row, *(float(size[i]) for size in sizes)])
    return rows
