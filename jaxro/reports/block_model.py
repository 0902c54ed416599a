"""An adjusted block with its names, beside control and check points: what the report,
the tables and the picture of `jaxro block` read."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..adjustment import RESULTS, critical_values as critical
from ..block.adjust import BlockAdjustment
from ..block.bars import Bars, differences
from ..block.measured_block import Ground
from ..block.orient_block import OrientedBlock
from ..block.photos import Held, find_held
from ..block.reliability import BlockReliability, assess_block
from ..block.wrong import Tested, normalise_residuals
from .control import LEVEL, Compared

LEAST_CHECKED = 0.1
"""Sum of the redundancy numbers of the control up to which nothing checks it."""

LEAST = 1e-12
"""What stands for a standard deviation of zero where it divides."""


STATION_OF = "station of"
"""What the name of a photo has before it among known points."""


class LeftOut(NamedTuple):
    """A ray that was left out: its number, how far its place is from that of the
    adjusted point (NaN where there is none), and this in standard deviations."""

    ray: int
    misfit: Float[np.ndarray, "2"]
    ratio: float


PHOTOS, POINTS = "photos", "points"
"""The datum of a free network, but for some points by their names."""


@dataclass(frozen=True)
class Done:
    """A finished block.

    `unit` of the ground, "" for a free network; `photo_unit` of the photo coordinates;
    `pairs`: the names of the pairs; `ground`: all that is known of it, None for a free
    network; `bars`: all that were given; `approximate`: how many of the known points are
    no more than that; `sigma`: how the standard deviation of the photo coordinates came
    about, in words; `datum`: what the deviations of a free network refer to, photos,
    points, or some points by their names.
    """

    title: str
    unit: str
    photo_unit: str
    sigma: str
    pairs: list[str]
    oriented: OrientedBlock
    ground: Ground | None
    bars: Bars | None = None
    approximate: int = 0
    datum: str = PHOTOS

    @property
    def adjusted(self) -> BlockAdjustment:
        """The adjustment."""
        return self.oriented.adjusted

    @property
    def usable(self) -> bool:
        """Whether the numbers may be used."""
        settled = self.oriented.wrong.settled
        found = bool(self.adjusted.result == RESULTS.successful) and settled
        cause = self.oriented.cause
        right = cause is None or cause.is_hint
        return found and right and not self.contradictions

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What of that which was given does not fit as a whole."""
        return self.oriented.contradictions

    @cached_property
    def tested(self) -> Tested:
        """The normalised residuals."""
        return normalise_residuals(self.adjusted, LEVEL)

    @cached_property
    def reliability(self) -> BlockReliability:
        """Which errors the tests find with a probability of 80 %."""
        return assess_block(self.adjusted, level=LEVEL, familywise=True)

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
    def held(self) -> list[Held]:
        """The photos that a single point holds."""
        adjusted, block = self.adjusted, self.adjusted.block
        known = np.zeros(len(block.points), bool)
        placed = np.zeros(len(block.photos), bool)
        for part in adjusted.known:
            (placed if part.station[0] else known)[part.number] = True
        return find_held(block, adjusted.numbered.rays, known, placed)

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

    @property
    def strange(self) -> list[str]:
        """Known points that are on no photo, and stations of no photo."""
        if self.ground is None:
            return []
        there = self.ground.numbers_in(self.adjusted.block) >= 0
        return [self.ground.points[k] for k in np.flatnonzero(~there)]

    @cached_property
    def control(self) -> Compared:
        """The control points: adjusted minus given, and w."""
        if self.ground is None:
            return self._compare(np.zeros(0, int), np.zeros((0, 3)))
        rows = self._rows(~self.ground.check)
        w = self.tested.control[rows]
        # of what was left out as of a check point
        w = np.where(np.isfinite(w), w, self._ratios[rows])
        # nothing checks a coordinate that takes part and has no w
        used = np.isfinite(self.adjusted.control_residuals[rows])
        untested = used & ~np.isfinite(self.tested.control[rows])
        return self._compare(rows, np.where(untested, np.nan, w))

    @property
    def fitting_control(self) -> Compared:
        """The control without what was left out as wrong."""
        known = self.control.known & ~self.wrong_control
        return replace(self.control, known=known)

    @property
    def checks_control(self) -> bool:
        """Whether anything checks the control."""
        return bool(np.sum(self.control_redundancy) > LEAST_CHECKED)

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
        return self._compare(rows, self._ratios[rows])

    @property
    def bar_tests(self) -> Float[np.ndarray, " bar"]:
        """w of the scale bars, NaN where nothing checks them; of those that take no part
        their differences in standard deviations."""
        if self.bars is None:
            return np.zeros(0)
        off, spread = self.bar_differences
        ratios = off / np.hypot(spread, self.adjusted.sigma0 * self.bars.sigma)
        used = np.isfinite(self.adjusted.bar_residuals)
        return np.where(used, self.tested.bars, ratios)

    @cached_property
    def bar_differences(self) -> tuple[np.ndarray, np.ndarray]:
        """Adjusted minus given lengths of all bars, and the deviations of the former."""
        assert self.bars is not None
        found = self.adjusted
        return differences(
            self.bars, found.block, found.coordinates, found.point_covariances
        )

    @property
    def limit_of_checks(self) -> float:
        """What the largest of the check coordinates exceeds with the probability LEVEL
        if none is wrong."""
        number = max(int(np.sum(self.checks.known)), 1)
        return float(critical.normal(critical.sidak(LEVEL, number)))

    @cached_property
    def _apart(self) -> tuple[np.ndarray, np.ndarray]:
        """Adjusted minus given coordinates, and the deviations of the adjusted ones."""
        assert self.ground is not None
        return self.adjusted.compare(self.ground)

    @property
    def _ratios(self) -> Float[np.ndarray, "known 3"]:
        """The differences of what takes no part in their standard deviations."""
        off, spread = self._apart
        assert self.adjusted.ground is not None
        given = self.adjusted.sigma0 * np.nan_to_num(self.adjusted.ground.sigma)
        return off / np.maximum(np.hypot(spread, given), LEAST)

    def _rows(self, wanted: Bool[np.ndarray, " known"]) -> Int[np.ndarray, " some"]:
        """The wanted rows of the ground that the adjustment has coordinates of."""
        return np.flatnonzero(wanted & np.any(np.isfinite(self._apart[1]), axis=1))

    def _name(self, row: int) -> str:
        assert self.ground is not None
        name = self.ground.points[row]
        return f"{STATION_OF} {name}" if self.ground.station[row] else name

    def _compare(
        self, rows: Int[np.ndarray, " some"], w: Float[np.ndarray, "some 3"]
    ) -> Compared:
        if self.ground is None:
            none = np.zeros((0, 3))
            return Compared([], none, none.astype(bool), none, none)
        given = self.ground.coordinates[rows]
        known = np.isfinite(given)
        return Compared(
            names=[self._name(int(k)) for k in rows],
            given=given,
            known=known,
            differences=np.where(known, self._apart[0][rows], 0.0),
            w=np.where(known, w, 0.0),
        )
