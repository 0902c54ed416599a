"""Cameras of a table's photos from TOML, in one of three forms:

    [camera]                              one camera for every photo
    [left] and [right]                    one for all left photos, one for all right ones
    [photo.NAME], one table a photo       pairs are then named LEFT-RIGHT or LEFT_RIGHT

Each table holds focal and, where they are not the defaults, principal_point = [0, 0],
pixel_size = 1, y_down = false.
"""

import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..geometry.pairs import Camera, Pair
from .fields import TableError, read_text
from .measured import CameraPairs, Measurements, of_pairs, one_pair, to_list, to_ragged

KEYS = ("focal", "principal_point", "pixel_size", "y_down")
FORMS = "[camera], or [left] and [right], or [photo.NAME] for every photo"


@dataclass
class Cameras:
    """The cameras of the left and right photos, or of every photo by its name."""

    file: str
    left: Camera | None = None
    right: Camera | None = None
    photos: dict[str, Camera] = field(default_factory=dict)

    def of(
        self, name: str, file: str, line: int | str | None = None
    ) -> tuple[Camera, Camera]:
        """(left, right) of the pair of this name, that begins at a line of the file.
        Raises TableError if the name does not say which photos it is made of."""
        if self.left is not None and self.right is not None:
            return self.left, self.right
        splits = [
            (name[:i], name[i + 1 :]) for i, letter in enumerate(name) if letter in "-_"
        ]
        known = [
            split for split in splits if all(photo in self.photos for photo in split)
        ]
        if len(known) != 1:
            found = (
                f"{name!r}"
                if not known
                else f"{name!r}, which can be split in {len(known)} ways"
            )
            expected = (
                f"LEFT-RIGHT or LEFT_RIGHT with two photos of {self.file}: "
                f"{', '.join(self.photos)}"
            )
            raise TableError(
                file, line=line, column="pair", found=found, expected=expected
            )
        return self.photos[known[0][0]], self.photos[known[0][1]]

    def of_all(
        self,
        names: Any,
        file: str,
        *,
        one_sigma: bool = False,
        place: Callable[[int], int | str | None] = lambda number: None,
    ) -> CameraPairs:
        """(left, right) that all pairs have, or those of each of the names, a column.

        `one_sigma`: one standard deviation has to serve both photos. `place`: where the
        pair of a number begins in the file. Raises TableError.
        """
        if self.left is not None and self.right is not None:
            if one_sigma:
                check_one_sigma(file, place(0), self.left, self.right)
            return self.left, self.right
        each = []
        for number, name in enumerate(map(str, to_list(names))):
            try:
                both = self.of(name, file)
                if one_sigma:
                    check_one_sigma(file, None, *both)
            except TableError as error:
                raise TableError(
                    error.file,
                    line=place(number),
                    column=error.column,
                    found=error.found,
                    expected=error.expected,
                ) from None
            each.append(both)
        return each


def read(path: Path) -> Cameras:
    """The cameras of a TOML file. Raises TableError."""
    text = read_text(path)
    try:
        return _cameras(path, text, tomllib.loads(text))
    except TableError:
        raise
    except ValueError as error:  # also of whole numbers with thousands of digits
        line = re.search(r"at line (\d+)", str(error))
        where, found = int(line[1]) if line else None, f"no valid TOML ({error})"
    except RecursionError:
        where, found = None, "lists or tables within each other, too deep to be read"
    raise TableError(path, line=where, found=found, expected=f"the tables {FORMS}")


def _cameras(path: Path, text: str, tables: dict[str, Any]) -> Cameras:
    """The cameras of the tables of a TOML file. Raises TableError."""
    names = set(tables)
    if names == {"photo"} and isinstance(tables["photo"], dict) and tables["photo"]:
        return Cameras(
            str(path),
            photos={
                n: _camera(path, text, f"photo.{n}", t)
                for n, t in tables["photo"].items()
            },
        )
    if names == {"camera"}:
        one = _camera(path, text, "camera", tables["camera"])
        return Cameras(str(path), one, one)
    if names == {"left", "right"}:
        left, right = (
            _camera(path, text, side, tables[side]) for side in ("left", "right")
        )
        return Cameras(str(path), left, right)
    found = f"the entries {', '.join(tables)}" if tables else "no entries"
    raise TableError(path, found=found, expected=FORMS)


def _camera(path: Path, text: str, table: str, entries: Any) -> Camera:
    """One camera of its table. Raises TableError for a missing, unknown or unusable
    key."""
    if not isinstance(entries, dict):
        raise TableError(
            path,
            column=table,
            found=repr(entries),
            expected=f"a table [{table}] with {', '.join(KEYS)}",
        )
    for key, value in entries.items():
        line, place = _line(text, table, key), f"{table}.{key}"
        if key not in KEYS:
            raise TableError(
                path,
                line=line,
                column=place,
                found="an unknown key",
                expected=f"{', '.join(KEYS)}; none is ignored",
            )
        good, expected = _fits(key, value)
        if not good:
            raise TableError(
                path, line=line, column=place, found=repr(value), expected=expected
            )
    if "focal" not in entries:
        raise TableError(
            path,
            line=_line(text, table),
            column=f"{table}.focal",
            found="no such key",
            expected="the focal length in photo units",
        )
    x0, y0 = entries.get("principal_point", (0, 0))
    return Camera(
        float(entries["focal"]),
        (float(x0), float(y0)),
        float(entries.get("pixel_size", 1)),
        entries.get("y_down", False),
    )


def _fits(key: str, value: Any) -> tuple[bool, str]:
    """Whether a value suits its key, and what would."""
    number = lambda v: type(v) in (int, float) and abs(v) <= sys.float_info.max
    if key == "y_down":
        return isinstance(value, bool), "true or false"
    if key == "principal_point":
        good = isinstance(value, list) and len(value) == 2 and all(map(number, value))
        return good, "two numbers [x, y] in measured units"
    return bool(number(value) and value > 0), "a positive number"


def _line(text: str, table: str, key: str | None = None) -> int | None:
    """The line of a key below its [table] header, or of the header itself; None where
    it is written another way."""
    inside = False
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.split("#")[0].strip()
        if bare.startswith("["):
            inside = bare.strip("[] ").replace('"', "").replace("'", "") == table
            if inside and key is None:
                return number
        elif (
            inside
            and key is not None
            and bare.split("=")[0].strip().strip("\"'") == key
        ):
            return number
    return None


def check_one_sigma(
    file: str, line: int | str | None, left: Camera, right: Camera
) -> None:
    """Raises TableError where one sigma cannot serve two pixel sizes."""
    if left.pixel_size != right.pixel_size:
        found = (
            f"sigma with pixel sizes {left.pixel_size!r} (left) and "
            f"{right.pixel_size!r} (right)"
        )
        expected = (
            "coordinates in photo units where the pixel sizes differ, so that one "
            "sigma serves both photos"
        )
        raise TableError(
            file, line=line, column="sigma", found=found, expected=expected
        )


def to_pair(
    measured: Measurements,
    file: str,
    left: Camera,
    right: Camera,
    sigma: float | None = None,
) -> Pair:
    """Measured coordinates as a `Pair` in photo coordinates; sigma for all points or
    from the table.

    Raises TableError where one sigma cannot serve two pixel sizes.
    """
    if measured.sigma is not None or sigma is not None:
        check_one_sigma(file, measured.lines[0], left, right)
    return one_pair(to_ragged(of_pairs([measured], file), (left, right), sigma), 0)
