"""Wrong places and wrong known coordinates of a block.

Where a plain adjustment shows that little can be wrong, its normalised residuals w
(Baarda 1968) are tested in a few rounds, the largest one of each neighbourhood at a
time. They point at wrong control, which robust estimators would keep at the cost of its
rays.

If that does not settle it, or much is wrong, robust estimators bring the block near the
truth first, whatever a fifth of the ties says: the sum of absolute residuals, which has
one minimum and needs no scale; then the redescending weights of Geman and McClure
(1987), (c² / (c² + s²))², s the residual in standard deviations, with c that falls to
`SURE`. Then the block is adjusted without the rays that are beyond `CLEAR`, and what is
left is tested.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..adjustment import RESULTS, critical_values
from ..adjustment.sparse import Minimum, Problem, minimise, residuals_of
from .adjust import BlockAdjustment, Prepared, adjust_block, conclude, prepare_block
from .bars import Bars
from .inner import Inner
from .measured_block import Ground, MeasuredBlock
from .network import Start, spread_known
from .place import TooLittleControl

SURE = 3.0
"""The last scale c of the redescending weights, in standard deviations."""

CLEAR = 6.0
"""Residuals beyond so many standard deviations are wrong before any test."""

ABSOLUTE = 10
"""Rounds of weights 1 / s."""

ROUNDS = 8
"""Rounds of redescending weights."""

TESTS = 20
"""Rounds of tests."""

NEARLY_RIGHT, FEW = 2.0, 6
"""sigma0 of a plain adjustment below which so many rounds of tests come first."""

DATUM = 7
"""Known coordinates that a block needs."""

MOST = 0.5
"""Part of the rays that a robust solution may leave out: with more it is none."""

UNCHECKED = 0.02
"""Redundancy below which nothing checks a coordinate: it is told, not tested."""


class Wrong(NamedTuple):
    """What was left out: rays, and known coordinates; `settled`: whether nothing more
    is beyond the limit of the tests."""

    rays: Bool[np.ndarray, " ray"]
    control: Bool[np.ndarray, "known 3"]
    settled: bool = False

    def __or__(self, other: "Wrong") -> "Wrong":
        return Wrong(self.rays | other.rays, self.control | other.control)


class Tested(NamedTuple):
    """Normalised residuals of what takes part (NaN where nothing checks it), and the
    limit that the largest of all exceeds by chance with the probability `level`."""

    rays: Float[np.ndarray, "ray 2"]
    control: Float[np.ndarray, "known 3"]
    limit: float


def adjust_without_wrong(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None = None,
    inner: Inner | None = None,
    bars: Bars | None = None,
    level: float = 0.05,
) -> tuple[BlockAdjustment, Wrong]:
    """Adjust a block without its wrong rays and known coordinates. `inner`: the inner
    parameters that are unknown; `bars`: known distances. Where the rays fit no block
    the adjustment says that it diverged. Raises `TooLittleControl` where hardly a known
    coordinate fits the photos."""
    nothing = Wrong(
        np.zeros(len(block.photo), bool), np.zeros((_control_points(ground), 3), bool)
    )
    plain = adjust_rest(block, start, ground, nothing, inner, bars)
    if plain.sigma0 < NEARLY_RIGHT:
        adjusted, wrong = _test(plain, ground, nothing, level, FEW)
        if wrong.settled:
            return adjusted, wrong
    prepared = prepare_block(block, start, ground, inner, bars=bars)
    found = settle(prepared)
    wrong = _far(prepared, found)
    if np.mean(wrong.rays[prepared.numbered.rays]) > MOST:
        lost = found._replace(result=RESULTS.diverged)
        return conclude(prepared, lost), nothing
    begin = prepared.start_at(found)
    adjusted = adjust_rest(block, begin, ground, wrong, inner, bars)
    adjusted, wrong = _test(adjusted, ground, wrong, level)
    if ground is None or not wrong.settled:
        return adjusted, wrong
    # robust estimators leave out what little else checks: it comes back, and is tested
    back = np.any(wrong.control, axis=1) & fits(adjusted, ground, level)
    if not np.any(back):
        return adjusted, wrong
    wrong = wrong._replace(control=wrong.control & ~back[:, None])
    adjusted = adjust_rest(block, adjusted.as_start, ground, wrong, inner, bars)
    return _test(adjusted, ground, wrong, level)


def _test(
    adjusted: BlockAdjustment,
    ground: Ground | None,
    wrong: Wrong,
    level: float,
    rounds: int = TESTS,
) -> tuple[BlockAdjustment, Wrong]:
    """The adjustment without what the tests reject, in rounds."""
    for _ in range(rounds):
        more = _worst(adjusted, normalise_residuals(adjusted, level))
        if not (np.any(more.rays) or np.any(more.control)):
            return adjusted, wrong._replace(settled=True)
        wrong = wrong | more
        begin, rest = adjusted.as_start, (adjusted.inner, adjusted.bars)
        adjusted = adjust_rest(adjusted.block, begin, ground, wrong, *rest)
    return adjusted, wrong._replace(settled=False)


def fits(
    adjusted: BlockAdjustment, ground: Ground, level: float
) -> Bool[np.ndarray, " known"]:
    """What of the ground lies where an adjustment without it says, all its coordinates
    within the limit that the largest of all exceeds with the probability `level`."""
    off, spread = adjusted.compare(ground)
    z = np.abs(off) / np.hypot(spread, adjusted.sigma0 * ground.sigma)
    each = critical_values.sidak(level, max(int(np.sum(np.isfinite(z))), 1))
    known = np.any(np.isfinite(z), axis=1)
    return known & np.all((z < critical_values.normal(each)) | np.isnan(z), axis=1)


def adjust_rest(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None,
    wrong: Wrong,
    inner: Inner | None = None,
    bars: Bars | None = None,
) -> BlockAdjustment:
    """The adjustment without what is wrong; rays and points keep their numbers."""
    if ground is not None:
        at = np.where(wrong.control, np.nan, ground.coordinates)
        _check_control(ground, at)
        ground = ground._replace(coordinates=at)
    return adjust_block(block, start, ground, inner, wrong.rays, bars)


def _check_control(ground: Ground, left: Float[np.ndarray, "known 3"]) -> None:
    """Raises `TooLittleControl` where the photos contradict nearly all that is
    known."""
    number = lambda at: int(np.sum(np.isfinite(at[~ground.check])))
    if number(left) < DATUM <= number(ground.coordinates):
        raise TooLittleControl(
            f"{number(left)} of {number(ground.coordinates)} known coordinates fit the "
            f"photos, {DATUM} are needed: look at the names, the system and the unit of "
            "the known points"
        )


def normalise_residuals(adjusted: BlockAdjustment, level: float = 0.05) -> Tested:
    """w = v / (sigma0 sigma √r) of all coordinates that something checks."""
    normalise = lambda v, sigma, r: np.where(
        r > UNCHECKED, v / (sigma * np.sqrt(np.maximum(r, UNCHECKED))), np.nan
    )
    unit = adjusted.sigma0 if adjusted.degrees_of_freedom > 0 else 1.0
    sigma = adjusted.block.sigma[:, None] * unit
    rays = normalise(adjusted.residuals, sigma, adjusted.redundancy)
    control = np.zeros((0, 3))
    if adjusted.ground is not None:
        control = normalise(
            adjusted.control_residuals,
            adjusted.ground.sigma * unit,
            adjusted.control_redundancy,
        )
    number = np.sum(np.isfinite(rays)) + np.sum(np.isfinite(control))
    each = critical_values.sidak(level, max(int(number), 1))
    return Tested(rays, control, float(critical_values.normal(each)))


# -------------------------------------------------------------------------------------
# robust estimators


def settle(prepared: Prepared) -> Minimum:
    """The minimum of the robust estimators, one after the other, from afar."""
    problem, datum = prepared.problem, prepared.datum
    # plain steps mend the bends of a long strip, and wrong places throw a short one off
    plain = problem.at(minimise(problem, datum=datum, max_steps=3).problem)
    problem = min(problem, plain, key=_absolute_sum)
    scales = [np.inf] * len(problem.data.terms)
    found = Minimum(problem, 0, RESULTS.successful)
    for k in range(ABSOLUTE + ROUNDS):
        problem = problem.at(found.problem)
        sizes = _sizes(problem)
        if k < ABSOLUTE:
            weights = [1 / np.maximum(s, 1.0) for s in sizes]
        else:
            scales = [_scale(s, c) for s, c in zip(sizes, scales, strict=True)]
            both = zip(sizes, scales, strict=True)
            weights = [(c**2 / (c**2 + s**2)) ** 2 for s, c in both]
        found = minimise(problem.weighted(weights), datum=datum, max_steps=2)
    return found._replace(problem=problem.at(found.problem))


def _sizes(problem: Problem) -> list[Float[np.ndarray, " _"]]:
    """The residual of each group, in standard deviations of one coordinate."""
    sizes = lambda r: np.sqrt(np.mean(r**2, axis=1))
    return [sizes(r) for r in residuals_of(problem)]


def _absolute_sum(problem: Problem) -> float:
    """The sum of all absolute residuals."""
    return sum(float(np.sum(sizes)) for sizes in _sizes(problem))


def _scale(sizes: Float[np.ndarray, " group"], before: float) -> float:
    """The next scale: half of the one before, or what the residuals are."""
    return max(SURE, min(before / 2, 3 * float(np.median(sizes))))


# -------------------------------------------------------------------------------------
# what is left out


def _far(prepared: Prepared, found: Minimum) -> Wrong:
    """What is beyond `CLEAR`."""
    far, *of_known = [sizes > CLEAR for sizes in _sizes(found.problem)]
    rays = np.zeros(len(prepared.block.photo), bool)
    rays[prepared.numbered.rays] = far
    known, number = prepared.known, _control_points(prepared.ground)
    return Wrong(rays, spread_known(known, of_known[: len(known)], number, False))


def _worst(adjusted: BlockAdjustment, tested: Tested) -> Wrong:
    """The largest w beyond the limit: one ray of each point and each photo, and one
    known point with all its coordinates, where this is larger than its rays are."""
    block = adjusted.block
    of_ray = np.max(np.nan_to_num(np.abs(tested.rays)), axis=1)
    of_point = np.zeros(len(block.points))
    np.maximum.at(of_point, block.point, of_ray)
    rays = np.zeros(len(block.photo), bool)
    control = np.zeros(tested.control.shape, bool)
    if adjusted.ground is not None and len(tested.control) > 0:
        of_known = np.max(np.nan_to_num(np.abs(tested.control)), axis=1)
        worst = int(np.argmax(of_known))
        number = adjusted.ground.numbers_in(block)[worst]
        station = adjusted.ground.station[worst]
        beside = 0.0 if station or number < 0 else of_point[number]
        if of_known[worst] > max(tested.limit, beside):
            control[worst] = True
            # its error is in the residuals of all rays around it
            return Wrong(rays, control)
    free_points = np.ones(len(block.points), bool)
    free_photos = np.ones(len(block.photos), bool)
    for ray in np.argsort(-of_ray):
        if of_ray[ray] <= tested.limit:
            break
        point, photo = block.point[ray], block.photo[ray]
        if free_points[point] and free_photos[photo]:
            rays[ray] = True
            free_points[point] = free_photos[photo] = False
    return Wrong(rays, control)


def _control_points(ground: Ground | None) -> int:
    return 0 if ground is None else len(ground.points)
