"""Bundler's `.out` (version 0.3; also what VisualSFM, GTSAM's examples and others write):
cameras with a focal length and two coefficients of distortion, and points with the
photos that show them.

    # Bundle file v0.3
    <cameras> <points>
    <f> <k1> <k2>           of each camera, then three lines of its rotation and one of t
    <X> <Y> <Z>             of each point, then its colour, and the line of its views:
    <views> <camera> <key> <x> <y> ...

A camera looks along -z with y up, as a photo does here: of P = R X + t

    p = -P / Pz,    (x, y) = f (1 + k1 |p|² + k2 |p|⁴) p

in pixels from the centre of the photo. The photo coordinates are f p.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..tables.fields import TableError, read_text
from . import lens
from .matches import LEAST, Matches, Seen, Tracks, collect

VERSION = "# Bundle file v0.3"


class _Camera(NamedTuple):
    line: int
    focal: float
    k1: float
    k2: float


class _Views(NamedTuple):
    """The views of all points, row by row, and their lines in the file."""

    point: list[int]
    camera: list[int]
    place: list[tuple[float, float]]
    line: list[int]


def read_bundler(
    path: str | Path,
    *,
    sigma: float | None = None,
    least: int = LEAST,
    photos: Sequence[str] | None = None,
) -> Matches:
    """The pairs of photos that share at least `least` points, without radial
    distortion. `sigma`: the standard deviation of a pixel coordinate. `photos`: their
    names in the order of the cameras; without them their numbers 0, 1, ...

    Raises TableError for what is no such file, with line and field; and for a place
    that the distortion of its camera cannot make.
    """
    file = str(path)
    lines = _Lines(file, read_text(Path(path)))
    cameras, views, points = _parse(lines)
    names = [str(k) for k in range(len(cameras))] if photos is None else list(photos)
    if len(names) != len(cameras):
        raise TableError(
            file,
            found=f"{len(cameras)} cameras beside {len(names)} names of photos",
            expected="a name for each camera",
        )
    tracks, twice = Tracks(
        photo=np.array(views.camera, int),
        point=np.array(views.point, int),
        seen=_without_distortion(file, cameras, views),
        photos=names,
        points=[str(k) for k in range(points)],
        focals=np.array([camera.focal for camera in cameras], float),
    ).once()
    warnings = []
    if twice:
        warnings.append(
            f"{file}: {twice} times a photo shows a point at two places; both are left "
            "out"
        )
    pairs = tracks.pairs(least)
    if not pairs:
        raise TableError(
            file,
            found=f"no two photos that share {least} points",
            expected="a pair of photos with as many",
        )
    return collect(file, pairs, sigma, warnings)


class _Lines:
    """The lines of a file, one behind the other."""

    def __init__(self, file: str, text: str):
        self.file, self._lines, self.number = file, text.splitlines(), 0

    def next(self, what: str) -> list[str]:
        """The fields of the next line that is not blank. Raises TableError at the end
        of the file; `what`: it was to hold."""
        while self.number < len(self._lines):
            self.number += 1
            fields = self._lines[self.number - 1].split()
            if fields:
                return fields
        raise self.error("the end of the file", what, line=self.number + 1)

    def numbers(self, what: str, names: Sequence[str]) -> list[float]:
        """A line of so many numbers with these names. Raises TableError."""
        fields = self.next(f"{what}: {' '.join(names)}")
        if len(fields) != len(names):
            found = f"{len(fields)} fields for {what}"
            raise self.error(found, f"{len(names)}: {' '.join(names)}")
        return [
            self.number_of(field, f"{what}, {name}")
            for field, name in zip(fields, names, strict=True)
        ]

    def number_of(self, field: str, what: str, whole: bool = False) -> float:
        """A finite number, or a whole one that is not negative. Raises TableError."""
        try:
            value = float(field)
        except ValueError:
            value = np.nan
        if whole and not (value >= 0 and value == int(value)):
            raise self.error(repr(field), "a whole number such as 12", what)
        if not np.isfinite(value):
            raise self.error(repr(field), "a finite number such as -12.345", what)
        return value

    def error(
        self,
        found: str,
        expected: str,
        column: str | None = None,
        line: int | None = None,
    ) -> TableError:
        """The error at this line."""
        line = self.number if line is None else line
        return TableError(
            self.file, line=line, column=column, found=found, expected=expected
        )


def _parse(lines: _Lines) -> tuple[list[_Camera], _Views, int]:
    """Cameras, views, and how many points there are. Raises TableError."""
    first = " ".join(lines.next(VERSION))
    if first != VERSION:
        raise lines.error(
            repr(first), f"the line {VERSION!r}; no other version is read"
        )
    counts = lines.next("the numbers of cameras and points")
    if len(counts) != 2:
        raise lines.error(f"{len(counts)} fields", "the numbers of cameras and points")
    number, points = (
        int(lines.number_of(field, f"number of {what}", whole=True))
        for field, what in zip(counts, ("cameras", "points"), strict=True)
    )
    cameras = [_parse_camera(lines, k) for k in range(number)]
    views = _Views([], [], [], [])
    for k in range(points):
        lines.numbers(f"point {k}", ("X", "Y", "Z"))
        lines.next(f"the colour of point {k}")
        _parse_views(lines, k, cameras, views)
    return cameras, views, points


def _parse_camera(lines: _Lines, number: int) -> _Camera:
    """A camera. Its rotation and place are looked at as numbers only."""
    what = f"camera {number}"
    focal, k1, k2 = lines.numbers(what, ("f", "k1", "k2"))
    line = lines.number
    for row in ("first row of R", "second row of R", "third row of R", "t"):
        lines.numbers(f"{what}, {row}", ("x", "y", "z"))
    return _Camera(line, focal, k1, k2)


def _parse_views(
    lines: _Lines, point: int, cameras: list[_Camera], views: _Views
) -> None:
    """The line of views of a point."""
    what = f"the views of point {point}"
    fields = lines.next(f"{what}: their number, and camera, key, x, y of each")
    count = int(lines.number_of(fields[0], f"number of {what}", whole=True))
    if len(fields) != 1 + 4 * count:
        found = f"{len(fields)} fields for {what}, which are {count}"
        raise lines.error(
            found, f"{1 + 4 * count}: {count}, and camera, key, x, y of each"
        )
    for k in range(count):
        camera, _, x, y = fields[1 + 4 * k : 5 + 4 * k]
        own = int(lines.number_of(camera, f"view {k} of point {point}, camera", True))
        if own >= len(cameras):
            raise lines.error(
                f"camera {own}",
                f"one of the {len(cameras)} from 0",
                f"view {k}, camera",
            )
        if not cameras[own].focal > 0:
            raise lines.error(
                f"camera {own}, whose focal length on line {cameras[own].line} is "
                f"{cameras[own].focal:g}",
                "views on cameras with a focal length only",
                f"view {k}, camera",
            )
        what = f"view {k} of point {point}"
        place = lines.number_of(x, f"{what}, x"), lines.number_of(y, f"{what}, y")
        views.point.append(point)
        views.camera.append(own)
        views.place.append(place)
        views.line.append(lines.number)


def _without_distortion(file: str, cameras: list[_Camera], views: _Views) -> Seen:
    """The places in photo coordinates. Raises TableError for one that cannot be."""
    place = np.array(views.place, float).reshape(-1, 2)
    camera = np.array(views.camera, int)
    rays, slopes = np.zeros_like(place), np.zeros((len(place), 2, 2))
    for number, own in enumerate(cameras):
        rows = np.flatnonzero(camera == number)
        if not len(rows):
            continue
        coefficients = lens.check_coefficients((own.k1, own.k2))
        found = lens.undistort(place[rows] / own.focal, coefficients)
        if not np.all(found.found):
            row = rows[int(np.argmax(~found.found))]
            x, y = place[row]
            raise TableError(
                file,
                line=views.line[row],
                column=f"x y of camera {number}",
                found=f"({x:g}, {y:g}), where the distortion k1 = {own.k1:g}, "
                f"k2 = {own.k2:g} of line {own.line} shows no ray",
                expected="places that the distortion reaches; delete this view, or "
                "write the file without distortion",
            )
        rays[rows], slopes[rows] = found.rays * own.focal, found.slopes
    cofactors: Float[np.ndarray, "row 2 2"] = slopes @ np.swapaxes(slopes, -1, -2)
    return Seen(rays[:, 0], rays[:, 1], cofactors)
