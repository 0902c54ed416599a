"""The page of an adjusted block: internal consistency apart from accuracy on the
ground."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import block as report
from ..block_model import Done
from ..block_sentences import doubts, sentences
from ..control import AXES
from ..pair import digits
from ..rows import most_rows
from ..text import number
from . import pictures
from .page import Block, Facts, Page, Prose, Row, Section, Table, Tone
from .recorded import as_prose, record

MEANINGS = (
    ("sigma0", "Root of the sum of squares of all residuals over their standard "
     "deviations, by the degrees of freedom: of image coordinates, control and scale bars "
     "together. 1 is expected where the standard deviations are right."),
    ("± sd", "From the covariance of the rigorous adjustment of the image measurements "
     "(six unknowns for each photo, points eliminated), times sigma0²: no model "
     "coordinate is treated as if it had been measured."),
    ("r", "Redundancy: the share of an error of a measurement that shows in its residual."),
    ("|w|", "The residual over its standard deviation. The limit is exceeded with 5 % "
     "probability by the largest of all if none is wrong."),
    ("check points", "Known points that took no part: adjusted minus given, and this over "
     "the standard deviation of the difference. They alone tell the accuracy on the "
     "ground independently of the adjustment."),
    ("left out", "Places and control that the tests called wrong, one after another; the "
     "others were adjusted anew."),
)  # fmt: skip
"""How each figure of the page is computed."""


def page_of_block(done: Done, settings: Sequence[tuple[str, str]]) -> Page:
    """The page of a call of `jaxro block`."""
    sections = []
    if done.usable:
        inside = [
            *record(report.show_consistency, done),
            *pictures.of_block(done),
            *record(report.show_control, done),
            *record(report.show_bars, done),
        ]
        outside = [
            *record(report.show_accuracy, done),
            *(record(report.show_check_points, done) or [NO_CHECKS]),
        ]
        places: list[Block] = [
            *record(report.show_photos, done),
            *record(report.show_cameras, done),
        ]
        sections = [
            Section("Internal consistency: do photos and control agree?", inside),
            Section("External accuracy: how good is the ground?", outside),
            Section("Photos", places),
            Section("Points", [_points(done)]),
            Section("How each figure is computed", [Facts(MEANINGS)]),
        ]
    verdict = as_prose(report.verdict(done), markup=True)
    if done.usable and doubts(done):
        verdict = replace(verdict, tone=Tone.mind)
    return Page(
        title=f"Block of {done.title}",
        about=report.contents_in_words(done),
        verdict=verdict,
        mind=sentences(done),
        sections=sections,
        settings=settings,
    )


NO_CHECKS = Prose(
    "There are no check points: the standard deviations follow from the measurements "
    "and the control, and nothing independent confirms them."
)


def _points(done: Done) -> Table:
    """Coordinates with their standard deviations; of many the weakest."""
    adjusted, there = done.adjusted, np.flatnonzero(done.determined)
    places, deviations = adjusted.coordinates, adjusted.deviations
    decimals = digits(float(np.median(deviations[there])), 1)
    weakness = np.max(deviations[there], axis=1)
    shown = there[np.sort(np.argsort(-weakness)[: most_rows()])]
    photos = done.photos_of_points
    rows = [
        Row(
            [
                adjusted.block.points[k],
                *(number(value, decimals) for value in places[k]),
                *(number(value, decimals) for value in deviations[k]),
                str(photos[k]),
            ]
        )
        for k in shown
    ]
    note = ""
    if len(shown) < len(there):
        note = (
            f"{len(shown)} of {len(there)} points, the weakest; --out DIR writes all."
        )
    heads = ["point", *AXES, *(f"sd {axis}" for axis in AXES), "photos"]
    numbers = [False] + [True] * (len(heads) - 1)
    return Table(f"Points [{done.unit}]", heads, numbers, rows, note)
