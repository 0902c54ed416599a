"""Wrong places, wrong known coordinates and wrong bars of a block.

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
from .adjust import BlockAdjustment, adjust_block, conclude
from .bars import Bars, differences, scale_of
from .chain import rays_of
from .given import Given, Wrong, nothing_wrong
from .measured_block import Ground, MeasuredBlock
from .network import Start, spread_known
from .place import TooLittleControl
from .prepared import Prepared, prepare_block
from .wrong_points import decide

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

ASTRAY = 0.1
"""How far a ray may miss its point at the beginning, in focal lengths."""

DISTANCE = 30.0
"""By which factor the distance of a point may differ from the usual one."""

DATUM = 7
"""Known coordinates that a block needs."""

MOST = 0.5
"""Part of the rays that a robust solution may leave out: with more it is none."""

INDEPENDENT = 1.4
"""Independent tests for each degree of freedom that reject as often as those of a block:
with them the largest w of 4,726 blocks without errors, of six to ten photos, was beyond
the limit of 5 % in 5.0 ± .3 %."""

UNCHECKED = 0.02
"""Redundancy below which nothing checks a coordinate: it is told, not tested."""


class Tested(NamedTuple):
    """Normalised residuals of what takes part (NaN where nothing checks it), and the
    limit that the largest of all exceeds by chance with the probability `level`."""

    rays: Float[np.ndarray, "ray 2"]
    control: Float[np.ndarray, "known 3"]
    bars: Float[np.ndarray, " bar"]
    limit: float


def adjust_without_wrong(
    given: Given, start: Start, level: float = 0.05
) -> tuple[BlockAdjustment, Wrong]:
    """Adjust a block without its wrong rays, known coordinates and bars. Where the rays
    fit no block the adjustment says that it diverged. Raises `TooLittleControl` where
    hardly a known coordinate fits the photos.

    Bars are judged by the block without them: a length that is far more certain than a
    ray would rather have a good ray left out than be wrong itself.
    """
    alone = given._replace(bars=None)
    adjusted, wrong = _without_bars(alone, start, level)
    bars = given.bars
    if bars is None or adjusted.result != RESULTS.successful or not wrong.settled:
        none = nothing_wrong(given).bars
        return adjusted, wrong._replace(bars=none)
    is_free = not adjusted.known
    scale = scale_of(bars, given.block, adjusted.coordinates) if is_free else 1.0
    wrong = wrong._replace(bars=_wrong_bars(bars, adjusted, scale, level))
    begin = adjusted.as_start
    begin = begin._replace(centres=begin.centres * scale, points=begin.points * scale)
    return _test(given, adjust_rest(given, begin, wrong), wrong, level)


def _wrong_bars(
    bars: Bars, adjusted: BlockAdjustment, scale: float, level: float
) -> Bool[np.ndarray, " bar"]:
    """The bars that contradict a block, which is to be multiplied by a scale."""
    places = adjusted.coordinates * scale, adjusted.point_covariances * scale**2
    off, spread = differences(bars, adjusted.block, *places)
    w = np.abs(off) / np.hypot(spread, adjusted.sigma0 * bars.sigma)
    each = critical_values.sidak(level, max(int(np.sum(np.isfinite(w))), 1))
    return np.nan_to_num(w) > critical_values.normal(each)


def _without_bars(
    given: Given, start: Start, level: float
) -> tuple[BlockAdjustment, Wrong]:
    """The adjustment without wrong rays and known coordinates."""
    strange = nothing_wrong(given)._replace(rays=_strange(given.block, start))
    plain = adjust_rest(given, start, strange)
    if plain.sigma0 < NEARLY_RIGHT:
        rays = decide(plain, strange.rays, may_be_right=True)
        if np.any(rays != strange.rays):
            strange = strange._replace(rays=rays)
            plain = adjust_rest(given, plain.as_start, strange)
        adjusted, wrong = _test(given, plain, strange, level, FEW)
        if wrong.settled:
            return adjusted, wrong
    prepared = prepare_block(given, start, strange.rays)
    found = settle(prepared)
    wrong = _far(prepared, found) | strange
    used = wrong.rays[prepared.numbered.rays]
    if found.result != RESULTS.successful or np.mean(used) > MOST:
        lost = found._replace(result=RESULTS.diverged)
        return conclude(prepared, lost), nothing_wrong(given)
    adjusted = adjust_rest(given, prepared.start_at(found), wrong)
    if adjusted.result != RESULTS.successful:
        return adjusted, wrong
    # robust estimators choose one ray where several explain the misfit, and leave out
    # what little else checks
    rays = decide(adjusted, wrong.rays, may_be_right=True)
    wrong = wrong._replace(rays=rays)
    adjusted = adjust_rest(given, adjusted.as_start, wrong)
    adjusted, wrong = _test(given, adjusted, wrong, level)
    if not wrong.settled:
        return adjusted, wrong
    back = np.any(wrong.control, axis=1) & fits(adjusted, given.known, level)
    if not np.any(back):
        return adjusted, wrong
    wrong = wrong._replace(control=wrong.control & ~back[:, None])
    adjusted = adjust_rest(given, adjusted.as_start, wrong)
    return _test(given, adjusted, wrong, level)


def _strange(block: MeasuredBlock, start: Start) -> Bool[np.ndarray, " ray"]:
    """The rays of points that begin behind a photo, far off one of their rays, or at
    another distance than all others. From there no step leads to where they are, and
    those of other points go astray with them."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_quat(start.quaternions[:, [1, 2, 3, 0]]).as_matrix()
    away = (start.points[block.point] - start.centres[block.photo])[:, :, None]
    x, y, depth = (turns[block.photo] @ away)[:, :, 0].T
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.stack([x / depth, y / depth]) - rays_of(block)[:, :2].T
        usual = depth / np.nanmedian(depth)
        strange = (
            (usual < 1 / DISTANCE) | (usual > DISTANCE) | (np.hypot(*off) > ASTRAY)
        )
    points = np.zeros(len(block.points), bool)
    points[block.point[strange]] = True
    found = points[block.point]
    return found if np.mean(found) < MOST else np.zeros(len(found), bool)


