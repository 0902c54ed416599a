"""One call of `jaxro orient` from its options to its reports."""

import math
import os
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .. import coplanarity
from ..elements import AbstractElements, DependentElements, IndependentElements, RelativePose
from ..orientation import Orientation, orient
from ..pairs import Camera, Pair
from . import cameras as camera_files, example, files, tables
from .solutions import Solution, Units, solutions
from .tables import TableError

SYSTEMS: dict[str, type[AbstractElements]] = {
    "relative": RelativePose,
    "dependent": DependentElements,
    "independent": IndependentElements,
}
CHEAP = 1_000_000
"""Padded points that take less time to calculate than another program takes to compile."""

RESIDUALS = {"rigorous": coplanarity.rigorous, "parallax": coplanarity.parallax}


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None = None
    camera: Path | None = None
    focal: float | None = None
    principal_point: tuple[float, float] | None = None
    pixel_size: float | None = None
    y_down: bool = False
    sigma: float | None = None
    elements: str | None = None
    base: float | None = None
    residual: str = "rigorous"
    unit: str = "mm"
    out: Path | None = None
    force: bool = False


def run(options: Options) -> bool:
    """Read, orient, write, show. True if every pair is usable. Raises TableError, with nothing written."""
    from rich.console import Console

    if options.out is not None:
        files.check_target(options.out, options.force)
    system = SYSTEMS[options.elements or ("relative" if options.file else "dependent")]
    table = read_table(options)
    cameras = read_cameras(options, table)
    _check_numbers(options, table, system)
    pairs = [
        camera_files.to_pair(measured, table.file, *both, options.sigma)
        for measured, both in zip(table.pairs, cameras, strict=True)
    ]
    units = Units(
        photo=options.unit,
        model="bases" if system is RelativePose else options.unit if options.base is None else "base_units",
        sigma0="" if table.has_sigma or options.sigma is not None else options.unit,
    )
    # text that goes to a file or a pipe is not wrapped at 80 columns
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 200
    console = Console(width=wide, highlight=False)
    errors = Console(stderr=True, highlight=False)
    for warning in table.warnings:
        errors.print(f"Warning: {warning}", style="yellow", markup=False)
    keywords = {"elements": system, "base": options.base, "residual": RESIDUALS[options.residual]}
    solved = solutions(table.pairs, cameras, _with_progress(errors, pairs, keywords), units)
    if options.out is not None:
        files.write(options.out, solved, units, _summary(options, table, system, solved))
    _show(console, options, solved, units, system)
    return all(s.usable for s in solved)


def read_table(options: Options) -> tables.Table:
    """The pairs of the file, or the example."""
    if options.file is None:
        return tables.parse(example.TABLE, example.NAME, example.NAME)
    return tables.read(options.file)


