"""What a user asks of `jaxro block`, and the block that is read for it."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..batches.ragged import Ragged
from ..block.bars import Bars
from ..block.cameras import MOST_FIELDS, cameras_of
from ..block.measured_block import (
    Ground,
    MeasuredBlock,
    TwoPoints,
    add_rays,
    from_pairs,
    ground as known_points,
)
from ..camera.inner import Inner, names_of
from ..geometry.pairs import Camera
from ..tables import (
    bars as bar_tables,
    ground as ground_tables,
    images,
)
from ..tables.cameras import Cameras
from ..tables.examples import block as example
from ..tables.fields import TableError
from ..tables.ground import GroundPoints
from ..tables.measured import Table, to_list
from . import block_places, request
from .block_pairs import is_sigma_given, measure, read_pairs
from .block_places import in_photos
from .places import are_in, pair_names

RADIAL = ("k1", "k2", "k3")
INNER = names_of(Inner(True, True, len(RADIAL), True, True, True))
"""Inner parameters by the names of --inner; those of Brown stand for all below them."""

EXACT = 1e-3
"""The standard deviation of a coordinate without error, as a part of the smallest other
one: weights are inverses of variances."""


@dataclass(frozen=True)
class Options:
    """What the user asked for; None where nothing was said."""

    measured: request.Options
    control: Path | None = None
    control_sigma: float | None = None
    rays: Path | None = None
    bars: Path | None = None
    inner: str | None = None
    datum: str | None = None
    components: bool = False
    conditions: bool = False
    classical: bool = False
    level: float = 0.05
    unit: str = "m"
    parquet: bool = False
    strips: int | None = None
    models: int | None = None
    seed: int | None = None

    @property
    def simulated(self) -> dict[str, int]:
        """What was said of a simulated block."""
        said = {"strips": self.strips, "models": self.models, "seed": self.seed}
        return {name: value for name, value in said.items() if value is not None}

    @property
    def read(self) -> tuple[Path | None, ...]:
        """The files that are read."""
        own = self.measured
        return own.file, own.camera, self.control, self.rays, self.bars


@dataclass(frozen=True)
class Task:
    """A block to be oriented, read and checked. `left`, `right`: the photos of each
    pair; `points`: the names of the rows of `pairs`; `more`: the block with further
    rays; `sigma` in words, and whether it was given (`sigma_known`); `approximate`:
    points of the ground that are no more; `cameras` of the photos of `more`."""

    title: str
    names: list[str]
    left: list[str]
    right: list[str]
    pairs: Ragged
    points: list[str]
    sigma: str
    sigma_known: bool = True
    ground: Ground | None = None
    more: MeasuredBlock | None = None
    bars: Bars | None = None
    approximate: int = 0
    photo_unit: str = "mm"
    cameras: tuple[Camera, ...] = ()
    warnings: tuple[str, ...] = ()


def prepare(options: Options) -> tuple[Task, dict[str, str | bytes]]:
    """Everything read and checked, and of a simulated block its tables. Raises
    TableError."""
    _check(options)
    if options.measured.file is None:
        return _simulate(options)
    if are_in(options.measured.file):
        return _of_places(options), {}
    own, table, cameras = read_pairs(options.measured)
    left, right = cameras.photos_of(
        table.names, table.file, given=table.photos, place=table.first_line
    )
    pairs, told = measure(own, table, cameras)
    ground, approximate = _control(options)
    task = Task(
        title=table.file,
        names=list(map(str, to_list(table.names))),
        left=left,
        right=right,
        pairs=pairs,
        points=list(map(str, to_list(table.points))),
        sigma=told,
        sigma_known=is_sigma_given(own, table),
        ground=ground,
        bars=_bars(options),
        approximate=approximate,
        photo_unit=own.unit,
        warnings=table.warnings,
    )
    return _with_rays(task, options, table, cameras), {}


def _of_places(options: Options) -> Task:
    """The task of a table with a row for each place. Raises TableError."""
    if options.rays is not None:
        raise TableError(
            "--rays",
            found=f"it beside {options.measured.file}, a table of places itself",
            expected="all places in one table",
        )
    are_unknown = options.inner is not None
    measured = block_places.read(options.measured, are_unknown=are_unknown)
    block, common = measured.block, measured.common
    _check_fields(options, block)
    ground, approximate = _control(options)
    name = lambda photos: [block.photos[k] for k in photos]
    left, right = name(common.left), name(common.right)
    return Task(
        title=str(options.measured.file),
        names=pair_names(left, right),
        left=left,
        right=right,
        pairs=common.as_pairs(block),
        points=[block.points[k] for k in block.point[common.one]],
        sigma=measured.sigma,
        sigma_known=measured.sigma_known,
        ground=ground,
        more=block,
        cameras=measured.cameras,
        bars=_bars(options),
        approximate=approximate,
        photo_unit=options.measured.unit,
    )


def _control(options: Options) -> tuple[Ground | None, int]:
    """What is known of the ground, and how many points are approximate only. Raises
    TableError."""
    if options.control is None:
        return None, 0
    roles = *ground_tables.ROLES, ground_tables.STATION
    points = ground_tables.read(options.control, roles)
    return _ground(points, options.control_sigma)


def _check(options: Options) -> None:
    """Raises TableError for options that do not go together."""
    own = options.measured
    value = options.control_sigma
    if value is not None and not (math.isfinite(value) and value > 0):
        raise TableError(
            "--control-sigma", found=repr(value), expected="a positive number"
        )
    inner_of(options.inner)
    if options.datum is not None and (options.control is not None or own.file is None):
        beside = "--control" if options.control is not None else "no table"
        raise TableError(
            "--datum",
            found=f"it beside {beside}",
            expected="a free network: known points hold the others",
        )
    for name, asked in (
        ("--conditions", options.conditions),
        ("--classical", options.classical),
    ):
        if asked and (options.inner is not None or options.bars is not None):
            raise TableError(
                name,
                found="it beside --inner or --bars",
                expected="one of them: it knows photos, points and control alone",
            )
    if options.classical and options.control is None and own.file is not None:
        raise TableError(
            "--classical", found="it without --control", expected="--control GROUND.csv"
        )
    if not 0 < options.level < 1:
        raise TableError(
            "--level", found=repr(options.level), expected="a probability such as 0.05"
        )
    if options.control is None and options.bars is None and value is not None:
        raise TableError(
            "--control-sigma",
            found="it without --control",
            expected="the points that it belongs to, --control GROUND.csv",
        )
    if own.file is None:
        given = {
            "--control": options.control,
            "--rays": options.rays,
            "--bars": options.bars,
            "--camera": own.camera,
            "--focal": own.focal,
            "--sigma": own.sigma,
        }
        for name, value in given.items():
            if value is not None:
                raise TableError(
                    name,
                    found="it without PAIRS.csv",
                    expected="the pairs that it belongs to",
                )
    for name in options.simulated if own.file is not None else ():
        raise TableError(
            f"--{name}",
            found="it beside a table",
            expected="it without a table, for a simulated block",
        )


def inner_of(given: str | None) -> Inner | None:
    """The inner parameters that are unknown, by their names. Raises TableError."""
    if given is None:
        return None
    names = {name.strip() for name in given.split(",")}
    if strange := names - set(INNER):
        raise TableError(
            "--inner",
            found=repr(sorted(strange)[0]),
            expected=f"some of {','.join(INNER)}",
        )
    radial = max((RADIAL.index(name) + 1 for name in names & set(RADIAL)), default=0)
    return Inner(
        focal="focal" in names,
        principal="principal" in names,
        radial=radial,
        tangential="tangential" in names,
        affinity="affinity" in names,
        field="field" in names,
    )


def _check_fields(options: Options, block: MeasuredBlock) -> None:
    """Raises TableError where more cameras are to have a displacement field than can."""
    inner, number = inner_of(options.inner), cameras_of(block).number
    if inner is not None and inner.field and number > MOST_FIELDS:
        raise TableError(
            "--inner",
            found=f"field for {number} cameras",
            expected=f"at most {MOST_FIELDS} cameras with a displacement field",
        )


def _bars(options: Options) -> Bars | None:
    """The scale bars. Raises TableError."""
    if options.bars is None:
        return None
    return bar_tables.read(options.bars, options.control_sigma)


def _ground(points: GroundPoints, sigma: float | None) -> tuple[Ground, int]:
    """What is known of the ground, and how many points are approximate only. Raises
    TableError without standard deviations."""
    deviations = points.deviations
    if deviations is None and sigma is None:
        raise TableError(
            points.file,
            found="no standard deviations",
            expected="the columns sX, sY, sZ or sigma, or --control-sigma SD: weights "
            "are inverses of variances",
        )
    if deviations is not None and sigma is not None:
        raise TableError(
            "--control-sigma",
            found=f"it beside the standard deviations of {points.file}",
            expected="only one of the two",
        )
    use = np.flatnonzero(~points.is_a("approximate"))
    at = points.coordinates[use]
    spread = np.full(at.shape, sigma) if deviations is None else deviations[use]
    positive = spread[spread > 0]
    least = float(np.min(positive)) if positive.size else 1.0
    spread = np.where(spread == 0, EXACT * least, spread)
    names = [points.names[k] for k in use]
    checks, stations = (
        points.is_a(role)[use] for role in ("check", ground_tables.STATION)
    )
    known = known_points(names, at, spread, checks, stations)
    return known, len(points.names) - len(use)


def _with_rays(task: Task, options: Options, table: Table, cameras: Cameras) -> Task:
    """The task with the rays of --rays. Raises TableError."""
    try:
        block = from_pairs(task.left, task.right, task.pairs, task.points)
    except TwoPoints as error:
        raise _twice(error, task, table, cameras) from None
    except ValueError as error:
        raise TableError(
            table.file,
            found=str(error).removeprefix("from_pairs: "),
            expected="one camera for each photo",
        ) from None
    _check_fields(options, block)
    own = map(cameras.of_photo, block.photos)
    task = replace(task, cameras=tuple(one for one in own if one is not None))
    if options.rays is None:
        return replace(task, more=block)
    rows = images.read_places(options.rays)
    places, sigma = in_photos(rows, cameras)
    sigma = np.where(np.isnan(sigma), np.median(task.pairs.sigma), sigma)
    photos = [row.cells["image"] for row in rows]
    for row in rows:
        if row.cells["image"] not in block.photos:
            raise row.error(
                "photo",
                found=repr(row.cells["image"]),
                expected=f"a photo of {table.file}",
            )
    points = [row.cells["point"] for row in rows]
    try:
        more = add_rays(block, photos, points, places, sigma)
    except TwoPoints as error:
        raise TableError(
            options.rays, found=str(error), expected="each name for one point"
        ) from None
    warnings = task.warnings
    if again := len(block.photo) + len(rows) - len(more.photo):
        warnings += (
            f"{options.rays}: {again} of {len(rows)} places stand in {table.file} or in "
            "an earlier line already: the same place is one measurement, and counts "
            "once.",
        )
    return replace(task, more=more, warnings=warnings)


def _twice(error: TwoPoints, task: Task, table: Table, cameras: Cameras) -> TableError:
    """Where two places of a photo have one name."""
    begins, points = table.begins, task.points
    lines = []
    for k, photos in enumerate(zip(task.left, task.right, strict=True)):
        if error.photo in photos:
            rows = range(int(begins[k]), int(begins[k + 1]))
            lines += [row for row in rows if points[row] == error.point]
    line = None
    if table.lines is not None and lines:
        line = int(table.lines[lines[-1]])
    return TableError(
        table.file,
        line=line,
        column="point",
        found=f"{error.point!r} for two places of photo {error.photo!r} that are "
        f"{error.apart:.3g} apart (of {len(lines)} lines)",
        expected="one name for one point in all pairs; rename one of the two, or delete "
        "the wrong line",
    )


# -------------------------------------------------------------------------------------
# a simulated block


def _simulate(options: Options) -> tuple[Task, dict[str, str | bytes]]:
    """A simulated block as a task, and as the tables that a user would have."""
    made = example.simulate(**options.simulated)
    task = Task(
        title="a simulated flight",
        names=made.names,
        left=made.left,
        right=made.right,
        pairs=made.pairs,
        points=made.points,
        sigma="to the given standard deviations",
        ground=made.ground,
    )
    return task, dict(made.tables())


def some_of(names: list[str], most: int = 5) -> str:
    """The first names of a list."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")
