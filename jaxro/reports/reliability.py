"""How far the measurements of a pair check one another, on the terminal: a table and
sentences."""

import math

import numpy as np
from jaxtyping import Bool
from rich.console import Console

from ..adjustment import critical_values
from ..assessment.likelihood import CURVED
from ..assessment.reliability import BOUNDS
from ..orientation.degeneracy import FEW
from ..orientation.verdict import WEAK
from .model import USUAL, Element, One, Results
from .pair import digits, join_names, table, unit_name
from .rows import left_out, worst
from .text import escape, number

DOUBTFUL = 0.05
"""Probability of sigma0 below which it is mentioned."""

RARE = 0.001
"""The same of a pair among many."""


def show(console: Console, results: Results) -> None:
    """Of one pair the table of the points, if any can be tested, and what a surveyor
    should mind; of many what to mind of all together."""
    if len(results) == 1:
        one = One(results, 0)
        points = test_columns(one)
        if points:
            _show_points(console, one, points)
        said = sentences(one)
    else:
        said = sentences_of_many(results)
    for sentence in said:
        console.print(f"[yellow]Mind:[/yellow] {escape(sentence)}")


def test_columns(one: One) -> dict[str, np.ndarray]:
    """The reliability of the points; empty where no point can be tested."""
    if "reliability" not in one.results.of_points:
        return {}
    points = one.of_points("reliability")
    return points if np.any(np.isfinite(points["w"])) else {}


def _limit(points: dict[str, np.ndarray]) -> float:
    """The limit of |w|, which is one for all points."""
    return float(np.nanmax(points["limit"]))


def _show_points(console: Console, one: One, points: dict[str, np.ndarray]) -> None:
    """r, |w|, the error of y_right that is just found, and what it does."""
    results, limit = one.results, _limit(points)
    w = "|w|" if results.sigma_known else "tau"
    title = (
        f"r; {w}, limit {limit:.2f}; error of y_right found from "
        f"[{results.units.photo}],\n"
        f"moving Z of its point [{unit_name(results.units.model)}] and elements [sd]"
    )
    rows = table("point", "r", w, "found from", "moving Z", "elements", title=title)
    sizes = np.nan_to_num(np.abs(points["w"]))
    for i in worst(list(range(one.count)), lambda i: -sizes[i]):
        found = points["detectable_y_right"][i]
        moves = points["effect_on_Z_of_y_right"][i]
        rows.add_row(
            escape(one.points[i]),
            number(points["redundancy"][i], 2),
            number(sizes[i], 2),
            number(found, digits(found, 1)),
            number(moves, digits(moves, 1)),
            number(points["external_reliability"][i], 1),
            style="yellow" if sizes[i] > limit else None,
        )
    console.print(rows)
    left_out(console, one.count, "points, those with the largest |w| shown")


def sentences(one: One) -> list[str]:
    """What to mind of a usable orientation."""
    if not one.usable:
        return []
    freedom, points = one.value("degrees_of_freedom"), test_columns(one)
    if freedom == 0:
        return ["Five points: no measurement checks another, and no error would show."]
    said = []
    if not points and freedom == 1:
        said.append(
            "One degree of freedom: an error would enlarge sigma0, but no point can be "
            "tested. Measure more points, or "
            "give --sigma."
        )
    said += doubts(one)
    if len(one.results) == 1:
        said += _neighbours(one.results)
    said += _chosen_by_sigma0(one) + _bent_deviations(one)
    said += _weak_points(one, points)
    return said + promises(one)


def doubts(one: One) -> list[str]:
    """What the tests of sigma0 and of the points say against a usable orientation."""
    points = test_columns(one)
    return _doubt_sigma(one) + _doubt_points(one, points) if points else []


def chance_of_sigma0(one: One) -> float:
    """The probability of a sigma0 that is farther from 1, where sigma is given."""
    ratio, freedom = one.value("sigma0"), one.value("degrees_of_freedom")
    return float(critical_values.global_p(freedom * ratio**2, freedom))


def sentences_of_many(results: Results) -> list[str]:
    """What to mind of all pairs together."""
    promised = [f"{one.name}: {said}" for one in results for said in promises(one)]
    together = _doubt_sigma_of_many(results) + _neighbours(results)
    return together + _closures(results) + promised


