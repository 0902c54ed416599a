"""One call of `jaxro heights` from its options to its report and files."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..reports import survey as report
from ..reports.html.survey import page_of_heights
from ..reports.survey_files import Done, calculate, contents, summary
from ..reports.terminal import consoles
from ..surveys.planning import Deviations
from ..tables import survey as tables, whole
from ..tables.examples import survey as example
from ..tables.fields import TableError
from ..tables.survey import Named
from .documents import NO_DOCUMENTS, Documents, settings, show_json
from .plots import MISSING, pictures_of_heights


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
    documents: Documents = NO_DOCUMENTS

    @property
    def read(self) -> tuple[Path | None, ...]:
        """The files that are read."""
        return self.file, self.grid, self.traverses


def run(options: Options) -> bool:
    """Read, calculate, show, write. True unless a traverse is suspicious. Raises
    TableError, with nothing written."""
    console, errors = consoles()
    title = "the simulated plot" if options.file is None else str(options.file)
    inputs, texts, why = whole.Inputs(*options.read), {}, ""
    out, force = (options.out, whole.check_target), options.force
    with options.documents.claimed(out, force=force, read=options.read):
        done = calculate(prepare(options))
        if options.out is not None:
            picture, why = drawn(done, title)
            texts: dict[str, Any] = contents(done) | picture
            inputs.check()
            whole.write(options.out, texts, options.read)
        written = write_documents(done, title, options)
    good = not (done.suspicious or done.doubtful)
    if options.documents.json:
        show_json(summary(done))
        return good
    report.show(console, done, title)
    if why:
        errors.print(
            f"Warning: no picture of the surface: {why}", style="yellow", markup=False
        )
    if texts:
        console.print(f"Written to {options.out}: {', '.join(texts)}", markup=False)
    console.print(written, end="", markup=False)
    if options.file is None:
        console.print(
            "This was a simulated example. Your own survey: jaxro heights READINGS.csv "
            "--grid GRID.csv "
            "--camera-height H --base B",
            markup=False,
        )
    return good


def write_documents(done: Done, title: str, options: Options) -> str:
    """Make the report and the pictures that are asked for; a line for each."""
    if not options.documents:
        return ""
    told = settings(options, options.read)
    return options.documents.write(
        page=lambda: page_of_heights(done, title, told),
        pictures=lambda: pictures_of_heights(done, title),
        read=options.read,
    )


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
    readings = tables.read(options.file, tables.READINGS)
    grid = tables.read(options.grid, tables.GRID)
    traverses = None
    if options.traverses is not None:
        traverses = tables.read(options.traverses, tables.TRAVERSES)
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
        return pictures_of_heights(done, title), ""
    except ModuleNotFoundError:
        return {}, MISSING
