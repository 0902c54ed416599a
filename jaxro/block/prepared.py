"""The problem of a block at its approximate values, in the units of the engine."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..adjustment.sparse import DatumOf, Minimum, Problem, prepare, trimmed
from ..camera.condition import Station
from ..camera.inner import Inner
from .bars import Bars, bar_terms, no_bars
from .cameras import cameras_of
from .datum import free_datum
from .given import Given
from .measured_block import Ground, MeasuredBlock
from .network import (
    Frame,
    KnownCoordinates,
    Numbered,
    Start,
    complete,
    frame_of,
    in_order,
    known_of,
    number_points,
    terms_of,
)


class Prepared(NamedTuple):
    """What is to be adjusted: the problem of the engine, and where its numbers come
    from; `bar_rows`: the bars that take part."""

    block: MeasuredBlock
    ground: Ground | None
    frame: Frame
    numbered: Numbered
    known: tuple[KnownCoordinates, ...]
    inner: Inner | None
    bars: Bars | None
    bar_rows: Int[np.ndarray, " used"]
    problem: Problem
    datum: DatumOf | None

    def start_at(self, found: Minimum) -> Start:
        """The stations and points of a minimum, to begin another adjustment with."""
        families = trimmed(found.problem.data.families, found.problem.members)
        return start_of(
            self.frame,
            self.numbered,
            families["photo"],
            families["point"],
            families.get("camera"),
        )


def start_of(
    units: Frame,
    numbered: Numbered,
    station: Station,
    points: np.ndarray,
    inner: np.ndarray | None,
) -> Start:
    """Stations and points of an adjustment on the ground."""
    return Start(
        quaternions=np.asarray(station.quaternion),
        centres=units.outside(station.centre),
        points=numbered.spread(units.outside(points)),
        inner=None if inner is None else np.asarray(inner),
    )


def prepare_block(
    given: Given, start: Start, left_out: Bool[np.ndarray, " ray"] | None = None
) -> Prepared:
    """The problem of a block at its approximate values, some rays left out."""
    block, ground, inner, bars = given
    units = frame_of(start)
    known = known_of(block, given.known)
    use = np.ones(len(block.photo), bool) if left_out is None else ~left_out
    # a known point on one photo begins where it is known to be
    points, of_points = start.points.copy(), known.take(~known.station)
    at = of_points.number, of_points.axis
    points[at] = np.where(np.isnan(points[at]), of_points.value, points[at])
    points = complete(block, start, points)
    there = np.all(np.isfinite(points), axis=1)
    number = known.of_points(len(block.points))
    numbered = number_points(block, number, use & there[block.point])
    parts = in_order(known, numbered)
    inside = units.inside(start.centres)
    stations = Station(*jax.device_put((start.quaternions, inside)))
    points = units.inside(points[numbered.number >= 0])
    families = {"photo": stations, "point": points}
    if inner is not None:
        cameras = cameras_of(block).number
        zero = np.zeros((cameras, inner.count))
        families["camera"] = zero if start.inner is None else start.inner
    terms = terms_of(block, numbered, parts, units, inner)
    rows, between = bars_in(bars, block, numbered)
    if len(rows):
        assert bars is not None
        families["end"] = points[between[1]]
        spread = float(np.median(block.sigma / block.focal[block.photo]))
        lengths = bars.length[rows] / units.length, bars.sigma[rows] / units.length
        terms = *terms, *bar_terms(between, *lengths, spread)
    problem = prepare(terms, families, eliminate="point", linked="photo")
    datum = None
    if not parts:
        distance = _distance(block, numbered, inside, points)
        datum = free_datum(stations, distance, has_scale=len(rows) > 0)
    return Prepared(
        block=block,
        ground=ground,
        frame=units,
        numbered=numbered,
        known=parts,
        inner=inner,
        bars=bars,
        bar_rows=rows,
        problem=problem,
        datum=datum,
    )


def _distance(
    block: MeasuredBlock,
    numbered: Numbered,
    centres: Float[np.ndarray, "photo 3"],
    points: Float[np.ndarray, "some 3"],
) -> float:
    """The median distance from photos to the points that they show."""
    used = numbered.rays
    shown = points[numbered.number[block.point[used]]]
    apart = shown - centres[block.photo[used]]
    return float(np.median(np.linalg.norm(apart, axis=1)))


def bars_in(
    bars: Bars | None, block: MeasuredBlock, numbered: Numbered
) -> tuple[Int[np.ndarray, " used"], tuple[np.ndarray, np.ndarray]]:
    """The rows of the bars that take part, with a length between points of the
    adjustment, and the numbers of these there."""
    bars = no_bars() if bars is None else bars
    ends = bars.numbers_in(block)
    of = lambda point: np.where(point < 0, -1, numbered.number[np.maximum(point, 0)])
    one, other = map(of, ends)
    rows = np.flatnonzero((one >= 0) & (other >= 0) & np.isfinite(bars.length))
    return rows, (one[rows], other[rows])
