"""Which errors of its coordinates an adjusted block would find, and what those that stay
hidden would do to the ground (Baarda 1968).

    redundancy number      r: the part of an error that shows in its own residual
    detectable error       delta0 sigma0 sigma / √r
    its effect on x        N⁻¹ Aᵀ P times the error
    external reliability   delta0 √((1 - r) / r): no function of the unknowns moves by
                           more of its standard deviations

An error of this size makes |w| exceed the limit of the test with the wanted power.
Where r is below `UNCHECKED` nothing checks the coordinate: x of a point on two photos,
where an error along the base is an error of the height, and heights of control that few
other ones surround. Errors there have no detectable size, and no test names them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..adjustment import critical_values as critical
from .adjust import BlockAdjustment
from .wrong import UNCHECKED, independent_tests


class Checked(NamedTuple):
    """How coordinates are checked: two of each ray, or three of each known point. NaN
    for coordinates that take no part; infinite where nothing checks them.

    `redundancy` numbers; `detectable` errors in the unit of the coordinates; by these
    `point`, the shift of the own point on the ground, `station`, that of the own
    projection centre (rays alone), and `external`, the bound for everything else.
    """

    redundancy: Float[np.ndarray, "row k"]
    detectable: Float[np.ndarray, "row k"]
    point: Float[np.ndarray, "row k 3"]
    station: Float[np.ndarray, "row k 3"]
    external: Float[np.ndarray, "row k"]

    @property
    def unchecked(self) -> Bool[np.ndarray, "row k"]:
        """Coordinates that take part and that nothing checks."""
        return self.redundancy <= UNCHECKED

    @property
    def largest(self) -> Float[np.ndarray, " row"]:
        """The longest shift of the own point that an error of any of its coordinates
        may cause without being found; NaN for rows that take no part."""
        lengths = np.linalg.norm(self.point, axis=2)
        there = np.any(np.isfinite(self.redundancy), axis=1)
        return np.where(there, np.max(np.nan_to_num(lengths, posinf=np.inf), 1), np.nan)


class BlockReliability(NamedTuple):
    """What the tests of a block would find: `rays`, and `control`; the `limit` of |w| of
    one coordinate, and the error `delta0` of w that is found with the wanted power."""

    rays: Checked
    control: Checked
    limit: float
    delta0: float


def assess_block(
    adjusted: BlockAdjustment,
    *,
    level: float = 0.001,
    power: float = 0.80,
    familywise: bool = False,
) -> BlockReliability:
    """The reliability of all coordinates of a block.

    `level`: of the test of each coordinate, or (`familywise`) of all together by Šidák,
    as `adjust_without_wrong` tests them with 0.05; `power` with which detectable errors
    are found. The standard deviation of unit weight is the adjustment's; before a flight
    (`plan`) it is 1. Raises RuntimeError for an adjustment that is not usable,
    ValueError if level or power are no probabilities.
    """
    for name, probability in (("level", level), ("power", power)):
        if not 0 < probability < 1:
            raise ValueError(
                f"{name} is a probability, between 0 and 1, got {probability}"
            )
    adjusted.check()
    rays, control = adjusted.redundancy, adjusted.control_redundancy
    if familywise:
        level = float(critical.sidak(level, independent_tests(adjusted)))
    delta0 = float(critical.delta_normal(level, power))
    sigma = np.repeat(adjusted.block.sigma[:, None], 2, axis=1)
    of_control = np.zeros((0, 3)) if adjusted.ground is None else adjusted.ground.sigma
    point, station = _shifts_of_rays(adjusted)
    shifts = _shifts_of_control(adjusted)
    unit = delta0 * adjusted.sigma0
    return BlockReliability(
        rays=_check(rays, sigma, point, station, unit, delta0),
        control=_check(
            control, of_control, shifts, np.full_like(shifts, np.nan), unit, delta0
        ),
        limit=float(critical.normal(level)),
        delta0=delta0,
    )


def _check(redundancy, sigma, point, station, unit: float, delta0: float) -> Checked:
    """`Checked`, from the shifts by an error of one standard deviation (sigma0 = 1);
    `unit`: the detectable error for r = 1, in these."""
    there, seen = np.isfinite(redundancy), redundancy > UNCHECKED
    r = np.where(seen, redundancy, 1.0)

    def bound(values: np.ndarray) -> np.ndarray:
        """Infinite or NaN where there is no detectable error."""
        shape = (*seen.shape, *(1,) * (values.ndim - 2))
        hidden = np.where(there.reshape(shape), np.inf, np.nan)
        return np.where(seen.reshape(shape), values, hidden)

    size = unit / np.sqrt(r)
    return Checked(
        redundancy=redundancy,
        detectable=bound(size * sigma),
        point=bound(size[:, :, None] * point),
        station=bound(size[:, :, None] * station),
        external=bound(delta0 * np.sqrt(np.maximum(1 - r, 0.0) / r)),
    )


def _shifts_of_rays(
    adjusted: BlockAdjustment,
) -> tuple[Float[np.ndarray, "ray 2 3"], Float[np.ndarray, "ray 2 3"]]:
    """How the point and the projection centre of each ray move by an error of x and of
    y of one standard deviation."""
    found, used = adjusted.adjustment.shifts[0], adjusted.numbered.rays
    # a place is (x, -y), and a misfit grows with it
    sign = np.array([-1.0, 1.0])[:, None] * adjusted.frame.length

    def of_rays(shift: np.ndarray) -> np.ndarray:
        out = np.full((len(used), 2, 3), np.nan)
        out[used] = np.swapaxes(shift, 1, 2) * sign
        return out

    return of_rays(np.asarray(found.own)), of_rays(np.asarray(found.links[0])[:, 3:])


def _shifts_of_control(adjusted: BlockAdjustment) -> Float[np.ndarray, "known 3 3"]:
    """How known points move by an error of each coordinate of one standard deviation."""
    number = 0 if adjusted.ground is None else len(adjusted.ground.points)
    out = np.full((number, 3, 3), np.nan)
    shifts = adjusted.adjustment.shifts[1:]
    for part, shift in zip(adjusted.known, shifts, strict=False):
        # of a station its own centre moves
        moved = shift.links[0][:, 3:] if part.station[0] else shift.own
        own = np.asarray(moved)[:, :, 0] * adjusted.frame.length
        out[part.row, part.axis] = own
    return out
