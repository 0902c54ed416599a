"""Tables with one row for each place, `photo,point,x,y`, as tables of pairs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ..block.photo_pairs import FEWEST, CommonPoints, choose_pairs, common_points
from ..exchange import files
from ..tables import images
from ..tables.fields import TableError
from ..tables.measured import COORDINATES, DEVIATIONS, Table
from ..tables.survey_checks import Row


def are_in(file: Path | None) -> bool:
    """Whether a file of the user has a row for each place. Raises TableError where it
    cannot be read."""
    if file is None or files.is_of_other_program(file):
        return False
    return images.are_places(file)


class Numbered(NamedTuple):
    """Names of photos and points, the numbers of both in each row, and the points in
    common of the pairs that join the photos."""

    photos: np.ndarray
    points: np.ndarray
    photo: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    common: CommonPoints


def number(rows: list[Row], file: Path) -> Numbered:
    """The rows of a table of places by numbers. Raises TableError where no two photos
    have enough points in common."""
    names = lambda column: np.unique(
        [row.cells[column] for row in rows], return_inverse=True
    )
    (photos, photo), (points, point) = names("image"), names("point")
    common = choose_pairs(common_points(photo, point, len(photos)), len(photos))
    if not len(common.left):
        raise TableError(
            file,
            found=f"no two of {len(photos)} photos with {FEWEST} points in common",
            expected="the same name for the same point on all photos",
        )
    return Numbered(photos, points, photo, point, common)


def check_one_camera(rows: list[Row]) -> None:
    """Raises TableError where a table names several cameras, and only one is given."""
    of_rows = [row.cells.get("camera") for row in rows]
    if len(set(of_rows)) == 1:
        return
    other = next(row for row in rows if row.cells["camera"] != of_rows[0])
    raise other.error(
        "camera",
        found=f"{other.cells['camera']!r} beside {of_rows[0]!r}",
        expected="a table [photo.NAME] for each photo in --camera, where these are of "
        "several cameras",
    )


def read(file: Path, *, one_camera: bool) -> Table:
    """The pairs of the photos of a table of places that have points in common: of each
    photo those with the most. `one_camera`: only one is given. Raises TableError."""
    rows = images.read_places(file)
    if one_camera:
        check_one_camera(rows)
    photos, points, _, point, common = number(rows, file)
    left, right = photos[common.left], photos[common.right]
    column = lambda name, of: np.array([rows[k].cells[name] for k in of], float)
    sides = (common.one, common.other)
    numbers = [column(axis, of) for of in sides for axis in ("x", "y")]
    table: dict[str, Any] = dict(zip(COORDINATES, numbers, strict=True))
    if "sigma" in rows[0].cells:
        one, other = (column("sigma", of) for of in sides)
        if np.array_equal(one, other):
            table["sigma"] = one
        else:
            table |= dict(zip(DEVIATIONS, (one, one, other, other), strict=True))
    return Table(
        file=str(file),
        names=np.array(pair_names(left, right), object),
        begins=common.begins,
        points=points[point[common.one]].astype(object),
        numbers=table,
        lines=np.array([rows[k].line for k in common.one]),
        photos=(left.astype(object), right.astype(object)),
    )


def pair_names(left: Iterable[str], right: Iterable[str]) -> list[str]:
    """LEFT-RIGHT, or with another mark where the photos have a hyphen in their names."""
    both = list(zip(left, right, strict=True))
    used = "".join(map("".join, both))
    mark = next((mark for mark in "-_+" if mark not in used), "-")
    return [f"{one}{mark}{other}" for one, other in both]
