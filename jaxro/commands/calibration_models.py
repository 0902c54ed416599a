"""Which models `jaxro calibrate` tries: --model, --zones, --zones-y, --fisheye."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..calibration import (
    AbstractZones,
    Brown,
    Model,
    Whole,
    default_models,
    models_of_cameras,
    perspective,
    rectangles,
    rings,
    stereographic,
    strips_along_x,
    strips_along_y,
)
from ..tables.fields import TableError
from ..tables.images import NamedImages

MODELS: dict[str, Callable[[Model], bool]] = {
    "one-f": lambda model: model == Model(),
    "two-f": lambda model: model == Model(y=Whole()),
    "brown": lambda model: model == Model(brown=Brown()),
    "lens": lambda model: model.brown is not None and model.field is None,
    "field": lambda model: model.field is not None and model.brown is None,
    "brown-field": lambda model: model.field is not None and model.brown is not None,
}
"""Which of the default models a name on the command line stands for; of several the
evidence chooses."""

DEGREES = ("constant", "linear", "quadratic", "cubic")

ZONES = (
    "rectangles:COLUMNSxROWS, strips-x:N, strips-y:N, rings:N or whole; N also as "
    "borders 0,1,3,4; then optionally :linear, :quadratic or :cubic"
)
"""How zones are written on the command line."""

CHOICE = 10
"""Degrees of freedom that the largest model leaves, from which on the evidence may choose
without standard deviations: with fewer a large model makes residuals vanish."""

OF_STATION = 6
"""Unknowns of an image beside those of its camera."""

Borders = int | list[float]


def select_models(
    model: str | None,
    zones: str | None,
    zones_y: str | None,
    *,
    fisheye: bool,
    together: bool,
) -> tuple[Model, ...]:
    """The models to choose among, of one image or of several `together`. Raises
    TableError."""
    every = models_of_cameras() if together else default_models()
    change: dict = {"rays": stereographic if fisheye else perspective}
    if model is None and zones is None and zones_y is None:
        return tuple(dataclasses.replace(m, **change) for m in every)
    if model is not None and model not in MODELS:
        expected = f"one of {', '.join(MODELS)}"
        raise TableError("--model", found=repr(model), expected=expected)
    fits = MODELS["one-f" if model is None else model]
    found = tuple(m for m in every if fits(m))
    if zones_y is not None and zones is None:
        raise TableError(
            "--zones-y",
            found="it without --zones",
            expected="--zones for the focal length along x beside it (whole: one)",
        )
    if zones is not None:
        change["x"] = parse_zones("--zones", zones)
    if zones_y is not None:
        change["y"] = parse_zones("--zones-y", zones_y)
    return tuple(dataclasses.replace(m, **change) for m in found)


def limit_choice(
    models: tuple[Model, ...], named: NamedImages, rows: np.ndarray
) -> tuple[Model, ...]:
    """The models that the places of these rows, adjusted together, can choose among
    where their standard deviations are not known: the simplest one where redundancy
    would not stop a larger one."""
    images, points = np.unique(named.image[rows]), np.unique(named.point[rows])
    of_camera = max(model.unknowns for model in models) - OF_STATION
    unknowns = (
        OF_STATION * len(images)
        + of_camera * len(np.unique(named.camera[images]))
        + 3 * np.count_nonzero(~named.known[points])
    )
    return models if 2 * len(rows) - unknowns >= CHOICE else models[:1]


def parse_zones(option: str, text: str) -> AbstractZones:
    """Zones such as rectangles:2x3 or strips-x:0,1,3,4:linear. Raises TableError."""
    kind, *rest = text.split(":")
    try:
        if kind == "whole" and not rest:
            return Whole()
        number, degree = rest[0], _degree(rest[1:])
        if kind == "rectangles":
            columns, rows = number.split("x")
            return rectangles(_borders(columns), _borders(rows), degree)
        if kind == "rings":
            return rings(_borders(number), degree)
        if kind in ("strips-x", "strips-y"):
            strips = strips_along_x if kind == "strips-x" else strips_along_y
            return strips(_borders(number), degree)
        raise ValueError
    except (ValueError, IndexError) as error:
        why = f": {error}" if str(error).startswith("pieces") else ""
        raise TableError(
            option, found=f"{text!r}{why.replace('pieces: ', '')}", expected=ZONES
        ) from None


def _borders(text: str) -> Borders:
    """A number of zones, or their borders."""
    return [float(part) for part in text.split(",")] if "," in text else int(text)


def _degree(rest: Sequence[str]) -> int:
    """The degree by its name; constant where there is none."""
    (name,) = rest or DEGREES[:1]
    return DEGREES.index(name)
