"""Lines of the tables of a survey, and whether they fit together: scales of the squares,
readings, legs."""

from typing import Any, NamedTuple

import numpy as np

from ..surveys.networks import unconnected_points
from .fields import TableError

FOCAL = (3.0, 2000.0)
"""mm: what H l / L, the focal length, may be; outside it some length has another
unit."""
SCALE = 1.5
"""Factor by which squares of one photo may differ in scale."""


class Row(NamedTuple):
    """One line of a file: its number, and what stands in each column (None where an
    optional field is empty)."""

    file: str
    line: int
    cells: dict[str, Any]

    def error(self, column: str, *, found: str, expected: str) -> TableError:
        """The error of a field of this line."""
        return TableError(
            self.file, line=self.line, column=column, found=found, expected=expected
        )


def check_scale(grid: list[Row], camera_height: float) -> None:
    """All squares below the cameras, and in the scales of one camera."""
    focal = []
    for row in grid:
        datum = row.cells.get("height") or 0.0
        if datum >= camera_height:
            raise row.error(
                "height",
                found=repr(datum),
                expected=f"less than the camera height of {camera_height:g}, which "
                "counts from the same zero",
            )
        scale = row.cells["photo_side"] / row.cells["side"]
        focal.append(scale * (camera_height - datum))
    usual = float(np.median(focal))
    for row, one in zip(grid, focal, strict=True):
        if not usual / SCALE < one < usual * SCALE:
            side = row.cells["photo_side"]
            raise row.error(
                "photo_side",
                found=f"{side!r}, so a focal length of {one:.4g} mm",
                expected=f"that of the other squares, {usual:.4g} mm",
            )
    if not FOCAL[0] < usual < FOCAL[1]:
        raise TableError(
            grid[0].file,
            column="photo_side",
            found=f"squares of a photo with a focal length of {usual:.4g} mm",
            expected="side, photo_side, --camera-height all in mm, heights and "
            "--camera-height from one zero",
        )


def check_reading(
    row: Row, column: str, grid: float, p_c: float, camera_height: float
) -> None:
    """A point between half the camera height over the grid and the whole below it."""
    reading = row.cells[column]
    dp = reading - grid
    expected = "a reading in mm, from the same zero as those of the grid"
    if reading == 0 and abs(dp) > p_c / 2:
        found = "a reading of 0"
        expected = "the reading of the point; delete the line without"
    elif p_c + dp <= 0:
        found = (
            f"{reading!r}, {-dp:.4g} mm less than the grid's {grid!r}: no point has "
            f"the parallax {p_c + dp:.4g}"
        )
    else:
        h = camera_height * dp / (p_c + dp)
        if -camera_height < h < camera_height / 2:
            return
        found = (
            f"{reading!r} where the grid has {grid!r}: a point {abs(h):.4g} mm "
            f"{'over' if h > 0 else 'below'} it"
        )
    raise row.error(column, found=found, expected=expected)


def check_legs(
    legs: list[Row],
    start: list[int],
    end: list[int],
    known: np.ndarray,
    names: list[str],
) -> None:
    """Legs that lead somewhere, one behind the other, from points of known height."""
    last: dict[str, str] = {}
    for row, a, b in zip(legs, start, end, strict=True):
        if a == b:
            expected = "another point than the leg comes from"
            raise row.error("to", found=repr(names[b]), expected=expected)
        name = row.cells["traverse"]
        if last.get(name, names[a]) != names[a]:
            before = f"where the leg before it of traverse {name!r} ends"
            raise row.error(
                "from", found=repr(names[a]), expected=f"{last[name]!r}, {before}"
            )
        last[name] = names[b]
    used = np.unique([start, end])
    first, second = (np.searchsorted(used, points) for points in (start, end))
    lost = set(used[unconnected_points(first, second, known[used])].tolist())
    for row, a in zip(legs, start, strict=True):
        if a in lost:
            raise row.error(
                "from",
                found=f"{names[a]!r}, which no legs join to a known height",
                expected="a corner of the grid, or a point with a known height",
            )
    if known[used].all():
        raise TableError(
            legs[0].file,
            line=legs[0].line,
            found="legs between known heights alone",
            expected="points whose heights are sought",
        )
