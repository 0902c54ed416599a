"""What a user asks for on the command line of `jaxro calibrate`, read and checked."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import calibration
from ..calibration import Known, Model
from ..tables import images as tables
from ..tables.examples import calibration as example
from ..tables.fields import TableError
from ..tables.images import NamedImages
from .calibration_models import limit_choice, select_models
from .documents import NO_DOCUMENTS, Documents


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    file: Path | None = None
    object: Path | None = None
    model: str | None = None
    zones: str | None = None
    zones_y: str | None = None
    fisheye: bool = False
    principal_point: tuple[float, float] | None = None
    principal_sigma: float | None = None
    focal: float | None = None
    focal_sigma: float | None = None
    sigma: float | None = None
    y_down: bool | None = None
    distances: bool = False
    own_cameras: bool = False
    separately: bool = False
    differences: tuple[str, ...] = ()
    refocused: bool = False
    correct: Path | None = None
    pairs: tuple[str, ...] = ()
    unit: str = "px"
    out: Path | None = None
    force: bool = False
    documents: Documents = NO_DOCUMENTS

    @property
    def read(self) -> tuple[Path | None, ...]:
        """The files that are read."""
        return self.file, self.object, self.correct


@dataclass(frozen=True)
class Task:
    """What is calibrated, read and checked. `models`: to choose among. `differences`:
    the images whose distortions are compared, two by two; `refocused`: whether a change
    of the focal length is taken out of them."""

    title: str
    named: NamedImages
    sigma: np.ndarray
    sigma_known: bool
    models: tuple[Model, ...]
    known: Known
    together: bool
    differences: list[tuple[str, str]]
    refocused: bool

    def limit_choice(self, rows: np.ndarray) -> tuple[Model, ...]:
        """The models that the places of these rows, adjusted together, can choose
        among."""
        if self.sigma_known:
            return self.models
        return limit_choice(self.models, self.named, rows)


def prepare(options: Options) -> Task:
    """Everything read and checked. Raises TableError."""
    check_options(options)
    title, named, other = _read(options)
    if options.sigma is not None and named.sigma is not None:
        raise TableError(
            "--sigma",
            found=f"it beside the column sigma of {named.file}",
            expected="only one of the two",
        )
    together = not (named.is_single or options.separately)
    if together:
        tables.check_seen(named)
    else:
        tables.check_known(named, other)
    if not named.is_single and options.distances:
        raise TableError(
            "--distances",
            found=f"{len(named.images)} images",
            expected="one image: distances know nothing of another one",
        )
    if options.own_cameras:
        named = replace(
            named, cameras=named.images, camera=np.arange(len(named.images))
        )
    models = select_models(
        options.model,
        options.zones,
        options.zones_y,
        fisheye=options.fisheye,
        together=together,
    )
    if together and any(model.imitated for model in models):
        raise TableError(
            "--zones",
            found="focal lengths that change linearly, for several images together",
            expected="constant zones, --model field, or --separately",
        )
    given = 1.0 if options.sigma is None else options.sigma
    sigma = np.full(len(named.image), given) if named.sigma is None else named.sigma
    return Task(
        title=title,
        named=named,
        sigma=sigma,
        sigma_known=options.sigma is not None or named.sigma is not None,
        models=models,
        known=_known(options),
        together=together,
        differences=_differences(options, named, together),
        refocused=options.refocused,
    )


def check_options(options: Options) -> None:
    """Raises TableError for numbers that cannot be, and options that do not go
    together."""
    for name, value in (("--sigma", options.sigma), ("--focal", options.focal)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise TableError(name, found=repr(value), expected="a positive number")
    for name, value, of in (
        ("--focal-sigma", options.focal_sigma, options.focal),
        ("--principal-sigma", options.principal_sigma, options.principal_point),
    ):
        if value is None:
            continue
        if of is None:
            option = name.replace("-sigma", "").replace("principal", "principal-point")
            raise TableError(name, found="it alone", expected=f"{option} with it")
        if not (math.isfinite(value) and value >= 0):
            raise TableError(name, found=repr(value), expected="0 or more")
    if options.principal_point and not all(map(math.isfinite, options.principal_point)):
        found = repr(options.principal_point)
        raise TableError("--principal-point", found=found, expected="two numbers")
    if options.own_cameras and options.separately:
        raise TableError(
            "--own-cameras",
            found="it beside --separately",
            expected="one of the two: cameras of their own, points in common or not",
        )
    if options.distances and (options.model not in (None, "one-f", "two-f")):
        raise TableError(
            "--distances",
            found=f"it with --model {options.model}",
            expected="focal lengths alone: one-f, two-f, --zones",
        )
    if options.refocused and not options.differences:
        raise TableError(
            "--refocused", found="it alone", expected="--difference LEFT,RIGHT with it"
        )
    for name, value in (("--correct", options.correct), ("--pair", options.pairs)):
        if value and options.out is None:
            raise TableError(name, found="it without --out", expected="--out DIR")


def _read(options: Options) -> tuple[str, NamedImages, str]:
    """The name of what is calibrated, the tables, and the name of that of the
    object."""
    if options.file is None:
        for name, value in (
            ("--object", options.object),
            ("--correct", options.correct),
        ):
            if value is not None:
                raise TableError(
                    name,
                    found="it without IMAGE.csv",
                    expected="the image that it belongs to",
                )
        measured = tables.places(example.IMAGE, example.NAME, example.NAME)
        known = tables.points(example.POINTS, example.NAME)
        return example.NAME, tables.assemble(measured, known), example.NAME
    if options.object is None:
        raise TableError(
            "--object",
            found="no table of the object points",
            expected="--object POINTS.csv with point,X,Y,Z",
        )
    measured = tables.read_places(options.file)
    known = tables.read_points(options.object)
    named = tables.assemble(measured, known)
    return str(options.file), named, str(options.object)


def _differences(
    options: Options, named: NamedImages, together: bool
) -> list[tuple[str, str]]:
    """The images of --difference, two by two. Raises TableError."""
    pairs = [two_images("--difference", text, named) for text in options.differences]
    if pairs and together:
        raise TableError(
            "--difference",
            found="it for images that are calibrated together",
            expected="--separately beside it: two calibrations that have nothing in "
            "common",
        )
    return pairs


def two_images(option: str, text: str, named: NamedImages) -> tuple[str, str]:
    """LEFT,RIGHT. Raises TableError."""
    if named.is_single:
        raise TableError(
            option,
            found=f"{text!r} for one image",
            expected="a table with several images, told apart by a column image",
        )
    left, _, right = (part.strip() for part in text.partition(","))
    if left == right or not {left, right} <= set(named.images):
        raise TableError(
            option,
            found=repr(text),
            expected=f"LEFT,RIGHT, two images of {named.file}: "
            f"{', '.join(named.images)}",
        )
    return left, right


def _known(options: Options) -> Known:
    return calibration.known(
        principal=options.principal_point,
        principal_sigma=options.principal_sigma or 0.0,
        focal=options.focal,
        focal_sigma=options.focal_sigma or 0.0,
    )
