"""The readable report of oriented pairs on the terminal: what a surveyor expects to
find, in tables."""

import math
from collections import defaultdict
from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .solutions import Solution, Units
from .text import number

MOST_ROWS = 40
"""Longer tables show their worst rows; --out writes all."""

HIGH = 0.95
"""Correlations of elements above this are named."""


def show(console: Console, solved: list[Solution], units: Units, subtitle: str) -> None:
    """One pair in full, or many as one row each."""
    if len(solved) == 1:
        _one(console, solved[0], units, subtitle)
    else:
        _many(console, solved, units, subtitle)


def _one(console: Console, s: Solution, units: Units, subtitle: str) -> None:
    o = s.orientation
    console.print(
        f"[bold]Relative orientation of {escape(s.measured.name)}[/bold], "
        f"{len(s.measured.points)} points"
    )
    console.print(_cameras(s, units) + subtitle)
    console.print(_verdict(s))
    if s.usable:
        asked = () if s.interval is None else (f"± {100 * s.interval.confidence:g} %",)
        elements = table("element", "value", "± sd", *asked, "unit")
        for e in s.elements:
            decimals = digits(e.deviation)
            sd = "given" if e.deviation is None else number(e.deviation, decimals)
            wide = "" if e.half_width is None else number(e.half_width, decimals)
            elements.add_row(
                e.name,
                number(e.value, decimals),
                sd,
                *(wide for _ in asked),
                _unit(e.unit),
            )
        console.print(elements)
        sigma0 = f"sigma0 {number(s.sigma0, digits(s.sigma0))}" + (
            f" {units.sigma0}" if units.sigma0 else ""
        )
        m_q = f"m_q {number(s.m_q, digits(s.m_q))} {units.photo}"
        freedom, rounds = int(o.degrees_of_freedom), int(o.iterations)
        counted = (
            f"{freedom} degree{'s' * (freedom != 1)} of freedom   {rounds} "
            f"iteration{'s' * (rounds != 1)}"
        )
        console.print(f"{sigma0}   {m_q}   {counted}")
        high = {pair: r for pair, r in s.correlations.items() if abs(r) > HIGH}
        named = (
            ", ".join(f"{pair} {100 * r:.1f} %" for pair, r in high.items()) or "none"
        )
        local = " (rx ry rz: turns of the right photo, b1 b2: of the base)" * bool(
            high and "rx/ry" in s.correlations
        )
        console.print(f"Correlations over {HIGH:.0%}: {named}{local}")
    _points(console, s, units)


def _points(console: Console, s: Solution, units: Units) -> None:
    points = s.points
    if points[0]["in_front"] is None:
        return
    corrections = ("v_x_left", "v_y_left", "v_x_right", "v_y_right")
    heads = ("q", "v xl", "v yl", "v xr", "v yr", "r", "X", "Y", "Z")
    rows = table("point", *(heads if s.usable else heads[:6]), title=_legend(s, units))
    size = _rms(p["q"] for p in points)
    photo = digits(max(size, _rms(p[v] for p in points for v in corrections)), 1)
    model = (
        max(
            0,
            min(
                6,
                5
                - math.floor(
                    math.log10(_rms(p[a] for p in points for a in "XYZ") or 1.0)
                ),
            ),
        )
        - 1
    )
    for p in worst(points, lambda p: (p["in_front"], -abs(p["q"]))):
        cells = [number(p[key], photo) for key in ("q", *corrections)] + [
            number(p["redundancy"], 2)
        ]
        cells += [number(p[a], max(model, 0)) for a in "XYZ"] if s.usable else []
        rows.add_row(escape(p["point"]), *cells, style=None if p["in_front"] else "red")
    console.print(rows)
    left_out(console, len(points), "points, those with the largest |q| shown")
    behind = [p["point"] for p in points if not p["in_front"]]
    if behind:
        names = ", ".join(map(escape, behind[:MOST_ROWS])) + (
            ", ..." if len(behind) > MOST_ROWS else ""
        )
        console.print(f"[red]Behind a photo:[/red] {names}")


