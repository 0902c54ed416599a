"""Which rays of a point are wrong, with the photos as they stand.

A point on two photos has one misclosure, its parallax: either ray explains it. On three
photos a wrong ray often leaves residuals that another one explains as well. Without the
wrong one of them the point is right; without the other one it is wrong, and nothing
shows it. So every ray that explains the misclosures next to as well as the best one is
left out, and where too few remain the point is lost.

    Ω(K) = min over X of Σ |v(X)|²    over the rays K that are kept

The residuals v of a point are whitened; what is known of its coordinates counts as
further rows. Differences of Ω are those of twice the logarithm of the likelihood.
"""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..adjustment import critical_values as critical
from .adjust import BlockAdjustment
from .measured_block import nothing_known
from .network import known_of

GAP = 12.0
"""Difference of Ω up to which two explanations are not told apart: odds of e^-6."""

TOGETHER = 2
"""Wrong rays of one point that are looked for."""

SURE = 1e-3
"""Probability that a right point is called wrong when it is looked at again."""

STEPS = 4
"""Steps of Gauss and Newton to the place of a point."""


class _Point(NamedTuple):
    """The rays of a point: their photos with rotations and centres, their places in
    units of the focal length, and what divides misfits into standard deviations; and
    what is known of it: axes, values, standard deviations."""

    photos: Int[np.ndarray, " ray"]
    turns: Float[np.ndarray, "ray 3 3"]
    centres: Float[np.ndarray, "ray 3"]
    places: Float[np.ndarray, "ray 2"]
    sigma: Float[np.ndarray, " ray"]
    axes: Int[np.ndarray, " known"]
    values: Float[np.ndarray, " known"]
    known_sigma: Float[np.ndarray, " known"]

    def cost(self, kept: Bool[np.ndarray, " ray"]) -> float:
        """Ω of the rays that are kept; infinite where they meet behind a photo."""
        if 2 * int(np.sum(kept)) + len(self.axes) <= 3:
            return 0.0
        at = self._meet(kept)
        for _ in range(STEPS):
            v, slopes = self._misfits(at, kept)
            at = at - np.linalg.lstsq(slopes, v, rcond=None)[0]
        v, _ = self._misfits(at, kept)
        return float(np.sum(v**2)) if self._is_ahead(at, kept) else np.inf

    def _is_ahead(
        self, at: Float[np.ndarray, "3"], kept: Bool[np.ndarray, " ray"]
    ) -> bool:
        """Whether a point lies in front of the photos of the rays that are kept."""
        along = self.turns[kept, 2]
        return bool(np.all(np.sum(along * (at - self.centres[kept]), axis=1) > 0))

    def is_determined(self, kept: Bool[np.ndarray, " ray"]) -> bool:
        """Whether the rays that are kept determine the point."""
        photos = len(np.unique(self.photos[kept]))
        return photos >= 2 or (photos == 1 and len(self.axes) >= 2)

    def limit(self, kept: Bool[np.ndarray, " ray"]) -> float:
        """What Ω exceeds by chance with the probability `SURE`."""
        freedom = 2 * int(np.sum(kept)) + len(self.axes) - 3
        return float(critical.chi_squared(SURE, freedom)) if freedom > 0 else 0.0

    def _meet(self, kept: Bool[np.ndarray, " ray"]) -> Float[np.ndarray, "3"]:
        """The point nearest to the rays that are kept, and to what is known of it."""
        ahead = np.pad(self.places[kept], ((0, 0), (0, 1)), constant_values=1.0)
        d = np.einsum("rji,rj->ri", self.turns[kept], ahead)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        normal = np.sum(across, axis=0)
        right = np.einsum("rij,rj->i", across, self.centres[kept])
        normal[self.axes, self.axes] += 1.0
        right[self.axes] += self.values
        return np.linalg.lstsq(normal, right, rcond=None)[0]

    def _misfits(
        self, at: Float[np.ndarray, "3"], kept: Bool[np.ndarray, " ray"]
    ) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row 3"]]:
        """Misfits in standard deviations, and their derivatives by the point."""
        turn = self.turns[kept]
        away = np.einsum("rij,rj->ri", turn, at[None] - self.centres[kept])
        depth = np.where(np.abs(away[:, 2]) > 0, away[:, 2], 1.0)[:, None]
        seen = away[:, :2] / depth
        slopes = (turn[:, :2] - seen[:, :, None] * turn[:, 2:]) / depth[:, :, None]
        sigma = self.sigma[kept, None]
        off = (seen - self.places[kept]) / sigma
        of_known = (at[self.axes] - self.values) / self.known_sigma
        known_slopes = np.eye(3)[self.axes] / self.known_sigma[:, None]
        rows = (slopes / sigma[:, :, None]).reshape(-1, 3)
        return (
            np.concatenate([off.ravel(), of_known]),
            np.concatenate([rows, known_slopes]),
        )


