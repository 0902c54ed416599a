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

Comments may stand anywhere. An entry that cannot be used, such as a view on a camera
without a focal length or a camera of nan (-1.#IND), is left out, and a warning counts
what was left out. Lines that are missing or cut stop the reading: what follows would be
taken for something else.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..tables.fields import TableError
from . import lens
from .lines import Lines, is_whole
from .matches import LEAST, Matches, Seen, Tracks, check_names, collect, is_focal

FORMAT = "# Bundle file"
VERSION = f"{FORMAT} v0.3"

MOST_WARNINGS = 12
"""Reasons to leave views out that are told of one file, the most frequent ones."""


class _Camera(NamedTuple):
    """A camera and its first line. `fault`: why it cannot be used, "" where it can."""

    line: int
    focal: float
    k1: float
    k2: float
    fault: str


class _Views(NamedTuple):
    """The views of all points, row by row, and their lines in the file."""

    point: list[int]
    camera: list[int]
    place: list[tuple[float, float]]
    line: list[int]


class _LeftOut:
    """What is left out of a file: of each thing and reason how many, and the line of
    the first."""

    def __init__(self, file: str):
        self._file = file
        self._found: dict[tuple[str, str], list[int]] = {}

    def add(self, thing: str, why: str, line: int) -> None:
        """Count a thing, "view", with the reason, "on camera 3, which ..."."""
        self._found.setdefault((thing, why), [0, line])[0] += 1

    @property
    def line(self) -> int | None:
        """The first line of what is left out most; None where nothing is."""
        return max(self._found.values(), default=[0, None])[1]

    def warnings(self) -> list[str]:
        """A sentence for each reason, the most frequent ones first."""
        most = sorted(self._found.items(), key=lambda entry: -entry[1][0])
        told = []
        for (thing, why), (count, line) in most[:MOST_WARNINGS]:
            things, are = (thing, "is") if count == 1 else (f"{thing}s", "are")
            where = f"line {line}" if count == 1 else f"first on line {line}"
            told.append(f"{count} {things} {why}, {are} left out ({where})")
        if rest := sum(count for _, (count, _) in most[MOST_WARNINGS:]):
            told.append(f"{rest} other entries are left out")
        return [f"{self._file}: {sentence}" for sentence in told]


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

    Warnings count the entries that are left out. Raises TableError for what is no such
    file, with line and field.
    """
    file = str(path)
    lines, left_out = Lines(Path(path)), _LeftOut(file)
    cameras, views, points = _parse(lines, left_out)
    names = [str(k) for k in range(len(cameras))] if photos is None else list(photos)
    if len(names) != len(cameras):
        raise TableError(
            file,
            found=f"{len(cameras)} cameras beside {len(names)} names of photos",
            expected="a name for each camera",
        )
    check_names(file, names)
    seen, there = _without_distortion(cameras, views, left_out)
    tracks, twice = Tracks(
        photo=np.array(views.camera, int)[there],
        point=np.array(views.point, int)[there],
        seen=seen.choose(there),
        photos=names,
        points=[str(k) for k in range(points)],
        focals=np.array([camera.focal for camera in cameras], float),
    ).once()
    warnings = left_out.warnings()
    if twice:
        warnings.append(
            f"{file}: {twice} times a photo shows a point at two places; both are left "
            "out"
        )
    pairs = tracks.pairs(least)
    if not pairs:
        why = f" ({warnings[0].removeprefix(f'{file}: ')})" if warnings else ""
        raise TableError(
            file,
            line=left_out.line,
            found=f"no two photos that share {least} points{why}",
            expected="a pair of photos with as many",
        )
    return collect(file, pairs, sigma, warnings)


def _parse(lines: Lines, left_out: _LeftOut) -> tuple[list[_Camera], _Views, int]:
    """Cameras, views, and how many points there are. Raises TableError."""
    _check_version(lines)
    what = "the numbers of cameras and points"
    counts = lines.fields(what)
    if len(counts) != 2:
        raise lines.error(f"{len(counts)} fields", what)
    number, points = (
        lines.whole(field, f"number of {things}")
        for field, things in zip(counts, ("cameras", "points"), strict=True)
    )
    cameras = [_parse_camera(lines, k, left_out) for k in range(number)]
    views = _Views([], [], [], [])
    for k in range(points):
        place = lines.numbers_of_line(f"point {k}", ("X", "Y", "Z"))
        line = lines.number
        lines.numbers_of_line(f"the colour of point {k}", ("red", "green", "blue"))
        fields = lines.fields(f"the views of point {k}: their number, and camera, key, x, "
                              "y of each")  # fmt: skip
        if np.all(np.isfinite(place)):
            _parse_views(lines, k, fields, cameras, views, left_out)
        else:
            left_out.add("point", "whose coordinates are no numbers", line)
    return cameras, views, points


def _check_version(lines: Lines) -> None:
    """Reads to the line with the version. Raises TableError where it is another one, or
    none stands before the first numbers."""
    line = lines.next_of_any()
    while line is not None:
        told = " ".join(line.split())
        if told == VERSION:
            return
        if told.startswith(FORMAT) or (told and not told.startswith("#")):
            raise lines.error(
                repr(told), f"the line {VERSION!r}; no other version is read"
            )
        line = lines.next_of_any()
    raise lines.error("the end of the file", VERSION)


def _parse_camera(lines: Lines, number: int, left_out: _LeftOut) -> _Camera:
    """A camera. Its rotation and place are looked at as numbers only."""
    what = f"camera {number}"
    focal, k1, k2 = lines.numbers_of_line(what, ("f", "k1", "k2"))
    line, numbers = lines.number, [focal, k1, k2]
    for row in ("first row of R", "second row of R", "third row of R", "t"):
        numbers += lines.numbers_of_line(f"{what}, {row}", ("x", "y", "z"))
    fault = ""
    if not np.all(np.isfinite(numbers)):
        fault = "whose numbers cannot be used"
        left_out.add("camera", fault, line)
    elif not focal > 0:
        # the usual entry of a photo that has found no place: told where it has views
        fault = "which has no focal length"
    elif not is_focal(focal):
        fault = f"whose focal length is {focal:g} pixels"
        left_out.add("camera", fault, line)
    return _Camera(line, focal, k1, k2, fault)


def _parse_views(
    lines: Lines,
    point: int,
    fields: list[str],
    cameras: list[_Camera],
    views: _Views,
    left_out: _LeftOut,
) -> None:
    """The line of views of a point: their number, and camera, key, x, y of each."""
    line, told = lines.number, fields[0] if fields else ""
    if not is_whole(told) or len(fields) != 1 + 4 * int(told):
        what = f"point {point}, views"
        lines.value(told, what)  # tells a comma
        why = "whose line of views has another number of fields than its first one says"
        left_out.add("point", why, line)
        return
    for k in range(1, len(fields), 4):
        number, _, *place = fields[k : k + 4]
        x, y = (
            lines.value(field, f"point {point}, place of a view") for field in place
        )
        if not is_whole(number) or not np.isfinite(x + y):
            left_out.add("view", "whose camera, x or y is no number", line)
            continue
        own = int(number)
        known = own < len(cameras)
        fault = cameras[own].fault if known else "which the file does not have"
        if fault:
            left_out.add("view", f"on camera {own}, {fault}", line)
            continue
        views.point.append(point)
        views.camera.append(own)
        views.place.append((x, y))
        views.line.append(line)


def _without_distortion(
    cameras: list[_Camera], views: _Views, left_out: _LeftOut
) -> tuple[Seen, Bool[np.ndarray, " row"]]:
    """The places in photo coordinates, and which of them a ray is seen at."""
    place = np.array(views.place, float).reshape(-1, 2)
    camera = np.array(views.camera, int)
    rays, slopes = np.zeros_like(place), np.zeros((len(place), 2, 2))
    there = np.zeros(len(place), bool)
    order = np.argsort(camera, kind="stable")
    numbers, begins = np.unique(camera[order], return_index=True)
    for number, rows in zip(numbers, np.split(order, begins[1:]), strict=False):
        own = cameras[number]
        coefficients = lens.check_coefficients((own.k1, own.k2))
        found = lens.undistort(place[rows] / own.focal, coefficients)
        rays[rows], slopes[rows] = found.rays * own.focal, found.slopes
        there[rows] = found.found
    cofactors: Float[np.ndarray, "row 2 2"] = slopes @ np.swapaxes(slopes, -1, -2)
    seen = Seen(rays[:, 0], rays[:, 1], cofactors)
    there &= seen.usable
    for row in np.flatnonzero(~there):
        own = cameras[camera[row]]
        why = (
            f"on camera {camera[row]}, whose distortion k1 = {own.k1:g}, k2 = "
            f"{own.k2:g} (line {own.line}) shows no ray there"
        )
        left_out.add("view", why, views.line[row])
    return seen, there
