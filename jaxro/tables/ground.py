"""Tables of points on the ground: CSV text in, `GroundPoints` out, or one clear error.

point, X, Y, Z, blank where a coordinate is not known (X and Y, or Z, may have no column
at all); optionally sX, sY, sZ, or sigma for all (0: without error), and role:

control       it takes part in an adjustment (also where the field is blank)
check         the result is only compared with it
approximate   it may help to begin, no more
station       it is the projection centre of the photo of this name, of a block

Columns may have the names E, N, H and the like, sXY stands for sX and sY, and lists of
other programs are read as they are (`control_lists`).
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from . import control_lists, fields
from .fields import Columns, TableError
from .survey_checks import Row

AXES = ("x", "y", "z")
DEVIATIONS = ("sx", "sy", "sz")
PLAN = "sxy"
"""The deviation of both X and Y."""

ROLES = ("control", "check", "approximate")
STATION = "station"
SHORT = {"s_x": "sx", "s_y": "sy", "s_z": "sz"}
TEXTS = ("point", "role")
COORDINATES = "point,X,Y,Z, blank where a coordinate is not known; or X,Y or Z alone"
"""The columns of a table of points, as errors tell them."""

GROUND = Columns(
    ("point",),
    (*AXES, *DEVIATIONS, PLAN, "sigma", "role"),
    SHORT,
    texts=TEXTS,
    foreign=control_lists.SHORT,
)


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground with their names: `coordinates` X, Y, Z and their standard
    deviations, NaN where they are not known; `deviations` is None where the table has
    none. `roles` and `lines` of each point."""

    file: str
    names: list[str]
    coordinates: Float[np.ndarray, "point 3"]
    deviations: Float[np.ndarray, "point 3"] | None
    roles: list[str]
    lines: Int[np.ndarray, " point"]

    @property
    def known(self) -> Bool[np.ndarray, "point 3"]:
        """Which coordinates there are."""
        return np.isfinite(self.coordinates)

    def is_a(self, role: str) -> Bool[np.ndarray, " point"]:
        """Which points have a role."""
        return np.array([own == role for own in self.roles], bool)

    def error(
        self, point: int, column: str, *, found: str, expected: str
    ) -> TableError:
        """The error of a field of a point."""
        line = int(self.lines[point])
        return TableError(
            self.file, line=line, column=column, found=found, expected=expected
        )


def read(path: Path, roles: tuple[str, ...] = ROLES) -> GroundPoints:
    """The points of a file, and stations if their role is one of `roles`. Raises
    TableError."""
    return parse(fields.read_text(path), str(path), roles)


def parse(
    text: str,
    file: str,
    roles: tuple[str, ...] = ROLES,
) -> GroundPoints:
    """The points of CSV text. Raises TableError."""
    rows: list[Row] = []
    first: dict[tuple[str, bool], int] = {}
    line = 1
    table = control_lists.as_table(text, file)
    given = io.StringIO(table.text, newline="")
    for line, cells in fields.lines_of(given, file, GROUND, table.header):
        row = Row(file, line, dict(cells))
        _spread_plan(row)
        if not rows:
            _check_columns(row)
        name = fields.name(cells["point"], file, line, "point")
        # a photo may have the name of a point
        key = name, _role(row, roles) == STATION
        if key in first:
            raise row.error(
                "point",
                found=f"{name!r} a second time (first on line {first[key]})",
                expected="each point once, with all that is known of it on one line",
            )
        first[key] = line
        rows.append(row)
    if not rows:
        raise TableError(
            file,
            line=line + 1,
            found="no points",
            expected=f"{GROUND}, and one line for each point below them",
        )
    coordinates = np.array([_coordinates(row) for row in rows])
    has_deviations = any(c in rows[0].cells for c in (*DEVIATIONS, "sigma"))
    deviations = None
    if has_deviations:
        both = zip(rows, coordinates, strict=True)
        deviations = np.array([_deviations(row, known) for row, known in both])
    return GroundPoints(
        file=file,
        names=[name for name, _ in first],
        coordinates=coordinates,
        deviations=deviations,
        roles=[_role(row, roles) for row in rows],
        lines=np.array([row.line for row in rows]),
    )


def _spread_plan(row: Row) -> None:
    """Makes sX and sY of sXY. Raises TableError where there are both."""
    if PLAN not in row.cells:
        return
    for column in DEVIATIONS[:2]:
        if column in row.cells:
            raise TableError(
                row.file,
                column=column,
                found=f"it beside {PLAN}",
                expected="sXY, or sX and sY",
            )
        row.cells[column] = row.cells[PLAN]


def _check_columns(row: Row) -> None:
    """Raises TableError for coordinates or standard deviations of some axes only, or both
    kinds of these."""
    missing = [axis for axis in AXES if axis not in row.cells]
    if missing not in ([], ["z"], ["x", "y"]):
        raise TableError(
            row.file, column=missing[0], found="no such column", expected=COORDINATES
        )
    there = [column for column in DEVIATIONS if column in row.cells]
    wanted = [column for column in DEVIATIONS if column[1:] in row.cells]
    if there and "sigma" in row.cells:
        raise TableError(
            row.file,
            column="sigma",
            found=f"it beside {there[0]}",
            expected="sX, sY and sZ, or sigma for all three",
        )
    if there and (lost := [column for column in wanted if column not in there]):
        raise TableError(
            row.file,
            column=lost[0],
            found=f"no such column beside {there[0]}",
            expected="sX, sY and sZ, or sigma for all three",
        )


def _coordinates(row: Row) -> list[float]:
    """X, Y, Z, NaN where a field is blank. Raises TableError where all are."""
    found = [_number(row, axis) if row.cells.get(axis) else np.nan for axis in AXES]
    if np.all(np.isnan(found)):
        raise row.error(
            "x",
            found="three empty fields",
            expected="one coordinate at least; delete the line, or give X, Y, Z",
        )
    return found


def _deviations(row: Row, coordinates: np.ndarray) -> list[float]:
    """Standard deviations of the coordinates that are known. Raises TableError."""
    columns = ("sigma",) * 3 if "sigma" in row.cells else DEVIATIONS
    found = []
    for column, value in zip(columns, coordinates, strict=True):
        if np.isnan(value):
            found.append(np.nan)
            continue
        deviation = _number(row, column, "; 0 for a coordinate without error")
        if deviation < 0:
            raise row.error(
                column,
                found=repr(row.cells[column]),
                expected="a standard deviation, 0 or more, in the unit of the "
                "coordinates",
            )
        found.append(deviation)
    return found


def _role(row: Row, roles: tuple[str, ...]) -> str:
    given = row.cells.get("role", "").lower()
    if given and given not in roles:
        raise row.error(
            "role",
            found=repr(row.cells["role"]),
            expected=f"{', '.join(roles[:-1])} or {roles[-1]}; blank: {roles[0]}",
        )
    return given or roles[0]


def _number(row: Row, column: str, advice: str = "") -> float:
    return fields.number(row.cells[column], row.file, row.line, column, advice)
