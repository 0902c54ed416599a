"""One call of `jaxro orient` from its options to its reports, and what other commands
share with it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from ..batches.batch import orient_batch
from ..batches.buckets import each
from ..batches.table_noise import TableNoise
from ..geometry import coplanarity
from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    IndependentElements,
    RelativePose,
)
from ..geometry.pairs import Camera, Pair
from ..orientation.orient import orient
from ..orientation.result import Orientation
from ..reports import files, pair as report, reliability as reading, solutions
from ..reports.solutions import Solution, Solved, Units
from ..reports.terminal import consoles, progress
from ..tables import cameras as camera_files, csv as tables, whole
from ..tables.examples import pair as example
from ..tables.fields import TableError
from . import sigma as deviation

SYSTEMS: dict[str, type[AbstractElements]] = {
    "relative": RelativePose,
    "dependent": DependentElements,
    "independent": IndependentElements,
}
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
    sigma: deviation.Sigma = None
    elements: str | None = None
    base: float | None = None
    residual: str = "rigorous"
    unit: str = "mm"
    out: Path | None = None
    force: bool = False
    confidence: float | None = None

    def at_level(self, confidence: float | None) -> "Options":
        """The same with intervals of this probability."""
        return replace(self, confidence=confidence)


class Example(NamedTuple):
    """What is worked on where the user names no file."""

    name: str
    focal: float
    table: str


MEASURED = Example(example.NAME, example.FOCAL, example.TABLE)


@dataclass(frozen=True)
class Job:
    """What a command works on, read and checked."""

    options: Options
    table: tables.Table
    cameras: list[tuple[Camera, Camera]]
    pairs: list[Pair]
    system: type[AbstractElements]
    units: Units
    noise: TableNoise | None = None

    @property
    def keywords(self) -> dict[str, Any]:
        """The options of `jaxro.orient` and `jaxro.orient_batch`."""
        return {
            "elements": self.system,
            "base": self.options.base,
            "residual": RESIDUALS[self.options.residual],
        }

    @property
    def sigma_known(self) -> bool:
        """Whether the standard deviation of the coordinates is given."""
        return self.table.has_sigma or self.options.sigma is not None

    @property
    def interval(self) -> solutions.Interval | None:
        """The intervals that were asked for."""
        confidence = self.options.confidence
        return (
            None
            if confidence is None
            else solutions.Interval(confidence, self.sigma_known)
        )

    def read(self, orientation: Orientation, pair: Pair) -> Solved:
        """The orientation with what is told of its points; of a batch as well."""
        return solutions.read(
            orientation, pair, self.options.residual == "rigorous", self.sigma_known
        )

    @property
    def system_name(self) -> str:
        """The system by its name on the command line."""
        return next(name for name, known in SYSTEMS.items() if known is self.system)

    def summary(self, solved: list[Solution]) -> dict[str, Any]:
        """What summary.json says of all pairs together."""
        from .. import __version__

        return {
            "program": f"jaxro {__version__}",
            "file": self.table.file,
            "elements": self.system_name,
            "residual": self.options.residual,
            "base": self.options.base,
            "sigma": self.options.sigma,
            **deviation.entry(self.noise),
            **(
                {}
                if self.interval is None
                else {"confidence": self.interval.confidence}
            ),
            "usable": sum(s.usable for s in solved),
            "failed": sum(not s.usable for s in solved),
            "warnings": self.table.warnings,
        }


def prepared(options: Options, otherwise: Example = MEASURED) -> Job:
    """Everything read and checked, the target of --out as well. Raises TableError."""
    if options.out is not None:
        whole.check_target(options.out, options.force)
    system = SYSTEMS[options.elements or ("relative" if options.file else "dependent")]
    table = read_table(options, otherwise)
    known = read_cameras(options, otherwise)
    cameras = [
        known.of(measured.name, table.file, measured.lines[0])
        for measured in table.pairs
    ]
    check_numbers(options, table.has_sigma, table.file, system)

    def pairs_with(sigma: float | None) -> list[Pair]:
        each = zip(table.pairs, cameras, strict=True)
        return [
            camera_files.to_pair(measured, table.file, *both, sigma)
            for measured, both in each
        ]

    noise = (
        deviation.from_residuals(pairs_with(1.0))
        if options.sigma == deviation.AUTO
        else None
    )
    sigma = deviation.stated(options.sigma) if noise is None else noise.sigma
    units = units_of(options, table.has_sigma, system)
    return Job(
        replace(options, sigma=sigma),
        table,
        cameras,
        pairs_with(sigma),
        system,
        units,
        noise,
    )


def units_of(
    options: Options, has_sigma: bool, system: type[AbstractElements]
) -> Units:
    """The units of all that is reported."""
    return Units(
        photo=options.unit,
        model="bases"
        if system is RelativePose
        else options.unit
        if options.base is None
        else "base_units",
        sigma0="" if has_sigma or options.sigma is not None else options.unit,
    )


def run(options: Options) -> bool:
    """Read, orient, show, write. True if every pair is usable. Raises TableError, with
    nothing written."""
    job = prepared(options)
    console, errors = consoles()
    warn(errors, job)
    with progress(errors, "Orienting", len(job.pairs)) as told:
        oriented = orient_all(job, told)
    solved = solutions.solutions(
        job.table.pairs, job.cameras, oriented, job.units, job.interval
    )
    texts = (
        {}
        if options.out is None
        else files.texts(solved, job.units, job.summary(solved))
    )
    show_sigma(console, job)
    show(console, job, solved)
    write(job, texts)
    tell(console, job, texts)
    if options.file is None:
        console.print(
            "This was the embedded example. Your own pairs: jaxro orient FILE.csv "
            "--focal F",
            markup=False,
        )
    return all(s.usable for s in solved)


def warn(errors: Console, job: Job) -> None:
    """What a careful reader of the table should be told."""
    for warning in job.table.warnings:
        errors.print(f"Warning: {warning}", style="yellow", markup=False)


def write(job: Job, texts: dict[str, str]) -> None:
    """The files of --out, if it was asked for. Raises TableError."""
    if job.options.out is not None:
        whole.write(job.options.out, texts, (job.options.file, job.options.camera))


def tell(console: Console, job: Job, texts: dict[str, str]) -> None:
    """Where the files are."""
    if job.options.out is not None:
        console.print(f"Written to {job.options.out}: {', '.join(texts)}", markup=False)


def show_sigma(console: Console, job: Job) -> None:
    """The standard deviation that was taken, where it was not given."""
    if job.noise is not None:
        plain = all(camera.pixel_size == 1 for both in job.cameras for camera in both)
        unit = job.units.photo if plain else "in the unit of the table"
        console.print(deviation.sentence(job.noise, unit), markup=False)


def show(console: Console, job: Job, solved: list[Solution]) -> None:
    """The orientations on the terminal."""
    report.show(
        console,
        solved,
        job.units,
        f"{job.system_name} elements, {job.options.residual} residuals",
    )
    if len(solved) == 1:
        reading.show(console, solved[0], job.units)
    else:
        reading.show_of_all(console, solved, job.units)


def read_table(options: Options, otherwise: Example) -> tables.Table:
    """The pairs of the file, or the example."""
    if options.file is None:
        return tables.parse(otherwise.table, otherwise.name, otherwise.name)
    return tables.read(options.file)


def read_cameras(options: Options, otherwise: Example) -> camera_files.Cameras:
    """The cameras of --camera, or the one of the single options."""
    single = {
        "--focal": options.focal,
        "--principal-point": options.principal_point,
        "--pixel-size": options.pixel_size,
        "--y-down": options.y_down or None,
    }
    if options.camera is not None:
        for name, value in single.items():
            if value is not None:
                raise TableError(
                    name,
                    found="it beside --camera",
                    expected=f"this entry in {options.camera} instead",
                )
        return camera_files.read(options.camera)
    focal = (
        otherwise.focal
        if options.file is None and options.focal is None
        else options.focal
    )
    if focal is None:
        expected = (
            f"the focal length of the photos, --focal {otherwise.focal} or --camera "
            "camera.toml"
        )
        raise TableError(
            "--focal", found="neither --focal nor --camera", expected=expected
        )
    for name, value in (("--focal", focal), ("--pixel-size", options.pixel_size)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise TableError(name, found=repr(value), expected="a positive number")
    centre = options.principal_point or (0.0, 0.0)
    if not all(map(math.isfinite, centre)):
        raise TableError(
            "--principal-point", found=repr(centre), expected="two numbers"
        )
    pixel_size = 1.0 if options.pixel_size is None else options.pixel_size
    one = Camera(focal, centre, pixel_size, options.y_down)
    return camera_files.Cameras("--focal", one, one)


def check_numbers(
    options: Options, has_sigma: bool, file: str, system: type[AbstractElements]
) -> None:
    """Raises TableError for a sigma, base or unit that cannot be."""
    if not options.unit.strip() or any(mark in options.unit for mark in "[]\n"):
        raise TableError(
            "--unit",
            found=repr(options.unit),
            expected="a name such as mm or px, without brackets",
        )
    if options.confidence is not None and not 0 < options.confidence < 1:
        raise TableError(
            "--confidence",
            found=repr(options.confidence),
            expected="a probability such as 0.95",
        )
    if options.sigma is not None:
        if has_sigma:
            raise TableError(
                "--sigma",
                found=f"it beside the column sigma of {file}",
                expected="only one of the two",
            )
        deviation.stated(options.sigma)
    if options.base is not None:
        if system is RelativePose:
            expected = (
                "--elements dependent or independent with it; the relative system has "
                "the base 1"
            )
            raise TableError(
                "--base", found="it with relative elements", expected=expected
            )
        if (
            not math.isfinite(options.base)
            or options.base == 0
            or (system is IndependentElements and options.base < 0)
        ):
            allowed = (
                "a positive number"
                if system is IndependentElements
                else "a number other than 0"
            )
            raise TableError("--base", found=repr(options.base), expected=allowed)


def orient_all(job: Job, progress: Callable[[int], None]) -> list[Solved]:
    """Every pair oriented, in order, as NumPy values; padding of many pairs is left in
    place.

    `progress` is told the number of pairs finished so far.
    """
    found = each(
        job.pairs,
        lambda pair: job.read(orient(pair, **job.keywords), pair),
        lambda batch, told: job.read(
            orient_batch(batch, progress=told, **job.keywords), batch
        ),
        progress,
    )
    return [one for _, one in sorted(found, key=lambda entry: entry[0])]
