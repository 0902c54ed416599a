"""The readable report of oriented pairs on the terminal: what a surveyor expects to
find, in tables."""

import math
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, SupportsFloat

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from ..orientation.pure_rotation import ANGLES, PureRotation
from ..tables.measured import COORDINATES
from .model import WRONG_AS_A_WHOLE, One, Results
from .rows import left_out, most_rows, worst
from .text import escape, number

HIGH = 0.95
"""Correlations of elements above this are named."""

CORRECTIONS = tuple(f"v_{name}" for name in COORDINATES)
AXES = ("X", "Y", "Z")


def show_causes(console: Console, causes: Mapping[str, list[str]], pairs: int) -> None:
    """What is to be read first: what is wrong with pairs as a whole, by their names, and
    of how many `pairs` there is such a thing to tell."""
    shown = list(causes.items())[: most_rows()]
    for name, sentences in shown:
        for sentence in sentences:
            console.print(f"[bold red]{escape(name)}[/bold red]: {escape(sentence)}")
    if pairs > len(shown):
        console.print(
            f"{len(shown)} of {pairs} pairs with something wrong as a whole; the column "
            "causes of --out DIR tells of all."
        )


def show(console: Console, results: Results, subtitle: str) -> None:
    """One pair in full, or many as one row each."""
    if len(results) == 1:
        _show_one(console, One(results, 0), subtitle)
    else:
        _show_many(console, results, subtitle)


def _show_one(console: Console, one: One, subtitle: str) -> None:
    console.print(
        f"[bold]Relative orientation of {escape(one.name)}[/bold], {one.count} points"
    )
    console.print(_cameras(one) + subtitle)
    console.print(_verdict(one))
    if one.rotation is not None:
        console.print(describe_rotation(one.rotation))
    if one.usable:
        console.print(_elements(one))
        show_numbers(console, one)
        console.print(_correlations(one))
    _show_points(console, one)


def describe_rotation(rotation: PureRotation) -> str:
    """The rotation of a pair without a base, in a line."""
    deviations = np.degrees(rotation.deviations)
    decimals = digits(float(np.max(deviations)))
    angles = zip(ANGLES, np.degrees(rotation.angles), strict=True)
    named = "  ".join(f"{name} {number(a, decimals)}°" for name, a in angles)
    spread = " ".join(number(d, decimals) for d in deviations)
    return (
        f"The right photo is turned by {named}, ± {spread}° about the axes x y z of "
        f"the left one; sigma0 {number(rotation.sigma0, digits(rotation.sigma0))}, "
        f"{int(rotation.degrees_of_freedom)} degrees of freedom"
    )


def show_elements(console: Console, one: One) -> None:
    """The elements with their standard deviations, and those highly correlated."""
    console.print(_elements(one))
    console.print(_correlations(one))


def show_numbers(console: Console, one: One) -> None:
    """sigma0, m_q, degrees of freedom, iterations, in a line."""
    units = one.results.units
    sigma0, m_q = one.value("sigma0"), one.value("m_q")
    freedom, rounds = one.value("degrees_of_freedom"), one.value("iterations")
    accuracy = f"sigma0 {number(sigma0, digits(sigma0))} {units.sigma0}".rstrip()
    console.print(
        f"{accuracy}   m_q {number(m_q, digits(m_q))} {units.photo}   "
        f"{freedom} degree{'s' * (freedom != 1)} of freedom   "
        f"{rounds} iteration{'s' * (rounds != 1)}"
    )


def _elements(one: One) -> Table:
    """The elements with their standard deviations and, if asked for, intervals."""
    confidence = one.results.confidence
    asked = () if confidence is None else (f"± {100 * confidence:g} %",)
    rows = table("element", "value", "± sd", *asked, "unit")
    for e in one.elements:
        decimals = digits(e.deviation)
        sd = "given" if e.deviation is None else number(e.deviation, decimals)
        wide = "" if e.half_width is None else number(e.half_width, decimals)
        value = number(e.value, decimals)
        rows.add_row(e.name, value, sd, *(wide for _ in asked), unit_name(e.unit))
    return rows


def _correlations(one: One) -> str:
    """The elements that are highly correlated."""
    every = one.correlations
    high = {pair: r for pair, r in every.items() if abs(r) > HIGH}
    named = ", ".join(f"{pair} {100 * r:.1f} %" for pair, r in high.items()) or "none"
    local = " (rx ry rz: turns of the right photo, b1 b2: of the base)"
    explained = local if high and "rx/ry" in every else ""
    return f"Correlations over {HIGH:.0%}: {named}{explained}"