def _test(
    given: Given,
    adjusted: BlockAdjustment,
    wrong: Wrong,
    level: float,
    rounds: int = TESTS,
) -> tuple[BlockAdjustment, Wrong]:
    """The adjustment without what the tests reject, in rounds."""
    for _ in range(rounds):
        if adjusted.result != RESULTS.successful:
            break
        more = _worst(adjusted, normalise_residuals(adjusted, level))
        if not more:
            return adjusted, wrong._replace(settled=True)
        wrong = wrong | more
        adjusted = adjust_rest(given, adjusted.as_start, wrong)
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


def adjust_rest(given: Given, start: Start, wrong: Wrong) -> BlockAdjustment:
    """The adjustment without what is wrong; rays, points, known points and bars keep
    their numbers."""
    return adjust_block(
        given.block,
        start,
        _known_rest(given, wrong),
        given.inner,
        wrong.rays,
        None if given.bars is None else given.bars.without(wrong.bars),
    )


def _known_rest(given: Given, wrong: Wrong) -> Ground | None:
    """What is known of the ground without what is wrong of it."""
    if given.ground is None:
        return None
    at = np.where(wrong.control, np.nan, given.ground.coordinates)
    _check_control(given.ground, at)
    return given.ground._replace(coordinates=at)


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
    """w = v / (sigma0 sigma √r) of all coordinates and lengths that something checks."""
    normalise = lambda v, sigma, r: np.where(
        r > UNCHECKED, v / (sigma * np.sqrt(np.maximum(r, UNCHECKED))), np.nan
    )
    unit = adjusted.sigma0 if adjusted.degrees_of_freedom > 0 else 1.0
    sigma = adjusted.block.sigma[:, None] * unit
    rays = normalise(adjusted.residuals, sigma, adjusted.redundancy)
    control, bars = np.zeros((0, 3)), np.zeros(0)
    if adjusted.ground is not None:
        control = normalise(
            adjusted.control_residuals,
            adjusted.ground.sigma * unit,
            adjusted.control_redundancy,
        )
    if adjusted.bars is not None:
        bars = normalise(
            adjusted.bar_residuals, adjusted.bars.sigma * unit, adjusted.bar_redundancy
        )
    each = critical_values.sidak(level, independent_tests(adjusted))
    return Tested(rays, control, bars, float(critical_values.normal(each)))


