"""HDF5 files of pairs, as benchmarks of relative pose have them (PoseLib's `posebench`):
a group for each pair with

    x1, x2               (point, 2) pixels of the matches on both photos
    camera1, camera2     a group with model, width, height and params, the model and the
                         order of params being COLMAP's; or a 3 x 3 matrix K

Whatever else a group holds (R, t, ...) is not read. Links lead within the file only.
Needs the extra `h5`; of cameras with distortion also `colmap`.
"""

import io
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..tables.fields import TableError
from . import colmap_cameras, h5_child, pixels
from .matches import FARTHEST, LEAST, Match, Matches, Seen, collect, is_focal

PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
"""Models without distortion, and how many parameters they have."""

PATIENCE = 10
"""How much longer than its time of a processor a file may take on a busy computer."""

EXPECTED = "a file with a group for each pair"


class _Held(NamedTuple):
    """What a file holds: `holds` lists the entries of groups, `values` are those of the
    others, both by their place, in which a pair is its number: 0/camera1/params."""

    path: str | Path
    holds: Mapping[str, list[str]]
    values: Mapping[str, np.ndarray]

    def place(self, key: str) -> str:
        """How a place is told: by the name of the pair."""
        number, *rest = key.split("/")
        return "/".join([self.holds[""][int(number)], *rest])

    def is_there(self, key: str) -> bool:
        """Whether there is an entry, a group or values."""
        return key in self.holds or key in self.values

    def missing(self, key: str, expected: str) -> TableError:
        """The error that an entry is not there."""
        group = key.rpartition("/")[0]
        holds = ", ".join(self.holds.get(group, ["numbers"])) or "nothing"
        return self.error(key, f"no such entry, but {holds}", expected)

    def numbers(self, key: str) -> np.ndarray:
        """Real numbers. Raises TableError."""
        if key not in self.values:
            raise self.error(key, "a group", "numbers")
        values = self.values[key]
        if values.dtype.kind not in "fiu":
            raise self.error(key, f"values of type {values.dtype}", "numbers")
        return np.asarray(values, float)

    def error(self, key: str, found: str, expected: str) -> TableError:
        """The error at a place."""
        column = self.place(key)
        return TableError(self.path, column=column, found=found, expected=expected)


def read_h5(path: str | Path, *, sigma: float | None = None) -> Matches:
    """All pairs of a file, in the order of their names. `sigma`: the standard deviation
    of a pixel coordinate. Raises TableError for what is no such file, with the place in
    it.

    The photos are those of the pair alone, NAME:1 and NAME:2, and its points have names
    of their own: such a file does not say which points of two pairs are one.
    """
    held, warnings = _read(path), []
    pairs = [_read_pair(held, k, warnings) for k in range(len(held.holds[""]))]
    if not pairs:
        raise TableError(path, found="no groups", expected="a group for each pair")
    return collect(str(path), pairs, sigma, warnings)


def _read(path: str | Path) -> _Held:
    """What the file holds, by a process that may fail (`h5_child`). Raises TableError."""
    if find_spec("h5py") is None:
        raise SystemExit("HDF5 files need h5py: pip install 'jaxro[h5]'")
    try:
        most = h5_child.SECONDS + os.stat(path).st_size // h5_child.SPEED
        line = [sys.executable, "-P", h5_child.__file__, os.fspath(path)]
        # threads of linear algebra, which nothing needs, cost a third of the start
        alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            line, capture_output=True, timeout=PATIENCE * most, check=False, env=alone
        )
    except OSError as error:
        found = f"no file that can be read ({error.strerror or error})"
        raise TableError(path, found=found, expected=EXPECTED) from None
    except subprocess.TimeoutExpired:
        found = f"damaged bytes: reading takes more than {PATIENCE * most} seconds"
        raise TableError(path, found=found, expected=EXPECTED) from None
    if done.returncode == h5_child.REFUSED:
        place, found, expected = json.loads(done.stderr)
        raise TableError(path, column=place, found=found, expected=expected)
    if done.returncode:
        found = f"damaged bytes, at which reading ended (code {done.returncode})"
        raise TableError(path, found=found, expected=EXPECTED)
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as values:
        loaded = {key: values[key] for key in values.files}
    return _Held(path, json.loads(str(loaded.pop("holds"))), loaded)


