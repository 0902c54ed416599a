"""The accuracy of a block before it is flown, and what further control would bring.

The covariance of an adjustment needs no measurements, only where they will be: from
planned stations and points follow the rays, and from these the normal equations, whose
inverse is the covariance for sigma0 = 1. With a further known point p, of which each
coordinate has the variance σ²,

    Q' = Q - Q_·p (Q_pp + σ² 1)⁻¹ Q_p·

for all points p at once, from their columns of Q.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from ..adjustment import RESULTS
from ..adjustment.sparse import Minimum
from .adjust import BlockAdjustment, conclude, prepare_block
from .given import Given
from .measured_block import Ground, MeasuredBlock
from .network import Start

COLUMNS = 384
"""Columns of the covariance that are made at once."""

LEAST_DEPTH = 1e-6
"""Part of the largest distance that a point is in front of a photo, at least."""


class Gains(NamedTuple):
    """What one further known point brings, for each point of the block as the further
    one: standard deviations of X, Y, Z of all points afterwards, their root mean square
    `rms` and the `largest`; NaN for points that are no candidates. `now`: both without
    a further point."""

    points: tuple[str, ...]
    rms: Float[np.ndarray, "point 3"]
    largest: Float[np.ndarray, "point 3"]
    now: Float[np.ndarray, "2 3"]

    @property
    def best(self) -> str:
        """The point that makes the mean variance of all coordinates smallest."""
        return self.points[int(np.nanargmin(np.sum(self.rms**2, axis=1)))]


def plan_rays(
    start: Start,
    photos: Sequence[str],
    points: Sequence[str],
    *,
    focal: Float[ArrayLike, "..."],
    half_sides: Float[ArrayLike, "..."],
    sigma: float,
) -> MeasuredBlock:
    """The block as it will be measured without errors: a ray wherever a point of the
    plan is in the frame of a photo.

    `photos`, `points`: the names of the stations and points of `start`; `focal` length,
    of all photos or of each; `half_sides` of the frame along x and y, or of a square;
    `sigma`: standard deviation of a coordinate; in one unit. Hills hide nothing. Raises
    ValueError where names and numbers do not agree, and where no photo shows a point.
    """
    from scipy.spatial.transform import Rotation

    if (len(photos), len(points)) != (len(start.centres), len(start.points)):
        raise ValueError(
            f"plan_rays: {len(photos)} photos and {len(points)} points are named, the "
            f"plan has {len(start.centres)} stations and {len(start.points)} points"
        )
    each = np.broadcast_to(np.asarray(focal, float), (len(photos),))
    sides = np.broadcast_to(np.asarray(half_sides, float), (2,))
    w, x, y, z = start.quaternions.T
    turns = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    found = []
    for k, (centre, turn) in enumerate(zip(start.centres, turns, strict=True)):
        inside = (start.points - centre) @ turn.T
        ahead = inside[:, 2] > LEAST_DEPTH * np.nanmax(np.abs(inside))
        depth = np.where(ahead, inside[:, 2], np.inf)[:, None]
        place = each[k] * inside[:, :2] / depth * np.array([1.0, -1.0])
        seen = np.flatnonzero(ahead & np.all(np.abs(place) <= sides, axis=1))
        found.append((np.full(len(seen), k), seen, *place[seen].T))
    photo, point, x, y = (np.concatenate(a) for a in zip(*found, strict=True))
    if len(photo) == 0:
        raise ValueError(
            "plan_rays: no photo shows any point: look at the rotations (object to "
            "camera, z forward), and at the units of focal length and frame"
        )
    return MeasuredBlock(
        photos=tuple(photos),
        points=tuple(points),
        photo=photo,
        point=point,
        x=x,
        y=y,
        sigma=np.full(len(photo), float(sigma)),
        focal=np.array(each),
    )


def plan_block(
    block: MeasuredBlock, start: Start, ground: Ground | None = None
) -> BlockAdjustment:
    """The adjustment that a block will have, with its standard deviations for sigma0 =
    1: everything that follows from a `BlockAdjustment`, of the planned stations and
    points. Of `ground` only the names, the standard deviations and which coordinates
    are known count; of `block` not the places. Residuals say nothing."""
    prepared = prepare_block(Given(block, ground), start)
    at_once = Minimum(prepared.problem, 0, RESULTS.successful)
    planned = conclude(prepared, at_once)
    return replace(planned, adjustment=replace(planned.adjustment, sigma0=1.0))


def where_control_helps(
    planned: BlockAdjustment,
    sigma: Float[ArrayLike, "..."],
    candidates: Sequence[str] | None = None,
) -> Gains:
    """The `Gains` of every point of the adjustment (or of the `candidates`) as a further
    known point with the standard deviation `sigma`, of each coordinate or of all; with
    an infinite one a coordinate stays unknown. The work grows with the number of
    candidates times that of points. Raises ValueError for a free network, and for
    candidates that are not in the adjustment.
    """
    planned.check()
    if planned.adjustment.datum is not None:
        raise ValueError(
            "where_control_helps: a free network has no place on the ground; plan the "
            "control that it needs first"
        )
    names, number = planned.block.points, planned.numbered.number
    tried = _candidates(planned, candidates)
    weight = _weight(sigma) * planned.frame.length**2
    variances = np.diagonal(planned.adjustment.cofactors["point"], axis1=1, axis2=2)
    members = number[tried]
    rms, largest = (np.full((len(names), 3), np.nan) for _ in range(2))
    all_points = planned.adjustment.rows({"point": range(len(variances))})
    cofactors, chunk = planned.adjustment.all_cofactors, COLUMNS // 3
    for begin in range(0, len(members), chunk):
        some = members[begin : begin + chunk]
        rows = planned.adjustment.rows({"point": some})
        unit = np.zeros((cofactors.number, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        columns = cofactors.times(unit)[all_points]
        columns = columns.reshape(len(variances), 3, len(some), 3)
        own = columns[some, :, np.arange(len(some))]
        # (Q_pp + W⁻¹)⁻¹ = (1 + W Q_pp)⁻¹ W, with weights W that may be zero
        inner = np.linalg.solve(np.eye(3) + weight[:, None] * own, np.diag(weight))
        less = np.einsum("jacp,cpq,jacq->cja", columns, inner, columns)
        after = np.maximum(variances[None] - less, 0.0)
        at = tried[begin : begin + chunk]
        rms[at] = np.sqrt(np.mean(after, axis=1))
        largest[at] = np.sqrt(np.max(after, axis=1))
    unit = planned.sigma0 * planned.frame.length
    now = np.sqrt([np.mean(variances, axis=0), np.max(variances, axis=0)])
    return Gains(names, unit * rms, unit * largest, unit * now)


def _weight(sigma: Float[ArrayLike, "..."]) -> Float[np.ndarray, "3"]:
    """The weights of three coordinates."""
    deviations = np.broadcast_to(np.asarray(sigma, float), (3,))
    if not np.all(deviations > 0):
        raise ValueError(
            f"where_control_helps: standard deviations are positive, got {sigma}"
        )
    return 1 / deviations**2


def _candidates(planned: BlockAdjustment, names: Sequence[str] | None) -> np.ndarray:
    """The numbers of the points that are tried."""
    there: Bool[np.ndarray, " point"] = planned.numbered.number >= 0
    if names is None:
        return np.flatnonzero(there)
    numbers = {name: k for k, name in enumerate(planned.block.points)}
    for name in names:
        if name not in numbers or not there[numbers[name]]:
            raise ValueError(f"where_control_helps: no point {name!r} is adjusted")
    return np.array([numbers[name] for name in names], int)
