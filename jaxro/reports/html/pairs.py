"""The page of oriented pairs, cleaned before or not: of one pair everything; of many an
overview, and everything of the worst ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from .. import cleaning, reliability
from ..columns import OUTCOME_ADVICE
from ..model import One, Results
from ..pair import (
    describe_rotation,
    digits,
    show_elements,
    show_numbers,
    unit_name,
)
from ..pair_plots import worst
from ..rows import showing
from ..text import number
from ..verdicts import Verdicts
from . import pictures
from .page import Block, Facts, Figure, Page, Prose, Row, Section, Table, Tone
from .pair_points import points_table
from .recorded import record

MOST_DETAILED = 100
"""Pairs of a table that are told in full: the worst."""

MOST_DRAWN = 1_500_000
"""Bytes of the pictures of the worst pairs of a table: the first ones have pictures."""

ROWS_IN_DETAILS = 40
"""Points of such a pair that are shown: the worst."""

MEANINGS = (
    ("sigma0", "√(Σ r² / (n - 5)) of the whitened residuals r of n points. It is the "
     "standard deviation of a coordinate in its unit, or, where sigma is given, the "
     "ratio to it: 1 is expected."),
    ("± sd", "sigma0 times the root of the cofactor, which is the inverse of the normal "
     "equations; derivatives are exact (automatic differentiation)."),
    ("m_q, q", "q is the y-parallax of the photos turned parallel to the base; m_q = "
     "√(Σ q² / (n - 5))."),
    ("v", "Corrections of the four coordinates of a point: the smallest that let its two "
     "rays meet."),
    ("r", "Redundancy: the share of an error of a point that shows in its residual. All "
     "of a pair add up to its degrees of freedom; below 0.1 a point is poorly checked."),
    ("|w|, tau", "The residual over its standard deviation (Baarda; tau by Pope where "
     "sigma is not known). One good point in a thousand is beyond the limit."),
    ("found from", "The smallest error of y_right that the test finds in 80 % of cases; "
     "moving Z: how far an error of this size, if it is not found, moves the height of "
     "the point."),
    ("X, Y, Z", "The model: where the two rays of the corrected coordinates meet, in the "
     "frame of the left photo; Z is negative below the photo."),
)  # fmt: skip
"""How each figure of the page is computed."""


@dataclass(frozen=True)
class Cleaned:
    """What a procedure decided, its name and its tolerances."""

    verdicts: Verdicts
    procedure: str
    tolerances: Mapping[str, bool | int | float | None]

    @property
    def in_words(self) -> str:
        """The procedure with all its numbers."""
        numbers = [f"{name}={value}" for name, value in self.tolerances.items()]
        return f"{self.procedure}: {', '.join(numbers)}" if numbers else self.procedure


def page_of_pairs(
    results: Results,
    cleaned: Cleaned | None,
    settings: Sequence[tuple[str, str]],
) -> Page:
    """The page of a call of `jaxro orient` or `jaxro clean`."""
    make = _page_of_one if len(results) == 1 else _page_of_many
    return make(results, cleaned, settings)


# -------------------------------------------------------------------------------------
# one pair


def _page_of_one(
    results: Results, cleaned: Cleaned | None, settings: Sequence[tuple[str, str]]
) -> Page:
    one = One(results, 0)
    parts = _sections_of(one, cleaned, drawn=True)
    return Page(
        title=f"Relative orientation of {one.name}",
        about=f"{one.count} points{_rejected_in_words(cleaned)}, {_cameras(one)}",
        verdict=_verdict(one, cleaned, 0),
        mind=[*one.causes, *reliability.sentences(one)],
        sections=[*parts, _meanings()],
        settings=settings,
    )


def _sections_of(one: One, cleaned: Cleaned | None, drawn: bool) -> list[Section]:
    """Everything of a pair; `drawn`: with pictures."""
    inside: list[Block] = record(_consistency, one) if one.usable else []
    if cleaned is not None:
        inside += record(
            cleaning.show_one, cleaned.verdicts, one.number, one.results.units.photo
        )
    outside: list[Block] = record(show_elements, one) if one.usable else []
    if one.usable:
        outside.append(Prose(_hidden(one)))
    if drawn:
        inside += pictures.of_residuals(one, cleaned and cleaned.verdicts)
        outside += pictures.of_accuracy(one)
    parts = [
        Section("Internal consistency: do the measurements agree?", inside),
        Section("Accuracy: how good are the results?", outside),
        Section("Points", [points_table(one)] if one.count else []),
    ]
    return [part for part in parts if part.blocks]


def _consistency(console: Console, one: One) -> None:
    show_numbers(console, one)
    freedom, ratio = one.value("degrees_of_freedom"), one.value("sigma0")
    if one.results.sigma_known and freedom > 0:
        chance = reliability.chance_of_sigma0(one)
        said = "agrees" if chance >= reliability.DOUBTFUL else "does not agree"
        console.print(
            f"sigma0 {said} with the standard deviations given: a sigma0 as far from 1 "
            f"has the probability {chance:.2g}; here it is {ratio:.3g}.",
            markup=False,
        )


def _hidden(one: One) -> str:
    """What an error that the tests may miss could do, and what no figure here tells."""
    points = reliability.test_columns(one)
    alone = (
        "Standard deviations follow from the scatter of the measurements; a relative "
        "orientation has no check points, so that errors which all points share (of the "
        "camera, or of the film) do not show in them."
    )
    if not points:
        return alone
    moves = np.abs(points["effect_on_Z_of_y_right"])
    if not np.any(np.isfinite(moves)):
        return alone
    k = int(np.nanargmax(moves))
    size = number(moves[k], digits(moves[k], 1))
    error = points["detectable_y_right"][k]
    found = number(error, digits(error, 1))
    units = one.results.units
    return (
        f"An error that the tests miss in one case of five could move Z by {size} "
        f"{unit_name(units.model)} (point {one.points[k]}, {found} {units.photo} in "
        f"y). {alone}"
    )


def _verdict(one: One, cleaned: Cleaned | None, number_of: int) -> Prose:
    """Whether the elements may be used, in one sentence."""
    outcome = None if cleaned is None else cleaned.verdicts.outcomes[number_of]
    if not one.usable:
        turned = one.rotation
        more = "" if turned is None else f" {describe_rotation(turned)}."
        return Prose(f"Not usable: {one.advice}{more}", Tone.bad)
    if outcome not in (None, "finished"):
        return Prose(f"Not settled: {OUTCOME_ADVICE[outcome]}", Tone.bad)
    if one.advice:
        return Prose(f"Usable, with a reservation: {one.advice}", Tone.mind)
    m_q = number(one.value("m_q"), digits(one.value("m_q")))
    text = f"Usable: the rays of the points meet within {m_q} {one.results.units.photo}"
    doubts = reliability.doubts(one)
    if doubts:
        return Prose(f"{text}, but {doubts[0][0].lower()}{doubts[0][1:]}", Tone.mind)
    if not reliability.test_columns(one):
        return Prose(f"{text} (m_q); too few points to test single ones.", Tone.good)
    return Prose(f"{text} (m_q), and no test contradicts them.", Tone.good)


def _cameras(one: One) -> str:
    left, right = (camera.focal for camera in one.cameras)
    both = f"{left:g}" if left == right else f"{left:g} and {right:g}"
    return f"focal length {both} {one.results.units.photo}"


def _rejected_in_words(cleaned: Cleaned | None) -> str:
    if cleaned is None:
        return ""
    verdicts = cleaned.verdicts
    count, of = len(verdicts.rejected), len(verdicts.table.points)
    return f" kept, {count} of {of} rejected by {cleaned.procedure}"


def _meanings() -> Section:
    return Section("How each figure is computed", [Facts(MEANINGS)])


# -------------------------------------------------------------------------------------
# many pairs


def _page_of_many(
    results: Results, cleaned: Cleaned | None, settings: Sequence[tuple[str, str]]
) -> Page:
    order = np.array(worst(results, len(results)))
    told = order[:MOST_DETAILED].tolist()
    usable = int(results.usable.sum())
    return Page(
        title=f"Relative orientation of {len(results)} pairs",
        about=f"{len(results.table.points)} points{_rejected_in_words(cleaned)}, "
        f"{usable} pairs usable",
        verdict=_verdict_of_many(results, cleaned),
        mind=[*_causes(results), *reliability.sentences_of_many(results)],
        sections=[
            Section("Overview", _overview(results, cleaned, order, set(told))),
            Section("The worst pairs", [_worst_note(results, len(told))]),
            *_details_of(results, cleaned, told),
            _meanings(),
        ],
        settings=settings,
    )


def _verdict_of_many(results: Results, cleaned: Cleaned | None) -> Prose:
    count, usable = len(results), int(results.usable.sum())
    unsettled = 0
    if cleaned is not None:
        unsettled = sum(outcome != "finished" for outcome in cleaned.verdicts.outcomes)
    doubtful = int(np.sum(reliability.find_too_large(results)))
    if usable == count and not unsettled:
        if doubtful and reliability.sentences_of_many(results):
            return Prose(
                f"All {count} pairs have elements, and {doubtful} of them contradict "
                "their sigma.",
                Tone.mind,
            )
        return Prose(f"All {count} pairs are usable.", Tone.good)
    text = f"{usable} of {count} pairs are usable"
    if unsettled:
        text += f"; the cleaning of {unsettled} did not finish"
    return Prose(f"{text}.", Tone.mind if usable else Tone.bad)


def _worst_note(results: Results, told: int) -> Prose:
    text = "Those that failed, then those with the largest m_q; a click opens one."
    if told < len(results):
        text += (
            f" The other {len(results) - told} are in the overview alone; the tables "
            "of --out have all."
        )
    return Prose(text)


def _overview(
    results: Results, cleaned: Cleaned | None, order: np.ndarray, told: set[int]
) -> list[Block]:
    """Distribution of sigma0, and a row for each pair, in this order."""
    units = results.units
    adjusted = [e for e in One(results, 0).elements if e.deviation is not None]
    of_unit = lambda name, unit: f"{name} [{unit_name(unit)}]" if unit else name
    heads = [
        "pair",
        "points",
        *(["rejected"] if cleaned else []),
        *(of_unit(e.name, e.unit) for e in adjusted),
        of_unit("sigma0", units.sigma0),
        of_unit("m_q", units.photo),
        "result",
    ]
    left_out = np.zeros(len(results), int)
    if cleaned is not None:
        owners = cleaned.verdicts.table.owners[cleaned.verdicts.rejected]
        left_out = np.bincount(owners, minlength=len(results))
    names = [e.name for e in adjusted]
    rows = []
    for k in order.tolist():
        one = One(results, k)
        accuracy = [number(x, digits(x)) for x in map(one.value, ("sigma0", "m_q"))]
        cells = [
            one.name,
            str(one.count),
            *([str(left_out[k])] if cleaned else []),
            *(number(one.value(name), 4) for name in names),
            *accuracy,
            one.result,
        ]
        tone = Tone.plain if not one.advice else Tone.mind if one.usable else Tone.bad
        rows.append(Row(cells, tone, _anchor(k) if k in told else ""))
    numbers = [False, *[True] * (len(heads) - 2), False]
    return [
        *pictures.of_sigma0(results),
        *_advice(results),
        Table("All pairs, the worst first", heads, numbers, rows),
    ]


def _advice(results: Results) -> list[Block]:
    """What each result other than success means, with the number of its pairs."""
    found: dict[str, list[One]] = {}
    for one in results:
        if one.advice:
            found.setdefault(one.result, []).append(one)
    return [
        Prose(
            f"{name} ({len(members)} pair{'s' * (len(members) != 1)}): "
            f"{members[0].advice}",
            Tone.mind if members[0].usable else Tone.bad,
        )
        for name, members in found.items()
    ]


def _causes(results: Results) -> list[str]:
    """What is wrong with pairs as a whole."""
    told = results.causes
    return [f"{One(results, k).name}: {said}" for k in told for said in told[k]]


def _anchor(pair: int) -> str:
    return f"pair-{pair + 1}"


def _details_of(
    results: Results, cleaned: Cleaned | None, told: Sequence[int]
) -> list[Section]:
    """The pairs of these numbers, with pictures as long as there is room."""
    sections, size = [], 0
    with showing(ROWS_IN_DETAILS):
        for k in told:
            part = _details(One(results, k), cleaned, drawn=size < MOST_DRAWN)
            sections.append(part)
            size += sum(len(b.svg) for b in part.blocks if isinstance(b, Figure))
    return sections


def _details(one: One, cleaned: Cleaned | None, drawn: bool) -> Section:
    """A pair as a part that opens."""
    blocks: list[Block] = [_verdict(one, cleaned, one.number)]
    blocks += [Prose(text, Tone.mind) for text in reliability.sentences(one)]
    for part in _sections_of(one, cleaned, drawn):
        blocks += part.blocks
    m_q = number(one.value("m_q"), digits(one.value("m_q")))
    told = f"m_q {m_q} {one.results.units.photo}" if one.usable else one.result
    heading = f"{one.name}: {one.count} points, {told}"
    return Section(heading, blocks, _anchor(one.number), level=3)