def independent_tests(adjusted: BlockAdjustment) -> float:
    """How many independent tests reject as often as those of all coordinates and lengths
    together.

    The w of a point on two photos are all one, but for their signs. All others are
    different, but more or less alike (`INDEPENDENT`).
    """
    block, ground = adjusted.block, adjusted.ground
    tested = np.sum(adjusted.redundancy > UNCHECKED, axis=1)
    of_point = np.bincount(block.point, tested, len(block.points))
    different, known = 0, np.zeros(len(block.points), bool)
    if ground is not None:
        of_known = adjusted.control_redundancy > UNCHECKED
        takes_part = np.any(of_known, axis=1) & ~ground.station
        known[ground.numbers_in(block)[takes_part]] = True
        different += np.sum(of_known)
    if adjusted.bars is not None:
        different += np.sum(adjusted.bar_redundancy > UNCHECKED)
    alone = np.where(of_point > 4, of_point, np.minimum(of_point, 1.0))
    different += np.sum(np.where(known, of_point, alone))
    return max(min(float(different), INDEPENDENT * adjusted.degrees_of_freedom), 1.0)


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
        if not all(np.all(np.isfinite(s)) for s in sizes):
            return found._replace(result=RESULTS.diverged)
        if k < ABSOLUTE:
            weights = [1 / np.maximum(s, 1.0) for s in sizes]
        else:
            scales = [_scale(s, c) for s, c in zip(sizes, scales, strict=True)]
            both = zip(sizes, scales, strict=True)
            weights = [(c**2 / (c**2 + s**2)) ** 2 for s, c in both]
        # a field that is large is no wrong measurement
        measured = 1 + len(prepared.known)
        weights[measured:] = [np.ones_like(s) for s in sizes[measured:]]
        found = minimise(problem.weighted(weights), datum=datum, max_steps=2)
    return found._replace(problem=problem.at(found.problem), result=RESULTS.successful)


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
    wrong = nothing_wrong(Given(prepared.block, prepared.ground))
    far, *others = [sizes > CLEAR for sizes in _sizes(found.problem)]
    of_known = others[: len(prepared.known)]
    wrong.rays[prepared.numbered.rays] = far
    number = len(wrong.control)
    control = spread_known(prepared.known, of_known, number, False)
    return wrong._replace(control=control)


def _worst(adjusted: BlockAdjustment, tested: Tested) -> Wrong:
    """The largest w beyond the limit: a bar; or one known point with all its coordinates,
    where this is larger than those of its rays are; or one ray of each point and each
    photo, with all others that explain the misfit as well."""
    block = adjusted.block
    nothing = nothing_wrong(Given(block, adjusted.ground, bars=adjusted.bars))
    of_ray = np.max(np.nan_to_num(np.abs(tested.rays)), axis=1)
    of_point = np.zeros(len(block.points))
    np.maximum.at(of_point, block.point, of_ray)
    of_bar = np.nan_to_num(np.abs(tested.bars))
    of_known = np.max(np.nan_to_num(np.abs(tested.control)), axis=1, initial=0.0)
    # the error of a bar or of a known point is in the residuals of all rays around it
    if np.max(of_bar, initial=0.0) > max(tested.limit, np.max(of_known, initial=0.0)):
        bar = int(np.argmax(of_bar))
        one, other = (ends[bar] for ends in adjusted.lengths.numbers_in(block))
        if of_bar[bar] > max(of_point[one], of_point[other]):
            nothing.bars[bar] = True
            return nothing
    if adjusted.ground is not None and len(of_known) > 0:
        worst = int(np.argmax(of_known))
        number = adjusted.ground.numbers_in(block)[worst]
        station = adjusted.ground.station[worst]
        beside = 0.0 if station or number < 0 else of_point[number]
        if of_known[worst] > max(tested.limit, beside):
            nothing.control[worst] = True
            return nothing
    free_points = np.ones(len(block.points), bool)
    free_photos = np.ones(len(block.photos), bool)
    rays = nothing.rays
    for ray in np.argsort(-of_ray):
        if of_ray[ray] <= tested.limit:
            break
        point, photo = block.point[ray], block.photo[ray]
        if free_points[point] and free_photos[photo]:
            rays[ray] = True
            free_points[point] = free_photos[photo] = False
    out = decide(adjusted, rays)
    is_new = bool(np.any(out & adjusted.numbered.rays))
    return nothing._replace(rays=out if is_new else rays)