def find_too_large(results: Results) -> Bool[np.ndarray, " pair"]:
    """The usable pairs whose sigma0 is larger than the given sigma allows: of good pairs
    one in a thousand."""
    freedom = results.of_pairs["degrees_of_freedom"]
    ratio = np.nan_to_num(results.of_pairs["sigma0"])
    if not results.sigma_known:
        return np.zeros(len(results), bool)
    some = np.maximum(freedom, 1)
    chance = np.asarray(critical_values.global_p(some * ratio**2, some))
    return results.usable & (freedom > 0) & (ratio > 1) & (chance < RARE)


def _doubt_sigma_of_many(results: Results) -> list[str]:
    too_large = int(np.sum(find_too_large(results)))
    expected = RARE / 2 * len(results)
    if too_large <= max(3 * expected, 0.5):
        return []
    return [
        f"In {too_large} pairs the coordinates are less accurate than their sigma says "
        f"(of good pairs {number(expected, 1)} would look like this): sigma is too "
        "small, or points are wrong, which jaxro clean finds."
    ]


def _weak_points(one: One, points: dict[str, np.ndarray]) -> list[str]:
    """Points that the others check poorly or not at all."""
    redundancy = one.of_points("residuals")["redundancy"]
    nothing = redundancy < BOUNDS[0]
    poorly = (redundancy < BOUNDS[1]) & ~nothing
    said = []
    if nothing.any():
        said.append(
            f"Nothing checks {_list(one, nothing)} (redundancy below {BOUNDS[0]}): "
            "an error there never shows."
        )
    if poorly.any():
        hidden = points["detectable_y_right"][poorly] if points else np.zeros(0)
        hidden = hidden[np.isfinite(hidden)]
        size = ""
        if hidden.size:
            most = float(hidden.max())
            size = (
                f"; an error of {number(most, digits(most, 1))} "
                f"{one.results.units.photo} in y may not show"
            )
        said.append(
            f"Poorly checked (redundancy below {BOUNDS[1]}): "
            f"{_list(one, poorly)}{size}."
        )
    return said


def _neighbours(results: Results) -> list[str]:
    """What it means that neighbours agree, where they do."""
    pattern, units = results.pattern, results.units
    if pattern is None or not pattern.flagged:
        return []
    rho, length, chance = (
        float(x) for x in (pattern.rho, pattern.length, pattern.probability)
    )
    of = "" if len(results) == 1 else " of all pairs together"
    said = (
        f"The errors of neighbours{of} agree by {number(rho, 1)}, over about "
        f"{number(length, digits(length, 0))} {units.photo} (probability {chance:.1g})"
    )
    if results.growth is None:
        return [f"{said}: if that is no chance, the standard deviations are too small."]
    larger = number(results.growth, digits(results.growth, 1))
    return [
        f"{said}: the standard deviations allow for it, and are {larger} times those of "
        "independent errors."
    ]


def _closures(results: Results) -> list[str]:
    """What it means that triplets of photos do not close, where they do not."""
    closures = results.closures
    if closures is None or not closures.open:
        return []
    several, worst = len(closures.photos), closures.worst
    factor = number(math.sqrt(closures.ratio), 1)
    angle = math.degrees(closures.angles[worst])
    own = number(math.sqrt(closures.squares[worst] / 3), 1)
    of = "Three photos do" if several == 1 else f"{several} triplets of photos do"
    return [
        f"{of} not close: their rotations are off by {factor} times what the standard "
        f"deviations say (probability {closures.probability:.1g}), most those of "
        f"{', '.join(closures.photos[worst])} ({number(angle, digits(angle))}°, {own} "
        "times). A pair is wrong, or pairs have errors in common, such as those of "
        "the lens, of which their standard deviations know nothing."
    ]


def promises(one: One) -> list[str]:
    """What simulation says that the intervals of a cleaned pair hold."""
    told = one.promise
    if told is None:
        return []
    percent = lambda share: f"{100 * float(share):.0f} %"
    known = one.results.sigma_known
    each = told.intervals_known if known else told.intervals
    region = told.coverage_known if known else told.coverage
    listed = ", ".join(
        f"{e.name} {percent(share)}"
        for e, share in zip(one.elements, each, strict=True)
        if e.deviation is not None
    )
    return [
        f"In {told.repetitions} simulated pairs like this one, with as many wrong points "
        f"of the same size, {percent(told.answered)} were oriented, "
        f"{percent(told.exactly_right)} of these with just the right points. After the "
        f"same decision, in {percent(told.alike)}, intervals of "
        f"{percent(told.confidence)} hold {listed}, and the joint region "
        f"{percent(region)}."
    ]


