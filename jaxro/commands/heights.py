"""One call of `jaxro heights` from its options to its report and files."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..reports import survey as report
from ..reports.survey_files import Done, calculate, contents
from ..reports.terminal import consoles
from ..surveys.planning import Deviations
from ..tables import survey as tables, whole
from ..tables.examples import survey as example
from ..tables.fields import TableError
from ..tables.survey import Named


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None
    grid: Path | None
    traverses: Path | None
    camera_height: float | None
    base: float | None
    deviations: list[str]
    out: Path | None
    force: bool


def run(options: Options) -> bool:
    """Read, calculate, show, write. True unless a traverse is suspicious. Raises
    TableError, with nothing written."""
    if options.out is not None:
        whole.check_target(options.out, options.force)
    named = prepare(options)
    console, errors = consoles()
    done = calculate(named)
    title = "the simulated plot" if options.file is None else str(options.file)
    report.show(console, done, title)
    texts: dict[str, Any] = {}
    if options.out is not None:
        texts = contents(done)
        picture, why = drawn(done, title)
        texts |= picture
        whole.write(options.out, texts, (options.file, options.grid, options.traverses))
        if why:
            errors.print(
                f"Warning: no picture of the surface: {why}",
                style="yellow",
                markup=False,
            )
        console.print(f"Written to {options.out}: {', '.join(texts)}", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own survey: jaxro heights READINGS.csv "
            "--grid GRID.csv "
            "--camera-height H --base B",
            markup=False,
        )
    return not (done.suspicious or done.doubtful)


def prepare(options: Options) -> Named:
    """Everything read and checked. Raises TableError."""
    deviations = deviations_of(options.deviations)
    if options.file is None:
        for name, value in (
            ("--grid", options.grid),
            ("--traverses", options.traverses),
            ("--camera-height", options.camera_height),
            ("--base", options.base),
        ):
            if value is not None:
                raise TableError(
                    name,
                    found="it without READINGS.csv",
                    expected="the readings that it belongs to",
                )
        name = example.NAME
        texts = (
            (example.READINGS, tables.READINGS),
            (example.GRID, tables.GRID),
            (example.TRAVERSES, tables.TRAVERSES),
        )
        readings, grid, traverses = (
            tables.rows(text, name, columns) for text, columns in texts
        )
        return tables.assemble(
            readings, grid, traverses, example.CAMERA_HEIGHT, example.BASE, deviations
        )
    if options.grid is None:
        raise TableError(
            "--grid",
            found="no table of the grid",
            expected="--grid GRID.csv with square,side,photo_side",
        )
    camera_height, base = (
        positive(name, value)
        for name, value in (
            ("--camera-height", options.camera_height),
            ("--base", options.base),
        )
    )
    readings, grid = (
        tables.read(options.file, tables.READINGS),
        tables.read(options.grid, tables.GRID),
    )
    traverses = (
        None
        if options.traverses is None
        else tables.read(options.traverses, tables.TRAVERSES)
    )
    return tables.assemble(readings, grid, traverses, camera_height, base, deviations)


def positive(option: str, value: float | None) -> float:
    """The value. Raises TableError unless it is a length."""
    if value is None or not in_bounds(value):
        found = "no value" if value is None else repr(value)
        raise TableError(option, found=found, expected="a positive length in mm")
    return value


def in_bounds(value: float) -> bool:
    """Whether it is a length."""
    return 1 / tables.LONGEST <= value <= tables.LONGEST


def deviations_of(given: list[str]) -> Deviations:
    """The standard deviations, the paper's where no other is given as NAME=VALUE.
    Raises TableError."""
    names = {name.replace("_", "-"): name for name in Deviations._fields}
    values = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if name not in names or not (
            in_bounds(value) or (value == 0 and name != "point")
        ):
            defaults = ", ".join(
                f"{n}={Deviations._field_defaults[f]:g}" for n, f in names.items()
            )
            raise TableError(
                "--sd",
                found=repr(text),
                expected=f"NAME=VALUE in mm, of which the defaults are {defaults}",
            )
        if names[name] in values:
            raise TableError(
                "--sd",
                found=f"{name} a second time",
                expected="each standard deviation once",
            )
        values[names[name]] = value
    return Deviations(**values)


def drawn(done: Done, title: str) -> tuple[dict[str, bytes], str]:
    """The picture of the surface, or why there is none."""
    if done.named.places is None:
        return {}, "the readings have no columns x and y for every point"
    try:
        from ..reports.plots import surface

        n = done.named.points
        value, deviation = (
            np.asarray(a.value[:n]) for a in (done.found.heights, done.found.deviations)
        )
        return {
            "surface.png": surface(
                *done.named.places,
                value,
                deviation,
                done.named.names[:n],
                f"Heights of {title}",
            )
        }, ""
    except ModuleNotFoundError:
        return {}, "it needs matplotlib: pip install 'jaxro[plots]'"