def _read_pair(held: _Held, number: int, warnings: list[str]) -> Match:
    """One pair. Raises TableError."""
    name = held.holds[""][number]
    for entry in h5_child.PAIR:
        if not held.is_there(f"{number}/{entry}"):
            raise held.missing(
                f"{number}/{entry}",
                "x1, x2, camera1 and camera2 in the group of each pair",
            )
    places = [_read_pixels(held, f"{number}/{x}") for x in ("x1", "x2")]
    if len(places[0]) != len(places[1]):
        raise held.error(
            f"{number}/x2",
            f"{len(places[1])} points beside {len(places[0])} in x1",
            "both points of each match in the same row",
        )
    both = [
        _see(held, f"{number}/{camera}", pixels)
        for camera, pixels in zip(("camera1", "camera2"), places, strict=True)
    ]
    (left, focal_left, first), (right, focal_right, second) = both
    seen, scores = first & second, _read_scores(held, number, len(first))
    if not np.all(seen):
        warnings.append(
            f"{held.path}: in pair {name!r} {int(np.sum(~seen))} of {len(seen)} "
            "matches are left out, which the lens of a photo cannot have seen"
        )
    if np.sum(seen) < LEAST:
        warnings.append(
            f"{held.path}: pair {name!r} has {int(np.sum(seen))} matches only"
        )
    return Match(
        name=name,
        photos=(f"{name}:1", f"{name}:2"),
        points=[f"{number}.{row + 1}" for row in np.flatnonzero(seen)],
        left=left.choose(seen),
        right=right.choose(seen),
        focals=(focal_left, focal_right),
        score=None if scores is None else scores[seen],
    )


def _read_scores(held: _Held, number: int, matches: int) -> np.ndarray | None:
    """The scores of the matches of a pair, where it has any. Raises TableError."""
    for name in h5_child.SCORES:
        key = f"{number}/{name}"
        if held.is_there(key):
            scores = held.numbers(key)
            if scores.shape != (matches,):
                found = f"shape {scores.shape}"
                raise held.error(key, found, f"a score for each of {matches} matches")
            return scores
    return None


def _read_pixels(held: _Held, key: str) -> pixels.Pixels:
    """(point, 2) numbers. Raises TableError."""
    numbers = held.numbers(key)
    if numbers.ndim != 2 or numbers.shape[1] != 2:
        found = f"shape {numbers.shape} of type {held.values[key].dtype}"
        raise held.error(key, found, "numbers of shape (point, 2)")
    return numbers


def _see(
    held: _Held, key: str, places: pixels.Pixels
) -> tuple[Seen, float, np.ndarray]:
    """The points in photo coordinates, the focal length, and which of them there are.
    Raises TableError for a camera that is none."""
    try:
        if key in held.values:
            return _see_by_matrix(places, held.numbers(key))
        model, params = _read_text(held, f"{key}/model"), _read_params(held, key)
        if model in PINHOLES:
            matrix = _pinhole(held, f"{key}/params", model, params)
            return _see_by_matrix(places, matrix)
        width, height = (_read_size(held, f"{key}/{n}") for n in ("width", "height"))
        known = colmap_cameras.model_of_name(model)
        camera = colmap_cameras.make_camera(known, width, height, params)
        return colmap_cameras.see_by(camera, places)
    except TableError:
        raise
    except ValueError as error:
        found = str(error).removeprefix("pair_from_pixels: ")
        expected = (
            "a group with a camera model of COLMAP and its params, or a matrix K of shape "
            "(3, 3)"
        )
        raise held.error(key, found, expected) from None


def _pinhole(held: _Held, key: str, model: str, params: np.ndarray) -> np.ndarray:
    """K of a camera without distortion. Raises TableError."""
    wanted = PINHOLES[model]
    if len(params) != wanted:
        raise held.error(key, f"{len(params)} numbers", f"{wanted} for {model}")
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


def _read_params(held: _Held, key: str) -> np.ndarray:
    """The parameters of a camera. Raises TableError."""
    if not held.is_there(f"{key}/params"):
        raise held.missing(f"{key}/params", ", ".join(h5_child.CAMERA))
    return np.ravel(held.numbers(f"{key}/params"))


def _read_size(held: _Held, key: str) -> int:
    """Width or height of a photo, 0 where it is not told. Raises TableError."""
    numbers = np.ravel(held.numbers(key)) if held.is_there(key) else np.zeros(1)
    if len(numbers) != 1 or not 0 <= numbers[0] <= colmap_cameras.LARGEST:
        raise held.error(key, f"{numbers[:3].tolist()}", "a number of pixels")
    return int(numbers[0])


def _read_text(held: _Held, key: str) -> str:
    """A name in a camera. Raises TableError where there is none."""
    if not held.is_there(key):
        raise held.missing(key, ", ".join(h5_child.CAMERA))
    texts = np.ravel(held.values.get(key, np.zeros(0)))
    if len(texts) != 1 or texts.dtype.kind != "U":
        raise held.error(key, "no text", "the name of a camera model")
    return str(texts[0])
