"""What a user asks for on the command line of `jaxro orient` and `jaxro clean`, checked:
other commands read cameras and numbers as these do."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    IndependentElements,
    RelativePose,
)
from ..geometry.pairs import Camera
from ..reports.columns import Units
from ..tables import cameras as camera_files, csv as csv_tables, whole
from ..tables.examples import pair as example
from ..tables.fields import TableError
from ..tables.measured import Table
from . import places, sigma as deviation
from .documents import NO_DOCUMENTS, Documents

SYSTEMS: dict[str, type[AbstractElements]] = {
    "relative": RelativePose,
    "dependent": DependentElements,
    "independent": IndependentElements,
}
"""Systems of elements by the names of the command line."""


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
    documents: Documents = NO_DOCUMENTS
    g2o: Path | None = None

    @property
    def read(self) -> tuple[Path | None, ...]:
        """The files that are read."""
        return self.file, self.camera


class Example(NamedTuple):
    """What is worked on where the user names no file."""

    name: str
    focal: float
    table: str


MEASURED = Example(example.NAME, example.FOCAL, example.TABLE)


def read_table(options: Options) -> Table:
    """All pairs of a table together, CSV or Parquet. Raises TableError."""
    assert options.file is not None
    if places.are_in(options.file):
        return places.read(options.file, one_camera=options.camera is None)
    if not whole.is_parquet(options.file):
        return csv_tables.read(options.file)
    from ..tables import parquet

    return parquet.read_whole(options.file)


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


def read_cameras(
    options: Options, otherwise: Example, *, may_be_named: bool = False
) -> camera_files.Cameras:
    """The cameras of --camera, or the one of the single options; `may_be_named`: by
    names that a column of the table has. Raises TableError."""
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
        found = camera_files.read(options.camera)
        if found.named and not may_be_named:
            raise TableError(
                found.file,
                found="cameras by names of their own",
                expected="[photo.NAME] for every photo: only jaxro block, from a table "
                "photo,point,x,y,camera, knows which camera took which photo",
            )
        return found
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
        deviation.parse(options.sigma)
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