def read_cameras(options: Options, table: tables.Table) -> list[tuple[Camera, Camera]]:
    """(left, right) camera of every pair, from --camera or from the single options."""
    single = {
        "--focal": options.focal,
        "--principal-point": options.principal_point,
        "--pixel-size": options.pixel_size,
        "--y-down": options.y_down or None,
    }
    if options.camera is not None:
        for name, value in single.items():
            if value is not None:
                raise TableError(name, None, None, "it beside --camera", f"this entry in {options.camera} instead")
        known = camera_files.read(options.camera)
        return [known.of(measured, table.file) for measured in table.pairs]
    focal = example.FOCAL if options.file is None and options.focal is None else options.focal
    if focal is None:
        expected = f"the focal length of the photos, --focal {example.FOCAL} or --camera camera.toml"
        raise TableError("--focal", None, None, "neither --focal nor --camera", expected)
    for name, value in (("--focal", focal), ("--pixel-size", options.pixel_size)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise TableError(name, None, None, repr(value), "a positive number")
    centre = options.principal_point or (0.0, 0.0)
    if not all(map(math.isfinite, centre)):
        raise TableError("--principal-point", None, None, repr(centre), "two numbers")
    pixel_size = 1.0 if options.pixel_size is None else options.pixel_size
    one = Camera(focal, centre, pixel_size, options.y_down)
    return [(one, one)] * len(table.pairs)


def _check_numbers(options: Options, table: tables.Table, system: type[AbstractElements]) -> None:
    if options.sigma is not None:
        if table.has_sigma:
            raise TableError(
                "--sigma", None, None, f"it beside the column sigma of {table.file}", "only one of the two"
            )
        if not (math.isfinite(options.sigma) and options.sigma > 0):
            raise TableError("--sigma", None, None, repr(options.sigma), "a positive standard deviation")
    if options.base is not None:
        if system is RelativePose:
            expected = "--elements dependent or independent with it; the relative system has the base 1"
            raise TableError("--base", None, None, "it with relative elements", expected)
        if not math.isfinite(options.base) or options.base == 0 or (system is IndependentElements and options.base < 0):
            allowed = "a positive number" if system is IndependentElements else "a number other than 0"
            raise TableError("--base", None, None, repr(options.base), allowed)


def orient_all(pairs: list[Pair], keywords: dict[str, Any], progress: Callable[[int], None]) -> list[Orientation]:
    """Every pair oriented, in order, as NumPy values; padding of many pairs is left in place.

    `progress` is told the number of pairs finished so far.
    """
    if len(pairs) == 1:
        one = jax.tree.map(np.asarray, orient(pairs[0], **keywords))
        progress(1)
        return [one]
    from ..batch import orient_batch

    out: list[Any] = [None] * len(pairs)
    finished = 0
    for size, members in buckets([len(pair.x_left) for pair in pairs]).items():
        batch = _batch([pairs[i] for i in members], size)
        told = lambda done, total, before=finished: progress(before + done)
        solved = jax.tree.map(np.asarray, orient_batch(batch, progress=told, **keywords))
        for row, i in enumerate(members):
            out[i] = jax.tree.map(lambda a, row=row: a[row], solved)
        finished += len(members)
    return out


def buckets(lengths: list[int]) -> dict[int, list[int]]:
    """Indices of the pairs to be padded to each number of points, a power of two of at least 8.

    A few short pairs go along with longer ones: calculating with their padding is cheaper than compiling once more.
    """
    exact: dict[int, list[int]] = defaultdict(list)
    for i, length in enumerate(lengths):
        exact[max(8, 1 << (length - 1).bit_length())].append(i)
    out: dict[int, list[int]] = {}
    size = 0
    for own in sorted(exact, reverse=True):
        if not out or len(exact[own]) * size > CHEAP:
            size = own
        out.setdefault(size, []).extend(exact[own])
    return out


def _batch(pairs: list[Pair], size: int) -> Pair:
    """`jaxro.stack` padded to `size`, in NumPy: thousands of lengths, nothing to compile."""
    fitted = lambda field: np.pad(field, (0, size - len(field))) if field.ndim else field
    return jax.tree.map(lambda *fields: np.stack([fitted(field) for field in fields]), *pairs)


def _with_progress(errors, pairs: list[Pair], keywords: dict[str, Any]) -> list[Orientation]:
    """`orient_all` with a progress bar for many pairs, where somebody can see it."""
    if len(pairs) < 2 or not errors.is_terminal:
        return orient_all(pairs, keywords, lambda done: None)
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("Orienting"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=errors, transient=True) as bar:
        task = bar.add_task("", total=len(pairs))
        return orient_all(pairs, keywords, lambda done: bar.update(task, completed=done))


def _summary(
    options: Options, table: tables.Table, system: type[AbstractElements], solved: list[Solution]
) -> dict[str, Any]:
    from .. import __version__

    return {
        "program": f"jaxro {__version__}",
        "file": table.file,
        "elements": next(name for name, known in SYSTEMS.items() if known is system),
        "residual": options.residual,
        "base": options.base,
        "sigma": options.sigma,
        "usable": sum(s.usable for s in solved),
        "failed": sum(not s.usable for s in solved),
        "warnings": table.warnings,
    }


def _show(console, options: Options, solved: list[Solution], units: Units, system: type[AbstractElements]) -> None:
    from . import report

    name = next(name for name, known in SYSTEMS.items() if known is system)
    report.show(console, solved, units, f"{name} elements, {options.residual} residuals")
    if options.out is not None:
        written = "elements.csv, residuals.csv, points.csv, summary.json"
        console.print(f"Written to {options.out}: {written}", markup=False)
    if options.file is None:
        console.print("This was the embedded example. Your own pairs: jaxro orient FILE.csv --focal F", markup=False)