def decide(
    adjusted: BlockAdjustment,
    wrong: Bool[np.ndarray, " ray"],
    *,
    may_be_right: bool = False,
) -> Bool[np.ndarray, " ray"]:
    """The rays to leave out of the points that have a `wrong` one; those of other points
    as they are. `may_be_right`: the rays of a point come back if all of them fit each
    other."""
    block, out = adjusted.block, wrong.copy()
    numbers = np.unique(block.point[wrong])
    if not len(numbers):
        return out
    read = reader_of(adjusted)
    order = np.argsort(block.point, kind="stable")
    begins, ends = (
        np.searchsorted(block.point[order], at) for at in (numbers, numbers + 1)
    )
    for number, begin, end in zip(numbers, begins, ends, strict=True):
        rays = order[begin:end]
        out[rays] = _decide(read(int(number), rays), wrong[rays], may_be_right)
    return out


def _decide(
    point: _Point, wrong: Bool[np.ndarray, " ray"], may_be_right: bool
) -> Bool[np.ndarray, " ray"]:
    """The rays to leave out of one point."""
    every = np.ones(len(wrong), bool)
    if may_be_right and point.cost(every) <= point.limit(every):
        return ~every
    for size in range(1, min(TOGETHER, len(wrong) - 1) + 1):
        tries = [
            _without(len(wrong), some) for some in combinations(range(len(wrong)), size)
        ]
        costs = np.array([point.cost(kept) for kept in tries])
        best = int(np.argmin(costs))
        if costs[best] > point.limit(tries[best]):
            continue
        near = np.flatnonzero(costs <= costs[best] + GAP)
        kept = np.all([tries[k] for k in near], axis=0)
        return ~kept if point.is_determined(kept) else every
    # more is wrong than can be told
    return wrong if point.is_determined(~wrong) else every


def _without(rays: int, some: tuple[int, ...]) -> Bool[np.ndarray, " ray"]:
    kept = np.ones(rays, bool)
    kept[list(some)] = False
    return kept


def reader_of(
    adjusted: BlockAdjustment,
) -> Callable[[int, Int[np.ndarray, " ray"]], _Point]:
    """What reads a point of the adjustment and its rays."""
    from scipy.spatial.transform import Rotation

    block, ground = adjusted.block, adjusted.ground
    quaternions = np.asarray(adjusted.stations.quaternion)[:, [1, 2, 3, 0]]
    turns = Rotation.from_quat(quaternions).as_matrix()
    centres, places = adjusted.centres, adjusted.ideal_places
    unit = adjusted.sigma0 if adjusted.degrees_of_freedom > 0 else 1.0
    sigma = unit * block.sigma / block.focal[block.photo]
    known = known_of(block, nothing_known() if ground is None else ground)
    known = known.take(~known.station)

    def read(number: int, rays: Int[np.ndarray, " ray"]) -> _Point:
        photo, own = block.photo[rays], known.take(known.number == number)
        return _Point(
            photos=photo,
            turns=turns[photo],
            centres=centres[photo],
            places=places[rays],
            sigma=sigma[rays],
            axes=own.axis,
            values=own.value,
            known_sigma=unit * own.sigma,
        )

    return read
