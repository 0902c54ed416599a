"""Cameras of a table's photos from TOML, in one of four forms:

    [camera]                              one camera for every photo
    [left] and [right]                    one for all left photos, one for all right ones
    [photo.NAME], one table a photo       pairs are then named LEFT-RIGHT or LEFT_RIGHT
    [camera.NAME], one table a camera     for tables of places with the column camera

Each table holds focal and, where they are not the defaults, principal_point = [0, 0],
pixel_size = 1, y_down = false.
"""

import json
import re
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..geometry.pairs import Camera, Pair
from .fields import TableError, read_text
from .measured import CameraPairs, Measurements, of_pairs, one_pair, to_list, to_ragged

KEYS = ("focal", "principal_point", "pixel_size", "y_down")
LARGEST = 1_000_000
"""Bytes of a camera file: those of some 20,000 photos, read in seconds."""

DOTS = 20
"""Points in a line of a camera file: those of a name and of two numbers."""

FORMS = (
    "[camera], or [left] and [right], or [photo.NAME] for every photo, or for a table of "
    "places with the column camera [camera.NAME] for each of them"
)


@dataclass
class Cameras:
    """The cameras of the left and right photos, or of every photo by its name, or by
    names of their own (`named`)."""

    file: str
    left: Camera | None = None
    right: Camera | None = None
    photos: dict[str, Camera] = field(default_factory=dict)
    named: dict[str, Camera] = field(default_factory=dict)

    def of(
        self, name: str, file: str, line: int | str | None = None
    ) -> tuple[Camera, Camera]:
        """(left, right) of the pair of this name, that begins at a line of the file.
        Raises TableError if the name does not say which photos it is made of."""
        if self.left is not None and self.right is not None:
            return self.left, self.right
        left, right = self.photos_in(name, file, line)
        return self.photos[left], self.photos[right]

    def photos_in(
        self, name: str, file: str, line: int | str | None = None
    ) -> tuple[str, str]:
        """The two photos that the name of a pair is made of: LEFT-RIGHT or LEFT_RIGHT,
        of photos that have a camera of their own. Raises TableError."""
        marks = [k for k in range(1, len(name) - 1) if name[k] in "-_"]
        if self.photos:
            known = [
                k
                for k in marks
                if name[:k] in self.photos and name[k + 1 :] in self.photos
            ]
            expected = (
                f"LEFT-RIGHT or LEFT_RIGHT with two photos of {self.file}: "
                f"{', '.join(self.photos)}"
            )
        else:
            # photo_1-photo_2 has one hyphen
            hyphens = [k for k in marks if name[k] == "-"]
            known = hyphens if name.count("-") == 1 and hyphens else marks
            expected = (
                "LEFT-RIGHT, the names of two photos, or the columns left and right "
                "with these names"
            )
        left = right = ""
        if len(known) == 1:
            left, right = name[: known[0]], name[known[0] + 1 :]
        if left == right:  # also where there is not one way to split
            found = repr(name)
            if len(known) > 1:
                found += f", which can be split in {len(known)} ways"
            raise TableError(
                file, line=line, column="pair", found=found, expected=expected
            )
        return left, right

    def of_photo(self, name: str) -> Camera | None:
        """The camera of a photo; None where it has none, or not one alone."""
        return self.photos.get(name, self.left if self.left == self.right else None)

    def photos_of(
        self,
        names: Any,
        file: str,
        *,
        given: tuple[Any, Any] | None = None,
        place: Callable[[int], int | str | None] = lambda number: None,
    ) -> tuple[list[str], list[str]]:
        """The left and the right photo of all pairs: those that are `given`, else those
        in the names of the pairs. `place`: where the pair of a number begins in the
        file. Raises TableError."""
        if given is not None:
            left, right = (list(map(str, to_list(column))) for column in given)
            for column, photos in (("left", left), ("right", right)):
                self._check_photos(photos, file, column, place)
            return left, right
        both = []
        for number, name in enumerate(map(str, to_list(names))):
            try:
                both.append(self.photos_in(name, file))
            except TableError as error:
                raise _at(error, place(number)) from None
        left, right = zip(*both, strict=True)
        return list(left), list(right)

    def _check_photos(
        self,
        photos: list[str],
        file: str,
        column: str,
        place: Callable[[int], int | str | None],
    ) -> None:
        """Raises TableError for a photo without a camera."""
        for number, name in enumerate(photos):
            if self.photos and name not in self.photos:
                raise TableError(
                    file,
                    line=place(number),
                    column=column,
                    found=repr(name),
                    expected=f"a photo of {self.file}: {', '.join(self.photos)}",
                )

    def of_all(
        self,
        names: Any,
        file: str,
        *,
        photos: tuple[Any, Any] | None = None,
        one_sigma: bool = False,
        place: Callable[[int], int | str | None] = lambda number: None,
    ) -> CameraPairs:
        """(left, right) that all pairs have, or those of each of the names, a column.

        `photos`: the names of the left and right photos, where the table has them.
        `one_sigma`: one standard deviation has to serve both photos. `place`: where the
        pair of a number begins in the file. Raises TableError.
        """
        if self.left is not None and self.right is not None:
            if one_sigma:
                check_one_sigma(file, place(0), self.left, self.right)
            return self.left, self.right
        left, right = self.photos_of(names, file, given=photos, place=place)
        each = []
        for number, (one, other) in enumerate(zip(left, right, strict=True)):
            both = self.photos[one], self.photos[other]
            if one_sigma and both[0].pixel_size != both[1].pixel_size:
                check_one_sigma(file, place(number), *both)
            each.append(both)
        return each


