"""HDF5 files of pairs, as benchmarks of relative pose have them (PoseLib's `posebench`):
a group for each pair with

    x1, x2               (point, 2) pixels of the matches on both photos
    camera1, camera2     a group with model, width, height and params, the model and the
                         order of params being COLMAP's; or a 3 x 3 matrix K

Whatever else a group holds (R, t, ...) is not read. Links lead within the file only.
Needs the extra `h5`; of cameras with distortion also `colmap`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..tables.fields import TableError
from . import colmap_cameras, pixels
from .hdf5 import Entries
from .matches import FARTHEST, LEAST, Match, Matches, Seen, collect, is_focal

PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
"""Models without distortion, and how many parameters they have."""


def read_h5(path: str | Path, *, sigma: float | None = None) -> Matches:
    """All pairs of a file, in the order of their names. `sigma`: the standard deviation
    of a pixel coordinate. Raises TableError for what is no such file, with the place in
    it.

    The photos are those of the pair alone, NAME:1 and NAME:2, and its points have names
    of their own: such a file does not say which points of two pairs are one.
    """
    warnings: list[str] = []
    with Entries(path) as entries:
        pairs = [
            _read_pair(entries, number, name, warnings)
            for number, name in enumerate(entries.names(entries.root, None), 1)
        ]
    if not pairs:
        raise TableError(path, found="no groups", expected="a group for each pair")
    return collect(str(path), pairs, sigma, warnings)


def _read_pair(entries: Entries, number: int, name: str, warnings: list[str]) -> Match:
    """One pair. Raises TableError."""
    group = entries.find(entries.root, name, name)
    expected = "x1, x2, camera1 and camera2 in the group of each pair"
    parts = [
        _find(entries, group, name, part, expected)
        for part in ("x1", "x2", "camera1", "camera2")
    ]
    places = [
        _read_pixels(entries, part, f"{name}/x{k}")
        for k, part in enumerate(parts[:2], 1)
    ]
    if len(places[0]) != len(places[1]):
        raise entries.error(
            f"{name}/x2",
            f"{len(places[1])} points beside {len(places[0])} in x1",
            "both points of each match in the same row",
        )
    both = [
        _see(entries, part, f"{name}/camera{k}", places[k - 1])
        for k, part in enumerate(parts[2:], 1)
    ]
    (left, focal_left, first), (right, focal_right, second) = both
    seen = first & second
    if not np.all(seen):
        warnings.append(
            f"{entries.path}: in pair {name!r} {int(np.sum(~seen))} of {len(seen)} "
            "matches are left out, which the lens of a photo cannot have seen"
        )
    if np.sum(seen) < LEAST:
        warnings.append(
            f"{entries.path}: pair {name!r} has {int(np.sum(seen))} matches only"
        )
    return Match(
        name=name,
        photos=(f"{name}:1", f"{name}:2"),
        points=[f"{number}.{row + 1}" for row in np.flatnonzero(seen)],
        left=left.choose(seen),
        right=right.choose(seen),
        focals=(focal_left, focal_right),
    )


def _find(entries: Entries, group: Any, place: str, name: str, expected: str) -> Any:
    """An entry of a group. Raises TableError where there is none."""
    is_group = hasattr(group, "keys")
    found = entries.find(group, name, f"{place}/{name}") if is_group else None
    if found is None:
        holds = ", ".join(entries.names(group, place)) if is_group else "numbers"
        raise entries.error(
            f"{place}/{name}", f"no such entry, but {holds or 'nothing'}", expected
        )
    return found


def _read_pixels(entries: Entries, entry: Any, place: str) -> pixels.Pixels:
    """(point, 2) numbers. Raises TableError."""
    shape = getattr(entry, "shape", None)
    if shape is None or len(shape) != 2 or shape[1] != 2:
        found = "a group" if shape is None else f"shape {shape} of type {entry.dtype}"
        raise entries.error(place, found, "numbers of shape (point, 2)")
    return entries.numbers(entry, place)


def _see(
    entries: Entries, entry: Any, place: str, places: pixels.Pixels
) -> tuple[Seen, float, np.ndarray]:
    """The points in photo coordinates, the focal length, and which of them there are.
    Raises TableError for a camera that is none."""
    try:
        if not hasattr(entry, "keys"):
            matrix = entries.numbers(entry, place)
        else:
            model = _read_text(entries, entry, place, "model")
            params = _read_numbers(entries, entry, place, "params")
            if model not in PINHOLES:
                camera = colmap_cameras.make_camera(
                    colmap_cameras.model_of_name(model),
                    _read_size(entries, entry, place, "width"),
                    _read_size(entries, entry, place, "height"),
                    params,
                )
                return colmap_cameras.see_by(camera, places)
            matrix = _pinhole(entries, f"{place}/params", model, params)
        return _see_by_matrix(places, matrix)
    except TableError:
        raise
    except ValueError as error:
        found = str(error).removeprefix("pair_from_pixels: ")
        expected = (
            "a group with a camera model of COLMAP and its params, or a matrix K of shape "
            "(3, 3)"
        )
        raise entries.error(place, found, expected) from None


def _pinhole(
    entries: Entries, place: str, model: str, params: np.ndarray
) -> np.ndarray:
    """K of a camera without distortion. Raises TableError."""
    wanted = PINHOLES[model]
    if len(params) != wanted:
        raise entries.error(place, f"{len(params)} numbers", f"{wanted} for {model}")
    fx, fy, cx, cy = (params[0], *params) if wanted == 3 else params
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _see_by_matrix(
    places: pixels.Pixels, matrix: np.ndarray
) -> tuple[Seen, float, np.ndarray]:
    """The points of a photo with this K. Raises ValueError where it is none."""
    k = pixels.check_matrix(matrix, "left")
    if not (is_focal(k[0, 0]) and is_focal(k[1, 1]) and np.all(np.abs(k) <= FARTHEST)):
        raise ValueError(f"K = {k.tolist()}, which no camera has")
    near = np.all(np.abs(places) <= FARTHEST, axis=1)
    points = pixels.to_photo(np.where(near[:, None], places, 0.0), k)
    cofactors = points.covariances(np.broadcast_to(np.eye(2), (len(places), 2, 2)))
    seen = Seen(points.x, points.y, cofactors)
    return seen, points.focal, near & seen.usable


def _read_value(entries: Entries, group: Any, place: str, key: str) -> Any:
    """The values of an entry or attribute of a camera, None where there is none."""
    found = entries.find(group, key, f"{place}/{key}")
    if found is not None:
        return entries.values(found, f"{place}/{key}")
    return entries.attribute(group, key, f"{place}/{key}")


def _read_numbers(entries: Entries, group: Any, place: str, key: str) -> np.ndarray:
    """Numbers of a camera in one row. Raises TableError where there are none."""
    value = _read_value(entries, group, place, key)
    if value is None:
        holds = ", ".join(entries.names(group, place)) or "nothing"
        found = f"no such entry, but {holds}"
        raise entries.error(f"{place}/{key}", found, "model, width, height and params")
    numbers = np.ravel(np.asarray(value))
    if numbers.dtype.kind not in "fiu":
        found = f"values of type {numbers.dtype}"
        raise entries.error(f"{place}/{key}", found, "numbers")
    return numbers.astype(float)


def _read_size(entries: Entries, group: Any, place: str, key: str) -> int:
    """Width or height of a photo, 0 where it is not told. Raises TableError."""
    if _read_value(entries, group, place, key) is None:
        return 0
    numbers = _read_numbers(entries, group, place, key)
    if len(numbers) != 1 or not 0 <= numbers[0] <= colmap_cameras.LARGEST:
        found = f"{numbers[:3].tolist()}"
        raise entries.error(f"{place}/{key}", found, "a number of pixels")
    return int(numbers[0])


def _read_text(entries: Entries, group: Any, place: str, key: str) -> str:
    """A name in a camera. Raises TableError where there is none."""
    value = _read_value(entries, group, place, key)
    texts = np.ravel(np.asarray(value, object))
    text = texts[0] if len(texts) == 1 else None
    if isinstance(text, bytes):
        text = text.decode(errors="backslashreplace")
    if not isinstance(text, str):
        holds = ", ".join(entries.names(group, place)) or "nothing"
        found = f"no such entry, but {holds}" if value is None else "no text"
        raise entries.error(f"{place}/{key}", found, "model, width, height and params")
    return text
