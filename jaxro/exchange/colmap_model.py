"""Models of COLMAP as they stand in files: cameras, and photos with the points that they
show. The poses are not kept.

    cameras.txt     CAMERA MODEL WIDTH HEIGHT PARAMS...
    images.txt      IMAGE QW QX QY QZ TX TY TZ CAMERA NAME    a name may have blanks
                    X Y POINT  X Y POINT ...                  POINT is -1 where none is
    points3D.txt    POINT X Y Z R G B ERROR, and its track

The binary files hold the same (`colmap_binary`).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..tables.fields import TableError
from . import colmap_binary
from .colmap_cameras import make_camera, model_of_name
from .lines import Lines

FILES = ("cameras", "images", "points3D")

NO_POINT = -1
"""The number of the point of a keypoint that has none."""

POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")
FIELDS = f"IMAGE {' '.join(POSE)} CAMERA NAME"


class Photo(NamedTuple):
    """A photo: its name, its camera, and where it shows points of which number."""

    name: str
    camera: Any
    places: Float[np.ndarray, "keypoint 2"]
    points: Int[np.ndarray, " keypoint"]


class Model(NamedTuple):
    """The photos of a model in the order of the file, and the numbers of its points,
    ascending."""

    photos: list[Photo]
    points: Int[np.ndarray, " point"]


class _Photos:
    """The photos of a file while it is read: names are given once, cameras are those
    of the model."""

    def __init__(self, cameras: dict[int, Any]):
        self.read: list[Photo] = []
        self._cameras, self._first = cameras, dict[str, str]()

    def add(
        self,
        name: str,
        camera: int,
        places: Float[np.ndarray, "keypoint 2"],
        points: Int[np.ndarray, " keypoint"],
        error: Callable[..., TableError],
        place: str,
    ) -> None:
        """One more photo. Raises TableError, made by `error`; `place`: where it is."""
        if not name:
            raise error("a photo without a name", FIELDS)
        if self._first.setdefault(name, place) != place:
            found = f"the name {name!r} a second time (first on {self._first[name]})"
            raise error(found, "a name of its own for each photo", "NAME")
        if camera not in self._cameras:
            found = f"camera {camera} of photo {name!r}"
            raise error(found, "a camera of the model", "CAMERA")
        self.read.append(Photo(name, self._cameras[camera], places, points))


def read_model(folder: Path) -> Model:
    """The model of a folder. Raises TableError for what is none, with file and place."""
    for ending, (read_cameras, read_photos, read_points) in FORMATS.items():
        cameras, images, points = (folder / f"{name}.{ending}" for name in FILES)
        if not all(path.is_file() for path in (cameras, images, points)):
            continue
        photos = _Photos(read_cameras(cameras))
        read_photos(images, photos)
        if not photos.read:
            raise TableError(images, found="no photos", expected="a model with photos")
        return Model(photos.read, np.unique(np.array(read_points(points), np.int64)))
    found = "no folder"
    if folder.is_dir():
        names = sorted(path.name for path in folder.iterdir())
        found = f"a folder with {', '.join(names[:9]) or 'nothing'}"
    raise TableError(
        folder,
        found=found,
        expected="a folder with cameras.txt, images.txt and points3D.txt",
    )


# -------------------------------------------------------------------------------------
# text


def _read_cameras(path: Path) -> dict[int, Any]:
    """The cameras of pycolmap by their numbers. Raises TableError."""
    lines, cameras = Lines(path), {}
    while (line := lines.next()) is not None:
        fields = line.split()
        if len(fields) < 5:
            raise lines.error(
                f"{len(fields)} fields", "CAMERA MODEL WIDTH HEIGHT PARAMS of a camera"
            )
        number, model, *sizes = fields[:4]
        key = lines.whole(number, "CAMERA")
        if key in cameras:
            raise lines.error(f"camera {key} a second time", "each camera once")
        width, height = (
            lines.whole(field, name)
            for field, name in zip(sizes, ("WIDTH", "HEIGHT"), strict=True)
        )
        params = np.array([lines.number_of(field, "PARAMS") for field in fields[4:]])
        try:
            cameras[key] = make_camera(model_of_name(model), width, height, params)
        except ValueError as error:
            expected = "a camera model of COLMAP with its parameters"
            raise lines.error(str(error), expected, f"camera {key}") from None
    return cameras


def _read_photos(path: Path, photos: _Photos) -> None:
    """Reads two lines of each photo. Raises TableError."""
    lines = Lines(path)
    while (line := lines.next()) is not None:
        *fields, name = [*line.split(maxsplit=len(POSE) + 2), ""][: len(POSE) + 3]
        if len(fields) < len(POSE) + 2:
            raise lines.error(f"{len(fields)} fields", FIELDS)
        lines.whole(fields[0], "IMAGE")
        for field, column in zip(fields[1:], POSE, strict=False):
            lines.value(field, column)  # tells a comma
        camera, place = lines.whole(fields[-1], "CAMERA"), f"line {lines.number}"
        error = _at_line(lines, lines.number)
        keypoints = (lines.next_of_any() or "").split()
        photos.add(name, camera, *_read_keypoints(lines, keypoints), error, place)


def _at_line(lines: Lines, line: int) -> Callable[..., TableError]:
    """The error of a line that is told when the next one has been read."""
    return lambda found, expected, column=None: lines.error(
        found, expected, column, line
    )


def _read_keypoints(
    lines: Lines, fields: list[str]
) -> tuple[Float[np.ndarray, "keypoint 2"], Int[np.ndarray, " keypoint"]]:
    """Places and numbers of the points of a line. Raises TableError."""
    if len(fields) % 3:
        raise lines.error(f"{len(fields)} fields", "X Y POINT of each keypoint")
    own = [
        k
        for k, field in enumerate(fields[2::3])
        if _read_number_of_point(lines, field) != NO_POINT
    ]
    places = [
        [lines.value(fields[3 * k + axis], f"keypoint {k}, {'XY'[axis]}") for axis in (0, 1)]
        for k in own
    ]  # fmt: skip
    points = [int(fields[3 * k + 2]) for k in own]
    return np.array(places, float).reshape(-1, 2), np.array(points, np.int64)


def _read_number_of_point(lines: Lines, field: str) -> int:
    """The number of the point of a keypoint. Raises TableError."""
    if field in ("-1", str(2**64 - 1)):
        return NO_POINT
    return lines.whole(field, "POINT of a keypoint")


def _read_points(path: Path) -> list[int]:
    """The numbers of the points. Raises TableError."""
    lines, numbers = Lines(path), []
    while (line := lines.next()) is not None:
        fields = line.split(maxsplit=4)
        if len(fields) < 4:
            raise lines.error(f"{len(fields)} fields", "POINT X Y Z of a point")
        numbers.append(lines.whole(fields[0], "POINT"))
        for field, axis in zip(fields[1:4], "XYZ", strict=True):
            lines.value(field, axis)  # tells a comma
    return numbers


FORMATS = {
    "txt": (_read_cameras, _read_photos, _read_points),
    "bin": (
        colmap_binary.read_cameras,
        colmap_binary.read_photos,
        colmap_binary.read_points,
    ),
}
"""The readers of the three files by the ending of their names."""