def _at(error: TableError, line: int | str | None) -> TableError:
    """The error, with the line where it is."""
    return TableError(
        error.file,
        line=line,
        column=error.column,
        found=error.found,
        expected=error.expected,
    )


def read(path: Path) -> Cameras:
    """The cameras of a TOML file. Raises TableError."""
    text = read_text(path, LARGEST)
    _check_dots(path, text)
    try:
        return _cameras(path, text, tomllib.loads(text))
    except TableError:
        raise
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"at line (\d+)", str(error))
        where, found = int(line[1]) if line else None, f"no valid TOML ({error})"
    except ValueError:  # Python refuses them
        where, found = None, "a whole number of thousands of digits"
    except RecursionError:
        where, found = None, "lists or tables within each other, too deep to be read"
    raise TableError(path, line=where, found=found, expected=f"the tables {FORMS}")


def _check_dots(path: Path, text: str) -> None:
    """Raises TableError for a key of many parts: the reader of TOML takes room by the
    square of their number."""
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > DOTS and not line.lstrip().startswith("#"):
            found = f"a line with {line.count('.')} points"
            expected = "a key, or a table, of a camera"
            raise TableError(path, line=number, found=found, expected=expected)


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
    if names == {"camera"} and _are_named(tables["camera"]):
        return Cameras(
            str(path),
            named={
                n: _camera(path, text, f"camera.{n}", t)
                for n, t in tables["camera"].items()
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


def _are_named(entries: Any) -> bool:
    """Whether the entries of [camera] are cameras themselves, [camera.NAME]."""
    if not isinstance(entries, dict) or not entries:
        return False
    return all(isinstance(one, dict) for one in entries.values())


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
        good, expected = _fits(key, value)
        if not good:
            raise TableError(
                path,
                line=_line(text, table, key),
                column=f"{table}.{key}",
                found=repr(value) if key in KEYS else "an unknown key",
                expected=expected,
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
    if key not in KEYS:
        return False, f"{', '.join(KEYS)}; none is ignored"
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


def text_of(focal: Mapping[str, float]) -> str:
    """The TOML text of photos with these focal lengths, for coordinates from the
    principal point."""
    # a string of JSON is one of TOML, but for one letter
    quoted = lambda name: json.dumps(name, ensure_ascii=False).replace(
        "\x7f", "\\u007f"
    )
    return "\n".join(
        f"[photo.{quoted(name)}]\nfocal = {value!r}\n" for name, value in focal.items()
    )


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
