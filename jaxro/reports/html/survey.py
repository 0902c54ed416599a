"""The page of heights over a grid."""

from collections.abc import Sequence

from .. import survey as report
from ..survey_files import Done
from . import pictures
from .page import Facts, Page, Prose, Section, Tone
from .recorded import record

MEANINGS = (
    ("by (1)", "The height over the grid alone: formula (1) of the paper of 1982, from the "
     "parallax of the point and of the square behind it."),
    ("height", "Over the grid and over the traverses together, adjusted by least squares."),
    ("± sd", "From the standard deviations of the readings, the base, the camera height "
     "and the squares, by exact derivatives."),
    ("misclosure", "What the differences of height of a traverse leave between its ends; "
     "w is the misclosure over its standard deviation."),
    ("detectable", "The smallest error of a leg that the test finds in 80 % of cases."),
)  # fmt: skip
"""How each figure of the page is computed."""


def page_of_heights(
    done: Done, title: str, settings: Sequence[tuple[str, str]]
) -> Page:
    """The page of a call of `jaxro heights`."""
    doubts = report.doubts(done)
    verdict = Prose(
        "The readings agree with each other within their errors.", Tone.good
    )
    if doubts:
        verdict = Prose(f"Something is wrong: {doubts[0]}", Tone.bad)
    inside = [*record(report.show_traverses, done)]
    parts = [
        Section("Internal consistency: do the traverses close?", inside),
        Section(
            "Accuracy: heights",
            [
                *pictures.of_surface(done, title),
                *record(report.show_heights, done),
                *record(report.show_shares, done),
            ],
        ),
        Section("How each figure is computed", [Facts(MEANINGS)]),
    ]
    return Page(
        title=f"Heights over the grid of {title}",
        about=f"{report.contents_in_words(done)}; {report.geometry_in_words(done)}",
        verdict=verdict,
        mind=[*doubts[1:], *report.notes(done)],
        sections=[part for part in parts if part.blocks],
        settings=settings,
    )
