"""An adjusted block with its names, beside control and check points: what the report,
the tables and the picture of `jaxro block` read."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..adjustment import RESULTS, critical_values as critical
from ..block.adjust import BlockAdjustment
from ..block.measured_block import Ground
from ..block.orient_block import OrientedBlock
from ..block.wrong import Tested, normalise_residuals
from .control import LEVEL, Compared

FEW = 1e-12
"""What stands for a standard deviation of zero where it divides."""


class LeftOut(NamedTuple):
    """A ray that was left out: its number, how far its place is from that of the
    adjusted point (NaN where there is none), and this in standard deviations."""

    ray: int
    misfit: Float[np.ndarray, "2"]
    ratio: float


@dataclass(frozen=True)
class Done:
    """A finished block.

    `unit` of the ground, "" for a free network; `photo_unit` of the photo coordinates;
    `pairs`: the names of the pairs; `ground`: all that is known of it, None for a free
    network; `approximate`: how many of its points are no more than that; `sigma`: how
    the standard deviation of the photo coordinates came about, in words.
    """

    title: str
    unit: str
    photo_unit: str
    sigma: str
    pairs: list[str]
    oriented: OrientedBlock
    ground: Ground | None
    approximate: int = 0

    @property
    def adjusted(self) -> BlockAdjustment:
        """The adjustment."""
        return self.oriented.adjusted

    @property
    def usable(self) -> bool:
        """Whether the numbers may be used."""
        settled = self.oriented.wrong.settled
        return self.adjusted.result == RESULTS.successful and settled

    @cached_property
    def tested(self) -> Tested:
        """The normalised residuals."""
        return normalise_residuals(self.adjusted, LEVEL)

    @property
    def chance(self) -> float:
        """The probability of a sigma0 that is farther from 1."""
        freedom = self.adjusted.degrees_of_freedom
        return float(critical.global_p(freedom * self.adjusted.sigma0**2, freedom))

    # ---------------------------------------------------------------------------------
    # photos and points

    @cached_property
    def photos_of_points(self) -> Int[np.ndarray, " point"]:
        """On how many photos each point is used."""
        block, used = self.adjusted.block, self.adjusted.numbered.rays
        seen = np.unique(np.stack([block.point[used], block.photo[used]]), axis=1)[0]
        return np.bincount(seen, minlength=len(block.points))

    @property
    def points_of_photos(self) -> Int[np.ndarray, " photo"]:
        """How many rays of each photo are used."""
        block, used = self.adjusted.block, self.adjusted.numbered.rays
        return np.bincount(block.photo[used], minlength=len(block.photos))

    @property
    def determined(self) -> Bool[np.ndarray, " point"]:
        """The points that have coordinates."""
        return self.adjusted.numbered.number >= 0

    @property
    def lonely(self) -> list[str]:
        """The points that nothing determines."""
        names = self.adjusted.block.points
        return [names[k] for k in np.flatnonzero(~self.determined)]

    @cached_property
    def left_out(self) -> list[LeftOut]:
        """The rays that were left out, the worst first."""
        rays = np.flatnonzero(self.oriented.wrong.rays)
        misfits = self.adjusted.misfits[rays]
        unit = self.adjusted.block.sigma[rays] * self.adjusted.sigma0
        ratios = np.max(np.abs(misfits), axis=1) / unit
        order = np.argsort(-np.nan_to_num(ratios))
        return [LeftOut(int(rays[k]), misfits[k], float(ratios[k])) for k in order]

    # ---------------------------------------------------------------------------------
    # the ground

    @cached_property
    def _points(self) -> Int[np.ndarray, " known"]:
        """The numbers of the known points in the block, -1 where it has not got them."""
        if self.ground is None:
            return np.zeros(0, int)
        numbers = {name: k for k, name in enumerate(self.adjusted.block.points)}
        return np.array([numbers.get(name, -1) for name in self.ground.points], int)

    @property
    def strange(self) -> list[str]:
        """Known points that are on no photo."""
        names = () if self.ground is None else self.ground.points
        return [n for n, k in zip(names, self._points, strict=True) if k < 0]

    @cached_property
    def control(self) -> Compared:
        """The control points: adjusted minus given, and w."""
        if self.ground is None:
            return self._compare(np.zeros(0, int), np.zeros((0, 3)))
        rows = self._rows(~self.ground.check)
        w = self.tested.control[rows]
        # of what was left out as of a check point
        w = np.where(np.isfinite(w), w, self._off(rows) / self._spread(rows))
        # nothing checks a coordinate that takes part and has no w
        used = np.isfinite(self.adjusted.control_residuals[rows])
        untested = used & ~np.isfinite(self.tested.control[rows])
        return self._compare(rows, np.where(untested, np.nan, w))

    @property
    def control_redundancy(self) -> Float[np.ndarray, "control 3"]:
        """The redundancy numbers of the control, zero where it takes no part."""
        if self.ground is None:
            return np.zeros((0, 3))
        rows = self._rows(~self.ground.check)
        return np.nan_to_num(self.adjusted.control_redundancy[rows])

    @property
    def wrong_control(self) -> Bool[np.ndarray, "control 3"]:
        """The coordinates of the control that were left out."""
        if self.ground is None:
            return np.zeros((0, 3), bool)
        return self.oriented.wrong.control[self._rows(~self.ground.check)]

    @cached_property
    def checks(self) -> Compared:
        """The check points: adjusted minus given, and this in standard deviations."""
        if self.ground is None:
            return self._compare(np.zeros(0, int), np.zeros((0, 3)))
        rows = self._rows(self.ground.check)
        return self._compare(rows, self._off(rows) / self._spread(rows))

    @property
    def limit_of_checks(self) -> float:
        """What the largest of the check coordinates exceeds with the probability LEVEL
        if none is wrong."""
        number = max(int(np.sum(self.checks.known)), 1)
        return float(critical.normal(critical.sidak(LEVEL, number)))

    def _rows(self, wanted: Bool[np.ndarray, " known"]) -> Int[np.ndarray, " some"]:
        """The wanted rows of the ground that have a point in the adjustment."""
        there = self._points >= 0
        there &= self.determined[np.maximum(self._points, 0)]
        return np.flatnonzero(wanted & there)

    def _off(self, rows: Int[np.ndarray, " some"]) -> Float[np.ndarray, "some 3"]:
        """Adjusted minus given coordinates."""
        assert self.ground is not None
        adjusted = self.adjusted.coordinates[self._points[rows]]
        return adjusted - self.ground.coordinates[rows]

    def _spread(self, rows: Int[np.ndarray, " some"]) -> Float[np.ndarray, "some 3"]:
        """The standard deviations of these differences, of points that take no part."""
        assert self.ground is not None
        own = self.adjusted.deviations[self._points[rows]]
        given = np.nan_to_num(self.ground.sigma[rows])
        return np.maximum(np.hypot(own, self.adjusted.sigma0 * given), FEW)

    def _compare(
        self, rows: Int[np.ndarray, " some"], w: Float[np.ndarray, "some 3"]
    ) -> Compared:
        if self.ground is None:
            none = np.zeros((0, 3))
            return Compared([], none, none.astype(bool), none, none)
        given = self.ground.coordinates[rows]
        known = np.isfinite(given)
        return Compared(
            names=[self.ground.points[k] for k in rows],
            given=given,
            known=known,
            differences=np.where(known, self._off(rows), 0.0),
            w=np.where(known, w, 0.0),
        )
