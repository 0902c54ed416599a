"""Tables with one row for each place, `photo,point,x,y`, as tables of pairs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..block.photo_pairs import FEWEST, choose_pairs, common_points
from ..exchange import files
from ..tables import images, whole
from ..tables.fields import TableError
from ..tables.measured import COORDINATES, DEVIATIONS, Table


def are_in(file: Path | None) -> bool:
    """Whether a file of the user has a row for each place. Raises TableError where it
    cannot be read."""
    if file is None or whole.is_parquet(file) or files.is_of_other_program(file):
        return False
    return images.are_places(file)


def read(file: Path) -> Table:
    """The pairs of the photos of a table of places that have points in common: of each
    photo those with the most. Raises TableError."""
    rows = images.read_places(file)
    names = lambda column: np.unique(
        [row.cells[column] for row in rows], return_inverse=True
    )
    (photos, photo), (points, point) = names("image"), names("point")
    common = choose_pairs(common_points(photo, point, len(photos)), len(photos))
    if not len(common.left):
        raise no_pairs(file, len(photos))
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


def no_pairs(file: Path, photos: int) -> TableError:
    """What to say of photos that have no points in common."""
    return TableError(
        file,
        found=f"no two of {photos} photos with {FEWEST} points in common",
        expected="the same name for the same point on all photos",
    )