def _show_points(console: Console, one: One) -> None:
    """Residuals and model coordinates of the points, where there are any."""
    units, residuals = one.results.units, one.of_points("residuals")
    if not one.count or residuals["in_front"][0] < 0:
        return
    model, q = one.of_points("points"), residuals["q"]
    front = residuals["in_front"] > 0
    photo, decimals = decimals_of_photo(residuals), decimals_of_model(model)
    heads = ("q", "v xl", "v yl", "v xr", "v yr", "r", *(AXES if one.usable else ()))
    named = f", model X Y Z [{unit_name(units.model)}]" if one.usable else ""
    title = f"y-parallax q and corrections v [{units.photo}], redundancy r{named}"
    rows = table("point", *heads, title=title)
    for i in worst(list(range(one.count)), lambda i: (front[i], -abs(q[i]))):
        cells = [number(residuals[key][i], photo) for key in ("q", *CORRECTIONS)]
        cells.append(number(residuals["redundancy"][i], 2))
        if one.usable:
            cells += [number(model[axis][i], decimals) for axis in AXES]
        rows.add_row(escape(one.points[i]), *cells, style=None if front[i] else "red")
    console.print(rows)
    left_out(console, one.count, "points, those with the largest |q| shown")
    behind = [one.points[i] for i in np.flatnonzero(~front)]
    if behind:
        console.print(
            f"[red]Behind a photo:[/red] {escape(join_names(behind, most_rows()))}"
        )


def decimals_of_photo(residuals: dict[str, Any]) -> int:
    """Decimals of the residuals of a pair."""
    corrections = [residuals[v] for v in CORRECTIONS]
    return digits(max(_rms(residuals["q"]), _rms(corrections)), 1)


def decimals_of_model(model: dict[str, Any]) -> int:
    """Decimals of the coordinates of the model."""
    extent = _rms([model[axis] for axis in AXES if axis in model]) or 1.0
    return max(min(6, 5 - math.floor(math.log10(extent))) - 1, 0)


def _show_many(console: Console, results: Results, subtitle: str) -> None:
    units, usable = results.units, results.usable
    console.print(
        f"[bold]Relative orientation of {len(results)} pairs[/bold], "
        f"{usable.sum()} usable"
    )
    console.print(subtitle)
    adjusted = [e for e in One(results, 0).elements if e.deviation is not None]
    heads = [f"{e.name} [{unit_name(e.unit)}]" if e.unit else e.name for e in adjusted]
    sigma0 = f"sigma0 [{units.sigma0}]" if units.sigma0 else "sigma0"
    rows = table("pair", "points", *heads, sigma0, f"m_q [{units.photo}]", "result")
    m_q = np.nan_to_num(results.of_pairs["m_q"], posinf=0.0)
    for k in worst(list(range(len(results))), lambda k: (usable[k], -m_q[k])):
        one = One(results, k)
        values = [number(one.value(e.name), 4) for e in adjusted]
        accuracy = [number(x, digits(x)) for x in map(one.value, ("sigma0", "m_q"))]
        cells = (str(one.count), *values, *accuracy, one.result)
        style = None if not one.advice else "yellow" if one.usable else "red"
        rows.add_row(escape(one.name), *cells, style=style)
    console.print(rows)
    left_out(
        console,
        len(results),
        "pairs, failed ones and those with the largest m_q shown",
    )
    by_result: dict[str, list[One]] = defaultdict(list)
    for one in results:
        if one.advice:
            by_result[one.result].append(one)
    for result, members in by_result.items():
        names = escape(join_names([one.name for one in members], 5))
        colour = "yellow" if members[0].usable else "red"
        console.print(
            f"[{colour}]{result}[/{colour}] ({len(members)}: {names}): "
            f"{members[0].advice}"
        )


def join_names(names: list[str], most: int) -> str:
    """At most so many names."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _cameras(one: One) -> str:
    left, right = (camera.focal for camera in one.cameras)
    unit = one.results.units.photo
    return f"f {left:g}{'' if left == right else f' and {right:g}'} {unit}, "


def _verdict(one: One) -> str:
    if not one.advice:
        return "[green]successful[/green]"
    colour = "yellow" if one.usable else "bold red"
    # the advice about a cause stands above everything
    advice = "see above" if one.result in WRONG_AS_A_WHOLE else one.advice
    return f"[{colour}]{one.result}[/{colour}]: {advice}"


def table(first: str, *numbers: str, title: str | None = None) -> Table:
    """An empty table: names first, then numbers."""
    style = {
        "box": box.SIMPLE_HEAD,
        "pad_edge": False,
        "padding": (0, 1, 0, 0),
        "title_justify": "left",
    }
    lines = None if title is None else "\n".join(map(escape, title.split("\n")))
    rows = Table(title=lines, **style)
    rows.add_column(first, no_wrap=True)
    for head in numbers:
        rows.add_column(
            escape(head),
            justify="left" if head in ("unit", "result") else "right",
            no_wrap=True,
        )
    return rows


def unit_name(unit: str) -> str:
    """A unit as the terminal shows it."""
    return {"deg": "°", "base_units": "units of the base"}.get(unit, unit)


def digits(size: SupportsFloat | None, at_least: int = 4) -> int:
    """Decimals that show two significant digits of `size`."""
    size = 0.0 if size is None else float(size)
    if not size or not math.isfinite(size):
        return 4
    return max(at_least, min(8, 1 - math.floor(math.log10(abs(size)))))


def _rms(values: Any) -> float:
    """Root mean square of the numbers that exist."""
    numbers = np.asarray(values)
    numbers = numbers[np.isfinite(numbers)]
    return math.sqrt(np.mean(numbers**2)) if numbers.size else 0.0