def _legend(s: Solution, units: Units) -> str:
    model = f", model X Y Z [{_unit(units.model)}]" if s.usable else ""
    return f"y-parallax q and corrections v [{units.photo}], redundancy r{model}"


def _many(
    console: Console, solved: list[Solution], units: Units, subtitle: str
) -> None:
    usable = sum(s.usable for s in solved)
    console.print(
        f"[bold]Relative orientation of {len(solved)} pairs[/bold], {usable} usable"
    )
    console.print(subtitle)
    elements = [e for e in solved[0].elements if e.deviation is not None]
    heads = [f"{e.name} [{_unit(e.unit)}]" if e.unit else e.name for e in elements]
    sigma0 = f"sigma0 [{units.sigma0}]" if units.sigma0 else "sigma0"
    rows = table("pair", "points", *heads, sigma0, f"m_q [{units.photo}]", "result")
    for s in worst(
        solved, lambda s: (s.usable, -s.m_q if math.isfinite(s.m_q) else 0.0)
    ):
        values = [number(e.value, 4) for e in s.elements if e.deviation is not None]
        accuracy = [number(x, digits(x)) for x in (s.sigma0, s.m_q)]
        style = None if not s.advice else "yellow" if s.usable else "red"
        rows.add_row(
            escape(s.measured.name),
            str(len(s.measured.points)),
            *values,
            *accuracy,
            s.result,
            style=style,
        )
    console.print(rows)
    left_out(
        console, len(solved), "pairs, failed ones and those with the largest m_q shown"
    )
    by_result: dict[str, list[Solution]] = defaultdict(list)
    for s in solved:
        if s.advice:
            by_result[s.result].append(s)
    for result, members in by_result.items():
        names = ", ".join(escape(s.measured.name) for s in members[:5]) + (
            ", ..." if len(members) > 5 else ""
        )
        colour = "yellow" if members[0].usable else "red"
        console.print(
            f"[{colour}]{result}[/{colour}] ({len(members)}: {names}): "
            f"{members[0].advice}"
        )


def _cameras(s: Solution, units: Units) -> str:
    left, right = (camera.focal for camera in s.cameras)
    return (
        f"f {left:g} {units.photo}, "
        if left == right
        else f"f {left:g} and {right:g} {units.photo}, "
    )


def _verdict(s: Solution) -> str:
    if not s.advice:
        return "[green]successful[/green]"
    colour = "yellow" if s.usable else "bold red"
    return f"[{colour}]{s.result}[/{colour}]: {s.advice}"


def table(first: str, *numbers: str, title: str | None = None) -> Table:
    """An empty table: names first, then numbers."""
    style = {
        "box": box.SIMPLE_HEAD,
        "pad_edge": False,
        "padding": (0, 1, 0, 0),
        "title_justify": "left",
    }
    rows = Table(title=title and escape(title), **style)
    rows.add_column(first, no_wrap=True)
    for head in numbers:
        rows.add_column(
            escape(head),
            justify="left" if head in ("unit", "result") else "right",
            no_wrap=True,
        )
    return rows


def worst(rows: list, key) -> list:
    """At most MOST_ROWS rows, the worst by `key`, in their own order."""
    kept = {id(row) for row in sorted(rows, key=key)[:MOST_ROWS]}
    return [row for row in rows if id(row) in kept]


def left_out(console: Console, count: int, what: str) -> None:
    """A line about rows that are not shown."""
    if count > MOST_ROWS:
        console.print(f"{MOST_ROWS} of {count} {what}; --out DIR writes all.")


def _unit(unit: str) -> str:
    return {"deg": "°", "base_units": "units of the base"}.get(unit, unit)


def digits(size: float | None, at_least: int = 4) -> int:
    """Decimals that show two significant digits of `size`."""
    if not size or not math.isfinite(size):
        return 4
    return max(at_least, min(8, 1 - math.floor(math.log10(abs(size)))))


def _rms(values: Iterable[float]) -> float:
    squares = [v * v for v in values if math.isfinite(v)]
    return math.sqrt(sum(squares) / len(squares)) if squares else 0.0
