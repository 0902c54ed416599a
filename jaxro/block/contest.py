"""Why a block contradicts what was given: a contest of causes.

Each cause is a hypothesis about a whole group: the coordinates of the control are those
of a mirror image, the stations have another height system, the focal length is another
one, the standard deviations are too small. The block is adjusted anew under each, and
the one that explains the measurements best is the cause, if after it nothing contradicts
any more.

    D = Σ min(w², c²) + 2 n log(factor of the standard deviations) + c² for each unknown

over all coordinates that were measured or are known, left out or not: what is left out
costs c², and what has lost its place as well.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..adjustment import RESULTS
from ..camera.inner import MODES, Inner, names_of
from .adjust import BlockAdjustment
from .adjust_chained import Outcome, adjust_chained
from .bars import differences
from .cameras import MOST_FIELDS, cameras_of
from .chain import Chained
from .columns import EQUAL_HEIGHTS, UNCERTAIN, Altered, Cause, Known, alter
from .confusable import tell_confusable
from .contradictions import contradictions
from .given import Given
from .measured_block import Ground
from .place import TooLittleControl, known_in_chain, place_known, similarities
from .wrong import CLEAR

CUT = CLEAR**2
"""What a coordinate costs at most, and an unknown."""

MARGIN = 2 * CUT
"""D falls by more than this under a cause: that is so of the best one of many places,
however many others fit as well before."""

BETTER = 0.9
"""Part of D that another camera, or larger standard deviations, leave at most: hardly a
lens is free of the last micrometre of distortion."""

CLEARLY = 1.5
"""D for each coordinate at which no other cause is looked for: 1 is expected."""

BADLY = 4.0
"""D for each coordinate from which on a displacement field is tried: its programs are
large, and lenses differ a little from any series."""

TRIED = 4
"""Hypotheses about the ground that are adjusted, of those that place the block best."""

WELL_PLACED = 0.5
"""Part of the misfits of the known points that a hypothesis leaves at most, to be looked
at where nothing else is suspicious."""


class Hypothesis(NamedTuple):
    """What may be wrong: its name, what would be given then, and what to say of the
    outcome."""

    name: str
    given: Given
    say: Callable[[Outcome], str]
    unknowns: int = 0
    factor: float = 1.0
    margin: float = MARGIN
    """By more than this D falls, if it is the cause."""

    @property
    def of_ground(self) -> bool:
        """Whether it is about what is known, and not about how it was measured."""
        return self.name not in OF_MEASUREMENT


def find_cause(
    given: Given,
    chained: Chained,
    outcome: Outcome | None,
    level: float = 0.05,
    *,
    sigma_known: bool = True,
    ground_alone: bool = False,
) -> tuple[Cause, Outcome] | None:
    """The hypothesis that explains everything, with the adjustment under it; None where
    there is none. `outcome`: of what was given, None where it could not be adjusted;
    `ground_alone`: without hypotheses about cameras and standard deviations, which
    compile programs of their own."""
    usual = np.inf if outcome is None else _deviance(given, outcome, 0, 1.0)
    best, found = usual, None
    for one in _hypotheses(given, chained, outcome, level, sigma_known, ground_alone):
        tried = _adjust(one.given, chained, level)
        if tried is None or tried.adjusted.result != RESULTS.successful:
            continue
        cost = _deviance(one.given, tried, one.unknowns, one.factor)
        left = contradictions(
            one.given, tried.adjusted, tried.wrong, sigma_known=sigma_known
        )
        is_better = cost < usual - one.margin
        is_better &= one.of_ground or cost < BETTER * usual
        if cost < best and is_better and tried.wrong.settled and not left:
            best, found = cost, (Cause(one.name, one.say(tried)), tried)
            if one.of_ground and cost < CLEARLY * _coordinates(given):
                break
    return found


def is_misplaced(given: Given, chained: Chained) -> bool:
    """Whether some hypothesis about the ground places the chained block far better, or
    all heights are one: a strip may bend until they fit."""
    return bool(_of_ground(given, chained, WELL_PLACED))


def _coordinates(given: Given) -> int:
    """How many coordinates are measured or known."""
    known = given.known
    return 2 * len(given.block.photo) + int(np.sum(np.isfinite(known.coordinates)))


def _adjust(given: Given, chained: Chained, level: float) -> Outcome | None:
    """The outcome, None where the control does not place the block."""
    try:
        return adjust_chained(given, chained, level)
    except TooLittleControl:
        return None


def _deviance(given: Given, outcome: Outcome, unknowns: int, factor: float) -> float:
    """D of an outcome."""
    adjusted, block = outcome.adjusted, given.block
    white = adjusted.misfits / block.sigma[:, None]
    lost = ~np.isfinite(white[:, 0])
    cut = lambda w: float(np.sum(np.minimum(np.nan_to_num(w, nan=CLEAR) ** 2, CUT)))
    cost = cut(white[~lost]) + CUT * int(np.sum(lost))
    ground = given.known
    off, spread = adjusted.compare(ground)
    taken = (ground.numbers_in(block) >= 0)[:, None] & ~ground.check[:, None]
    taken = taken & np.isfinite(ground.coordinates)
    deviation = np.hypot(ground.sigma, np.where(outcome.wrong.control, spread, 0.0))
    cost += cut((off / deviation)[taken])
    off, spread = differences(
        given.lengths, block, adjusted.coordinates, adjusted.point_covariances
    )
    cost += cut(off / np.hypot(given.lengths.sigma, spread * outcome.wrong.bars))
    return cost + 4 * len(block.photo) * np.log(factor) + CUT * unknowns


# -------------------------------------------------------------------------------------
# the hypotheses


def _hypotheses(
    given: Given,
    chained: Chained,
    outcome: Outcome | None,
    level: float,
    sigma_known: bool,
    ground_alone: bool,
) -> Iterator[Hypothesis]:
    """All of them, the cheap ones first."""
    yield from _of_ground(given, chained)
    yield from _of_bars(given, outcome)
    if ground_alone:
        return
    yield from _of_single_points(given, chained, level)
    if outcome is None or _fits_badly(given, outcome):
        yield from _of_field(given)
    yield from _of_cameras(given)
    if outcome is not None and sigma_known:
        yield from _of_sigma(given, outcome)


def _of_ground(given: Given, chained: Chained, most: float = 1.0) -> list[Hypothesis]:
    """Whole columns of the known points, of the stations, or of both; those that place
    the chained block best, and leave at most this part of the misfits."""
    ground = given.ground
    if ground is None:
        return []
    own = ~ground.check
    points, stations = ~ground.station, ground.station
    groups = [(points, "known points")]
    if np.any(stations & own):
        groups = [(points | stations, "known coordinates"), *groups]
        groups.append((stations, "known stations"))
    tried = []
    for rows, who in groups:
        for one in alter(ground.coordinates, rows, who):
            tried.append((_known_by(ground, one), one.name, one.sentence))
    model = known_in_chain(given.block, chained, ground)
    if (shifted := _shift_stations(ground, model)) is not None:
        tried.append(shifted)
    limit = most * _misplaced(model, ground)
    # what is unknown does not show in where a block is placed
    sizes = [
        0.0 if name == EQUAL_HEIGHTS else _misplaced(model, changed)
        for changed, name, _ in tried
    ]
    order = np.argsort(sizes, kind="stable")[:TRIED]
    return [
        Hypothesis(
            tried[k][1],
            given._replace(ground=tried[k][0]),
            lambda _, said=tried[k][2]: said,
        )
        for k in order
        if sizes[k] < limit
    ]


def _known_by(ground: Ground, altered: Altered) -> Ground:
    """The ground under a hypothesis; what it calls unknown is uncertain by a part of the
    extent of the ground."""
    plan = ground.coordinates[:, :2]
    extent = np.max(np.nanmax(plan, axis=0) - np.nanmin(plan, axis=0))
    sigma = np.where(altered.unknown, UNCERTAIN * extent, ground.sigma)
    return ground._replace(coordinates=altered.coordinates, sigma=sigma)


def _misplaced(model: Known, ground: Ground) -> float:
    """How far known points are from the placed block, by where they are in the chained
    one: the mean root of their distances, which few wrong ones hardly change; infinite
    where they do not place it."""
    try:
        apart = place_known(model, ground).apart
    except TooLittleControl:
        return np.inf
    return float(np.mean(np.sqrt(apart[np.isfinite(apart)])))


def _shift_stations(ground: Ground, model: Known) -> tuple[Ground, str, str] | None:
    """The ground with all stations shifted as their differences from the known points
    say. Points and stations, each about their middle, tell rotation and scale."""
    whole = np.all(np.isfinite(ground.coordinates), axis=1) & ~ground.check
    use = whole & np.all(np.isfinite(model), axis=1)
    sets = [np.flatnonzero(use & which) for which in (~ground.station, ground.station)]
    if any(len(rows) == 0 for rows in sets) or sum(map(len, sets)) < 4:
        return None
    at = ground.coordinates
    middle = lambda a: np.concatenate([a[rows] - a[rows].mean(axis=0) for rows in sets])
    (rotation,), (scale,), _ = similarities(middle(model)[None], middle(at)[None])
    left = at - scale * model @ rotation.T
    of_points, of_stations = (np.median(left[rows], axis=0) for rows in sets)
    shift = of_stations - of_points
    if not np.all(np.isfinite(shift)):
        return None
    moved = np.where(ground.station[:, None], at - shift, at)
    told = ", ".join(f"{value:.3g}" for value in shift)
    return (
        ground._replace(coordinates=moved),
        "stations_shifted",
        "Known points and known stations contradict each other by a common shift of "
        f"about ({told}) in X, Y, Z; without it everything fits. Neither is called wrong: "
        "look at height systems (ellipsoidal or above the sea) and datums",
    )


def _of_single_points(
    given: Given, chained: Chained, level: float
) -> Iterator[Hypothesis]:
    """One known point that is wrong: of few ones it bends the block, and takes the others
    with it. Those are tried without which the others are best placed."""
    ground = given.ground
    if ground is None:
        return
    own = ~ground.check & ~ground.station
    rows = np.flatnonzero(own & np.any(np.isfinite(ground.coordinates), axis=1))
    model = known_in_chain(given.block, chained, ground)
    without = {k: _without(ground, k) for k in rows.tolist()}
    sizes = {k: _misplaced(model, left) for k, left in without.items()}
    for k in sorted(sizes, key=lambda k: sizes[k])[:TRIED]:
        if np.isfinite(sizes[k]):
            yield Hypothesis(
                "known_point",
                given._replace(ground=without[k]),
                lambda found, k=k: _say_single(given, found, k, level),
                unknowns=int(np.sum(np.isfinite(ground.coordinates[k]))),
            )


def _without(ground: Ground, k: int) -> Ground:
    """The ground without the coordinates of one of its points."""
    coordinates = ground.coordinates.copy()
    coordinates[k] = np.nan
    return ground._replace(coordinates=coordinates)


def _say_single(given: Given, found: Outcome, k: int, level: float) -> str:
    """That one known point is wrong, or which ones cannot be told apart."""
    control = found.wrong.control.copy()
    control[k] = np.isfinite(given.known.coordinates[k])
    left_out = found._replace(wrong=found.wrong._replace(control=control))
    confusable = tell_confusable(given, left_out, level)
    if confusable is not None:
        return confusable.sentence
    off, _ = found.adjusted.compare(given.known)
    told = ", ".join(f"{-value:.3g}" for value in off[k])
    return (
        f"Without the known point {given.known.points[k]} everything fits; its "
        f"coordinates are off by ({told}) in X, Y, Z"
    )


UNITS = ((1000.0, "millimetres"), (100.0, "centimetres"), (1 / 0.3048, "feet"))
"""How often a length in another unit is larger than in metres."""

BAR_UNIT = "bar_unit"
"""The hypothesis that some bars are in another unit."""


def _of_bars(given: Given, outcome: Outcome | None) -> Iterator[Hypothesis]:
    """Bars that do not fit, in another unit."""
    if given.bars is None or outcome is None or not np.any(outcome.wrong.bars):
        return
    wrong = outcome.wrong.bars
    for factor, unit in UNITS:
        for power, of in (
            (1 / factor, f"{unit}"),
            (factor, f"metres, and the others {unit}"),
        ):
            length = np.where(wrong, given.bars.length * power, given.bars.length)
            named = ", ".join(
                f"{given.bars.one[k]}-{given.bars.other[k]}"
                for k in np.flatnonzero(wrong)
            )
            yield Hypothesis(
                BAR_UNIT,
                given._replace(bars=given.bars._replace(length=length)),
                lambda _, named=named, of=of: (
                    f"The length of the scale bar {named} is in {of}: so everything fits"
                ),
                # a wrong length hardly fits in another unit by chance
                margin=CUT / 2,
            )


CAMERA = (
    (Inner(focal=True, principal=False), "focal", "the focal length"),
    (Inner(focal=False, principal=True), "principal", "the principal point"),
    (Inner(focal=False, principal=False, radial=1), "radial", "a radial distortion k1"),
)
"""Inner parameters that may be wrong."""


def _of_cameras(given: Given) -> Iterator[Hypothesis]:
    """Inner parameters that are not what was given."""
    if given.inner is not None:
        return
    for inner, name, said in CAMERA:

        def say(outcome: Outcome, said: str = said) -> str:
            return f"With {said} free, {_figures(outcome.adjusted)}, everything fits"

        free = given._replace(inner=inner)
        yield Hypothesis(name, free, say, unknowns=len(inner.free))


def _fits_badly(given: Given, outcome: Outcome) -> bool:
    """Whether far more is amiss than standard deviations that are somewhat small."""
    return _deviance(given, outcome, 0, 1.0) > BADLY * _coordinates(given)


def _of_field(given: Given) -> Iterator[Hypothesis]:
    """A distortion that no focal length and no lens has: of film, of a scan."""
    inner = Inner() if given.inner is None else given.inner
    if inner.field or cameras_of(given.block).number > MOST_FIELDS:
        return

    def say(outcome: Outcome) -> str:
        largest = max(one.largest for one in outcome.adjusted.fields)
        return (
            "With a displacement field of the camera (--inner "
            f"{','.join((*names_of(inner), 'field'))}), up to {largest:.2g} in the unit of "
            "the photos, everything fits"
        )

    yield Hypothesis(
        "field",
        given._replace(inner=inner._replace(field=True)),
        say,
        unknowns=len(inner.free) + MODES,
    )


def _figures(adjusted: BlockAdjustment) -> str:
    """The inner parameters that were found, with their deviations."""
    found = adjusted.cameras
    told = [
        f"{name} {value:.6g} ± {spread:.2g}"
        for own, deviations in zip(found.values, found.deviations, strict=True)
        for name, value, spread in zip(found.names, own, deviations, strict=True)
    ]
    return ", ".join(told)


OF_MEASUREMENT = (*(name for _, name, _ in CAMERA), "field", "sigma")
"""The names of hypotheses about how was measured."""

HARMLESS = (*OF_MEASUREMENT, BAR_UNIT)
"""Those beside which the numbers may be used, if they hardly move a point."""

SPREAD = 1.4826
"""A normal standard deviation over the median of its absolute values."""

TIMES = (1.0, 2.0, 4.0)
"""The factor of the standard deviations that is tried over what the misfits tell: in an
adjustment that left out too much they are too small."""


def _of_sigma(given: Given, outcome: Outcome) -> Iterator[Hypothesis]:
    """Places less accurate than was said: a factor as all their misfits tell it."""
    block = given.block
    white = np.abs(outcome.adjusted.misfits / block.sigma[:, None])
    checked = np.mean(np.nan_to_num(outcome.adjusted.redundancy))
    factor = SPREAD * float(np.nanmedian(white)) / np.sqrt(max(checked, 0.1))
    for times in TIMES:
        larger = factor * times
        if larger > 1.5:
            yield Hypothesis(
                "sigma",
                given._replace(block=block._replace(sigma=block.sigma * larger)),
                lambda found, larger=larger: (
                    "With standard deviations of the places "
                    f"{larger * found.adjusted.sigma0:.2g} times as large everything fits"
                ),
                unknowns=1,
                factor=larger,
            )