def _bent_deviations(one: One) -> list[str]:
    """Where deviations do not say it all, what the measurements themselves say."""
    curvature = one.value("curvature")
    if not curvature > CURVED:
        return []
    said = (
        "The misfit bends within the deviations, which then hold less often than they "
        f"say (curvature {number(curvature, 1)}, above {CURVED})."
    )
    told = [e for e in one.elements if e.by_likelihood is not None]
    if not told:
        return [said]
    confidence = one.results.confidence or USUAL
    between = ", ".join(_between(e) for e in told)
    return [f"{said} By likelihood {100 * confidence:g} % hold {between}."]


def _between(e: Element) -> str:
    """The interval by likelihood of an element."""
    decimals, ends = digits(e.deviation), e.by_likelihood or ()
    least, most = (
        number(end, decimals) if np.isfinite(end) else "no end" for end in ends
    )
    return f"{e.name} {least} to {most} {unit_name(e.unit)}".rstrip()


def _doubt_sigma(one: One) -> list[str]:
    """What the test of sigma0 against the given sigma found."""
    ratio = one.value("sigma0")
    if not one.results.sigma_known:
        return []
    chance = chance_of_sigma0(one)
    if chance >= DOUBTFUL:
        return []
    if ratio > 1:
        return [
            f"The coordinates are {ratio:.1f} times less accurate than their sigma "
            f"says (probability {chance:.1g}): sigma is too small, or points are wrong."
        ]
    return [
        f"The coordinates are {1 / ratio:.1f} times more accurate than their sigma "
        f"says (probability {chance:.1g}): sigma is too large."
    ]


def _doubt_points(one: One, points: dict[str, np.ndarray]) -> list[str]:
    """What the tests of the points found."""
    w, limit = np.nan_to_num(np.abs(points["w"])), _limit(points)
    if not np.max(w) > limit:
        return []
    others = int(np.sum(w > limit)) - 1
    also = ""
    if others:
        plural = "s" * (others != 1)
        also = f"; so has {others} other point{plural}, perhaps because of it"
    return [
        f"Point {one.points[int(np.argmax(w))]} has "
        f"|{'w' if one.results.sigma_known else 'tau'}| = {np.max(w):.2f} "
        f"where {limit:.2f} is allowed{also}. Measure it again, or see jaxro clean."
    ]


def may_be_chance(deviation: float, freedom: int) -> bool:
    """Whether a layout of this largest deviation (rad), by a sigma0 of so many degrees
    of freedom, may have been accepted as sigma0 is small by chance, of a thousand once.
    Pairs of `FEW` are judged by what is expected before the measurement."""
    if freedom <= FEW:
        return False
    return (
        deviation * math.sqrt(freedom / critical_values.chi_squared(1 - RARE, freedom))
        > WEAK
    )


def _chosen_by_sigma0(one: One) -> list[str]:
    """What it means that a weak layout was accepted for a sigma0 of few points, where
    none is known that does not depend on them."""
    freedom, results = one.value("degrees_of_freedom"), one.results
    cofactor = results.of_pairs["cofactor"][one.number]
    angles = np.array(results.system.angles)
    root = math.sqrt(np.max(np.diagonal(cofactor)[angles]))
    largest = one.value("sigma0") * root
    if results.sigma_known or not may_be_chance(largest, freedom):
        return []
    return [
        f"sigma0 comes from {freedom} degrees of freedom, and with "
        f"{number(WEAK / largest, 1)} times as much the layout would be refused as too "
        "weak: pairs accepted for a sigma0 that is small by chance have intervals that "
        "are too narrow. Measure more points, or give --sigma."
    ]


def _list(one: One, those: np.ndarray) -> str:
    names = [one.points[i] for i in np.flatnonzero(those)]
    some = join_names(names, 10)
    return f"point{'s' * (len(names) > 1)} {some}"
