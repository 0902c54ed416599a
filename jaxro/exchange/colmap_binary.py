"""COLMAP's models as binary files, entry by entry. Numbers are little-endian; every count
is compared with the bytes that are left before anything is made of it.

    cameras.bin     count; of each: camera u4, model i4, width u8, height u8, params f8
    images.bin      count; of each: image u4, pose 7 f8, camera u4, name with a zero byte,
                    count of keypoints u8; of each: x f8, y f8, point u8
    points3D.bin    count; of each: point u8, X Y Z f8, colour 3 u1, error f8, length of
                    its track u8; of each: image u4, keypoint u4
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..tables.fields import TableError
from .colmap_cameras import count_parameters, make_camera, model_of_number

COUNT = np.dtype("<u8")
CAMERA = np.dtype([("camera", "<u4"), ("model", "<i4"), ("sizes", "<u8", 2)])
IMAGE = np.dtype([("image", "<u4"), ("pose", "<f8", 7), ("camera", "<u4")])
KEYPOINT = np.dtype([("place", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [
        ("point", "<i8"),
        ("place", "<f8", 3),
        ("colour", "u1", 3),
        ("error", "<f8"),
        ("length", "<u8"),
    ]
)
TRACK = np.dtype("<u8")
"""One view of a point: image and keypoint."""


class _Bytes:
    """The bytes of a file, one entry behind the other."""

    def __init__(self, path: Path):
        self._path, self._at, self._what = path, 0, ""
        try:
            self._bytes = path.read_bytes()
        except OSError as error:
            found = f"no file that can be read ({error.strerror or error})"
            raise TableError(path, found=found, expected="a readable file") from None

    def count(self, what: str) -> int:
        """How many entries follow."""
        return int(self.take(COUNT, 1, f"the number of {what}")[0])

    def take(self, dtype: np.dtype, count: int, what: str) -> np.ndarray:
        """The next entries of a type. Raises TableError where the file is too short."""
        self._what, left = what, len(self._bytes) - self._at
        if count * dtype.itemsize > left:
            found = f"{left} bytes for {count} times {dtype.itemsize}"
            raise self.error(found, "a whole file of COLMAP")
        taken = np.frombuffer(self._bytes, dtype, count, self._at)
        self._at += count * dtype.itemsize
        return taken

    def take_text(self, what: str) -> str:
        """The text up to the next zero byte. Raises TableError where none comes."""
        self._what = what
        end = self._bytes.find(b"\0", self._at)
        if end < 0:
            raise self.error("no zero byte up to the end of the file", "a name")
        text = self._bytes[self._at : end].decode(errors="backslashreplace")
        self._at = end + 1
        return text

    def end(self) -> None:
        """Raises TableError where something is left."""
        if left := len(self._bytes) - self._at:
            self._what = "the end"
            raise self.error(
                f"{left} bytes behind the last entry",
                "as many entries as the file says",
            )

    def error(self, found: str, expected: str, column: str | None = None) -> TableError:
        """The error at what was read last."""
        return TableError(
            self._path,
            line=f"byte {self._at}",
            column=column or self._what,
            found=found,
            expected=expected,
        )


def read_cameras(path: Path) -> dict[int, Any]:
    """The cameras of pycolmap by their numbers. Raises TableError."""
    file, cameras = _Bytes(path), {}
    for k in range(file.count("cameras")):
        entry = file.take(CAMERA, 1, f"camera entry {k}")[0]
        key, sizes = int(entry["camera"]), map(int, entry["sizes"])
        if key in cameras:
            raise file.error(f"camera {key} a second time", "each camera once")
        try:
            model = model_of_number(int(entry["model"]))
            params = file.take(
                np.dtype("<f8"), count_parameters(model), f"camera {key}"
            )
            cameras[key] = make_camera(model, *sizes, params)
        except TableError:
            raise
        except ValueError as error:
            expected = "a camera model of COLMAP with its parameters"
            raise file.error(str(error), expected, f"camera {key}") from None
    file.end()
    return cameras


def read_photos(path: Path, photos: Any) -> None:
    """Reads the photos, and their keypoints that have a point. Raises TableError."""
    file = _Bytes(path)
    for k in range(file.count("photos")):
        entry = file.take(IMAGE, 1, f"photo {k}")[0]
        name = file.take_text(f"the name of photo {k}")
        count = file.count(f"keypoints of photo {k}")
        keypoints = file.take(KEYPOINT, count, f"the keypoints of photo {k}")
        own = keypoints[keypoints["point"] >= 0]
        places, points = own["place"].copy(), own["point"].copy()
        photos.add(name, int(entry["camera"]), places, points, file.error, f"photo {k}")
    file.end()


def read_points(path: Path) -> list[int]:
    """The numbers of the points. Raises TableError."""
    file, numbers = _Bytes(path), []
    for k in range(file.count("points")):
        entry = file.take(POINT, 1, f"point entry {k}")[0]
        file.take(TRACK, int(entry["length"]), f"the track of point entry {k}")
        numbers.append(int(entry["point"]))
    file.end()
    return numbers
