"""Measured points of many pairs as columns: what CSV and Parquet tables are read into.

Columns of names are NumPy arrays of Python objects where the table is CSV text, Arrow
arrays where it is Parquet; numbers are NumPy arrays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from ..batches.copies import without_copies
from ..batches.ragged import Ragged
from ..geometry.cofactor_roots import covariances_of, from_covariances
from ..geometry.pairs import Camera, Pair
from .fields import Columns, TableError

COORDINATES = ("x_left", "y_left", "x_right", "y_right")

PHOTOS = ("left", "right")
"""Columns with the names of the photos of a pair."""

DEVIATIONS = tuple(f"sigma_{name}" for name in COORDINATES)
"""Columns with a standard deviation for each coordinate, in place of sigma."""

COVARIANCES = ("cov_xy_left", "cov_xy_right")
"""Columns with the covariances of x and y of a photo, beside the deviations."""

SCORE = "score"
"""Column that tells how likely a match is right, the higher the likelier."""

VERDICTS = {0: "rejected", 1: "kept", 2: "undecided"}
"""What a procedure may have decided about a point."""

OF_CLEANING = ("verdict", "order", "statistic", "limit", "q")
"""Columns that say so in a table of cleaned pairs."""

NAMED = 5
"""Points that a warning names."""

COLUMNS = Columns(
    ("point", *COORDINATES),
    ("pair", *PHOTOS, "sigma", *DEVIATIONS, *COVARIANCES, SCORE),
    {"id": "point", "xl": "x_left", "yl": "y_left", "xr": "x_right", "yr": "y_right"},
    texts=("pair", "point", *PHOTOS),
    results=OF_CLEANING,
)
NUMBERS = (*COORDINATES, "sigma", *DEVIATIONS, *COVARIANCES, SCORE)

CameraPairs = tuple[Camera, Camera] | list[tuple[Camera, Camera]]
"""(left, right) of all pairs, or of each."""


@dataclass
class Measurements:
    """The measured points of one pair; `lines` are their lines in the file. `photos`:
    the names of the left and the right one, () where the table has none. `numbers`: the
    names of the columns of the rows."""

    name: str
    points: list[str] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    photos: tuple[str, ...] = ()
    numbers: tuple[str, ...] = NUMBERS[:5]

    @property
    def coordinates(self) -> Float[np.ndarray, "4 point"]:
        """x_left, y_left, x_right, y_right"""
        return np.asarray(self.rows, np.float64)[:, :4].T

    @property
    def sigma(self) -> Float[np.ndarray, " point"] | None:
        """Standard deviations of the coordinates, where the table has them."""
        rows = np.asarray(self.rows, np.float64)
        there = "sigma" in self.numbers and rows.shape[1] > 4
        return rows[:, 4] if there else None


@dataclass(frozen=True)
class Table:
    """The points of pairs one behind the other: pair k has the rows `begins[k]` to
    `begins[k + 1]`.

    `names` of the pairs; `points` and `numbers` of the rows, by the names of `NUMBERS`;
    `lines` of the rows in CSV text; `photos`: the names of the left and of the right
    photo of each pair, where the table has them; `warnings`: what a careful reader
    should be told. `relative`: only the ratios of the standard deviations in `numbers`
    are known, which then are those for a sigma of 1.
    """

    file: str
    names: Any
    begins: Int[np.ndarray, " begins"]
    points: Any
    numbers: dict[str, Any]
    lines: Int[np.ndarray, " row"] | None = None
    photos: tuple[Any, Any] | None = None
    warnings: tuple[str, ...] = ()
    relative: bool = False

    @property
    def has_sigma(self) -> bool:
        """Whether the table tells the standard deviations of the coordinates."""
        there = "sigma" in self.numbers or self.has_covariances
        return there and not self.relative

    @property
    def has_covariances(self) -> bool:
        """Whether the table has the columns DEVIATIONS."""
        return DEVIATIONS[0] in self.numbers

    @property
    def lengths(self) -> Int[np.ndarray, " pair"]:
        """Points of every pair."""
        return np.diff(self.begins)

    @cached_property
    def owners(self) -> Int[np.ndarray, " row"]:
        """The number of the pair of every row."""
        return np.repeat(np.arange(len(self.begins) - 1), self.lengths)

    @property
    def photos_of_rows(self) -> dict[str, Any]:
        """The names of both photos of every row, by the names of their columns; nothing
        where the table does not name photos."""
        if self.photos is None:
            return {}
        columns = (take(of_pairs, self.owners) for of_pairs in self.photos)
        return dict(zip(PHOTOS, columns, strict=True))

    def with_one_sigma(self) -> "Table":
        """The table with one standard deviation for each point, for what cannot use
        more: the root of the mean of its variances. Adds a warning."""
        if not self.has_covariances:
            return self
        squares = [to_floats(self.numbers[name]) ** 2 for name in DEVIATIONS]
        sigma = np.sqrt(np.mean(squares, axis=0))
        most = float(np.nanmax(np.sqrt(np.max(squares, axis=0)) / sigma))
        kept = (*COORDINATES, SCORE)
        others = {n: c for n, c in self.numbers.items() if n in kept}
        warning = (
            f"{self.file}: each point is used with one standard deviation, the mean of "
            f"its coordinates; that of a single coordinate is up to {most:.3g} times it."
        )
        return replace(
            self,
            numbers=others | {"sigma": sigma},
            warnings=(*self.warnings, warning),
        )

    def with_sigma(self, sigma: float | None) -> "Table":
        """The table with standard deviations in place of relative ones, whose unit is
        `sigma`; as it is where nothing is relative or the unit is not known."""
        if sigma is None or not self.relative:
            return self
        units = dict.fromkeys(("sigma", *DEVIATIONS), sigma)
        units |= dict.fromkeys(COVARIANCES, sigma**2)
        numbers = {
            name: to_floats(column) * units[name] if name in units else column
            for name, column in self.numbers.items()
        }
        if not self.has_covariances:
            numbers.setdefault("sigma", np.full(len(self.points), sigma, float))
        return replace(self, numbers=numbers, relative=False)

    def first_line(self, number: int) -> int | None:
        """The line of the first point of a pair, in CSV text."""
        return None if self.lines is None else int(self.lines[self.begins[number]])

    @property
    def pairs(self) -> list[Measurements]:
        """The pairs of CSV text one by one."""
        rows = list(zip(*(self.numbers[n].tolist() for n in self.numbers), strict=True))
        points = self.points.tolist()
        lines = [] if self.lines is None else self.lines.tolist()
        spans = zip(self.begins[:-1].tolist(), self.begins[1:].tolist(), strict=True)
        return [
            Measurements(
                str(name),
                points[a:b],
                rows[a:b],
                lines[a:b],
                numbers=tuple(self.numbers),
            )
            for name, (a, b) in zip(self.names.tolist(), spans, strict=True)
        ]

    def choose(self, rows: Int[np.ndarray, " some"]) -> "Table":
        """These rows of all pairs; a pair may have none left."""
        counts = np.bincount(self.owners[rows], minlength=len(self.begins) - 1)
        return replace(
            self,
            begins=np.concatenate([[0], np.cumsum(counts)]),
            points=take(self.points, rows),
            numbers={name: take(column, rows) for name, column in self.numbers.items()},
            lines=None if self.lines is None else self.lines[rows],
        )


def take(column: Any, rows: np.ndarray) -> Any:
    """These rows of a column of NumPy or Arrow."""
    return column[rows] if isinstance(column, np.ndarray) else column.take(rows)


def to_list(column: Any) -> list[Any]:
    """The values of a column of NumPy or Arrow as Python objects."""
    return column.tolist() if isinstance(column, np.ndarray) else column.to_pylist()


def of_pairs(
    pairs: Sequence[Measurements], file: str = "", warnings: Sequence[str] = ()
) -> Table:
    """Pairs one by one as columns."""
    rows = np.array([row for pair in pairs for row in pair.rows], np.float64)
    names = pairs[0].numbers if pairs else NUMBERS
    photos = None
    if pairs and pairs[0].photos:
        left, right = zip(*(pair.photos for pair in pairs), strict=True)
        photos = np.array(left, object), np.array(right, object)
    return Table(
        file=file,
        names=np.array([pair.name for pair in pairs], object),
        begins=np.cumsum([0] + [len(pair.points) for pair in pairs]),
        points=np.array([point for pair in pairs for point in pair.points], object),
        numbers=dict(zip(names, rows.T.copy(), strict=False)),
        lines=np.array([line for pair in pairs for line in pair.lines], int),
        photos=photos,
        warnings=tuple(warnings),
    )


def to_ragged(table: Table, cameras: CameraPairs, sigma: float | None = None) -> Ragged:
    """The points in photo coordinates, by the arithmetic of `Camera.to_photo`.

    `sigma`: standard deviation of all coordinates in the unit of the table, where the
    table has no column of it; without both it is 1. Where the table has relative ones
    they are multiplied by it. Missing numbers are NaN. Points that repeat another one
    are masked.
    """
    count, pairs = len(table.points), len(table.begins) - 1

    def constant(side: int, value: Any) -> Any:
        """A number of the camera of one side, for all rows or for each."""
        if isinstance(cameras, tuple):
            return value(cameras[side])
        each = np.array([value(both[side]) for both in cameras], np.float64)
        return np.repeat(each, table.lengths)

    photo = []
    for side, (u, v) in enumerate((COORDINATES[:2], COORDINATES[2:])):
        size, sign = constant(side, _size), constant(side, _sign)
        x0 = constant(side, lambda c: c.principal_point[0])
        y0 = constant(side, lambda c: c.principal_point[1])
        photo += [
            (to_floats(table.numbers[u]) - x0) * size,
            (to_floats(table.numbers[v]) - y0) * (sign * size),
        ]
    deviation, roots = np.ones(count), None
    unit = 1.0 if sigma is None or not table.relative else sigma
    if table.has_covariances:
        both = [
            _covariances(table, side, *(constant(side, f) for f in (_size, _sign)))
            for side in (0, 1)
        ]
        deviation, roots = from_covariances(*both)
        deviation = deviation * unit
    elif "sigma" in table.numbers or sigma is not None:
        given = (
            to_floats(table.numbers["sigma"]) * unit
            if "sigma" in table.numbers
            else np.full(count, sigma, float)
        )
        deviation = given * constant(0, _size)
    each = [cameras] * pairs if isinstance(cameras, tuple) else cameras
    focal_left, focal_right = np.array(
        [(left.focal, right.focal) for left, right in each], np.float64
    ).T.copy()
    ragged = Ragged(
        begins=table.begins,
        x_left=photo[0],
        y_left=photo[1],
        x_right=photo[2],
        y_right=photo[3],
        sigma=deviation,
        mask=np.ones(count, bool),
        focal_left=focal_left,
        focal_right=focal_right,
        roots=roots,
        score=to_floats(table.numbers[SCORE]) if SCORE in table.numbers else None,
    )
    return without_copies(ragged)


def tell_copies(table: Table, pairs: Ragged) -> Table:
    """The table with a warning that names the points that repeat another one, which
    `to_ragged` has masked."""
    rows = np.flatnonzero(~pairs.mask)
    if not rows.size:
        return table
    first = rows[:NAMED]
    points = map(str, to_list(take(table.points, first)))
    if len(table.names) > 1:
        pairs_of = to_list(take(table.names, table.owners[first]))
        points = (f"{p} of {pair}" for p, pair in zip(points, pairs_of, strict=True))
    named = ", ".join(points) + (", ..." if rows.size > NAMED else "")
    which = "1 point repeats" if rows.size == 1 else f"{rows.size} points repeat"
    warning = (
        f"{table.file}: {which} another point of the pair ({named}): the same place of "
        "both photos is one measurement, and counts once."
    )
    return replace(table, warnings=(*table.warnings, warning))


def _size(camera: Camera) -> float:
    """The size of a pixel."""
    return camera.pixel_size


def _sign(camera: Camera) -> float:
    """-1 where rows count downwards."""
    return -1.0 if camera.y_down else 1.0


def _covariances(
    table: Table, side: int, size: Any, sign: Any
) -> Float[np.ndarray, "row 2 2"]:
    """The covariance matrices of (x, y) in the photos of one side, in photo units."""
    x, y = (to_floats(table.numbers[n]) * size for n in DEVIATIONS[2 * side :][:2])
    xy = np.zeros(len(x))
    if COVARIANCES[side] in table.numbers:
        xy = to_floats(table.numbers[COVARIANCES[side]]) * (sign * size**2)
    return covariances_of(x, y, xy)


def check_accuracy(columns: Sequence[str], file: str, line: int | None = None) -> None:
    """Raises TableError where the columns that tell the accuracy of the coordinates do
    not go together."""
    there = [name for name in DEVIATIONS if name in columns]
    covariances = [name for name in COVARIANCES if name in columns]
    if not there and not covariances:
        return
    expected = f"sigma, or all of {', '.join(DEVIATIONS)}"
    if "sigma" in columns:
        found = "it beside the column sigma"
    elif len(there) < len(DEVIATIONS):
        missing = next(name for name in DEVIATIONS if name not in columns)
        found = f"it without {missing}"
    else:
        return
    column = (there or covariances)[0]
    raise TableError(file, line=line, column=column, found=found, expected=expected)


def one_pair(pairs: Ragged, number: int) -> Pair:
    """A pair of `pairs`, not padded, as JAX arrays."""
    rows = slice(int(pairs.begins[number]), int(pairs.begins[number + 1]))
    own = pairs[1:7], (pairs.roots, pairs.score)
    of_points, of_some = jax.tree.map(lambda a: a[rows], own)
    focals = pairs.focal_left[number], pairs.focal_right[number]
    return Pair(*jax.device_put([*of_points, *focals, *of_some]))


def to_floats(column: Any) -> Float[np.ndarray, " row"]:
    """The numbers of a column of NumPy or Arrow, NaN where one is missing."""
    if not isinstance(column, np.ndarray):
        column = column.cast("float64", safe=False).to_numpy()
    return np.asarray(column, np.float64)
