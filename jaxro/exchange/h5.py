"""HDF5 files of pairs, as benchmarks of relative pose have them (PoseLib's `posebench`):
a group for each pair with

    x1, x2               (point, 2) pixels of the matches on both photos
    camera1, camera2     a group with model, width, height and params, the model and the
                         order of params being COLMAP's; or a 3 x 3 matrix K

Whatever else a group holds (R, t, ...) is not read. Needs the extra `h5`; of cameras
with distortion also `colmap`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..tables.fields import TableError
from . import colmap_cameras, pixels
from .matches import LEAST, Match, Matches, Seen, collect

PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
"""Models without distortion, and how many parameters they have."""


def read_h5(path: str | Path, *, sigma: float | None = None) -> Matches:
    """All pairs of a file, in the order of their names. `sigma`: the standard deviation
    of a pixel coordinate. Raises TableError for what is no such file, with the place in
    it.

    The photos are those of the pair alone, NAME:1 and NAME:2, and its points have names
    of their own: such a file does not say which points of two pairs are one.
    """
    try:
        import h5py
    except ModuleNotFoundError:
        raise SystemExit("HDF5 files need h5py: pip install 'jaxro[h5]'") from None
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        found = f"no HDF5 file that can be read ({str(error).splitlines()[0]})"
        expected = "a file with a group for each pair"
        raise TableError(path, found=found, expected=expected) from None
    warnings: list[str] = []
    with file:
        pairs = [
            _read_pair(path, number, name, group, warnings)
            for number, (name, group) in enumerate(file.items(), 1)
        ]
    if not pairs:
        raise TableError(path, found="no groups", expected="a group for each pair")
    return collect(str(path), pairs, sigma, warnings)


def _read_pair(
    path: str | Path, number: int, name: str, group: Any, warnings: list[str]
) -> Match:
    """One pair. Raises TableError."""
    for entry in ("x1", "x2", "camera1", "camera2"):
        if not hasattr(group, "keys") or entry not in group:
            holds = ", ".join(group) if hasattr(group, "keys") else "numbers"
            raise TableError(
                path,
                column=f"{name}/{entry}",
                found=f"no such entry, but {holds or 'nothing'}",
                expected="x1, x2, camera1 and camera2 in the group of each pair",
            )
    places = [_read_pixels(path, f"{name}/{x}", group[x]) for x in ("x1", "x2")]
    if len(places[0]) != len(places[1]):
        raise TableError(
            path,
            column=f"{name}/x2",
            found=f"{len(places[1])} points beside {len(places[0])} in x1",
            expected="both points of each match in the same row",
        )
    both = [
        _see(path, f"{name}/{camera}", group[camera], pixels)
        for camera, pixels in zip(("camera1", "camera2"), places, strict=True)
    ]
    (left, focal_left, first), (right, focal_right, second) = both
    seen = first & second
    if not np.all(seen):
        warnings.append(
            f"{path}: in pair {name!r} {int(np.sum(~seen))} of {len(seen)} matches are "
            "left out, which the lens of a photo cannot have seen"
        )
    if np.sum(seen) < LEAST:
        warnings.append(f"{path}: pair {name!r} has {int(np.sum(seen))} matches only")
    return Match(
        name=name,
        photos=(f"{name}:1", f"{name}:2"),
        points=[f"{number}.{row + 1}" for row in np.flatnonzero(seen)],
        left=left.choose(seen),
        right=right.choose(seen),
        focals=(focal_left, focal_right),
    )


def _read_pixels(path: str | Path, place: str, entry: Any) -> pixels.Pixels:
    """(point, 2) numbers. Raises TableError."""
    shape = getattr(entry, "shape", None)
    if (
        shape is None
        or len(shape) != 2
        or shape[1] != 2
        or entry.dtype.kind not in "fiu"
    ):
        found = "a group" if shape is None else f"shape {shape} of type {entry.dtype}"
        raise TableError(
            path, column=place, found=found, expected="numbers of shape (point, 2)"
        )
    return np.asarray(entry[:], float)


def _see(
    path: str | Path, place: str, entry: Any, places: pixels.Pixels
) -> tuple[Seen, float, np.ndarray]:
    """The points in photo coordinates, the focal length, and which of them there are.
    Raises TableError for a camera that is none."""
    if hasattr(entry, "keys"):
        camera = {
            key: _read_value(path, place, entry, key) for key in ("model", "params")
        }
        sizes = [
            int(_read_value(path, place, entry, key)) if key in entry else 0
            for key in ("width", "height")
        ]
        params = np.ravel(camera["params"])
        if camera["model"] not in PINHOLES:
            try:
                return colmap_cameras.see(camera["model"], *sizes, params, places)
            except ValueError as error:
                expected = "a camera model of COLMAP with its parameters"
                raise TableError(
                    path, column=place, found=str(error), expected=expected
                ) from None
        wanted = PINHOLES[camera["model"]]
        if len(params) != wanted:
            raise TableError(
                path,
                column=f"{place}/params",
                found=f"{len(params)} numbers",
                expected=f"{wanted} for {camera['model']}",
            )
        fx, fy, cx, cy = (params[0], *params) if wanted == 3 else params
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    else:
        matrix = np.asarray(entry[()])
    try:
        points = pixels.to_photo(places, matrix)
    except ValueError as error:
        expected = "a group with model and params, or a matrix K of shape (3, 3)"
        raise TableError(
            path, column=place, found=str(error).split(": ", 1)[1], expected=expected
        ) from None
    cofactors = points.covariances(np.broadcast_to(np.eye(2), (len(places), 2, 2)))
    seen = Seen(points.x, points.y, cofactors)
    return seen, points.focal, np.ones(len(places), bool)


def _read_value(path: str | Path, place: str, group: Any, key: str) -> Any:
    """The value of an entry of a camera: text, a number, or numbers. Raises TableError
    where there is none."""
    if key not in group and key not in group.attrs:
        raise TableError(
            path,
            column=f"{place}/{key}",
            found=f"no such entry, but {', '.join(group) or 'nothing'}",
            expected="model, width, height and params",
        )
    value = group[key][()] if key in group else group.attrs[key]
    if key == "params":
        return np.asarray(value, float)
    value = np.ravel(value)[0]
    return value.decode() if isinstance(value, bytes) else value
