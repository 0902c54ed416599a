"""The page of a calibration: what the images need, how accurate it is, and the models
that were compared."""

from collections.abc import Sequence

from rich.console import Console

from .. import calibration as report
from ..calibration_model import Done
from ..calibration_words import has_doubtful_fit, sentences
from . import pictures
from .page import Block, Facts, Page, Prose, Section, Tone
from .recorded import record

MEANINGS = (
    ("sigma0", "Root of the sum of squares of all residuals over their standard "
     "deviations, by the degrees of freedom; in the unit of the image where no standard "
     "deviation was given."),
    ("± sd", "From the covariance of the adjustment, times sigma0²; the object points "
     "take part with their own standard deviations."),
    ("left out", "The error of coordinates that a model has not seen: each one in turn is "
     "predicted by the adjustment of all others (closed form)."),
    ("behind", "-2 log evidence of a model, behind that of the best: how much less "
     "probable the model is in the light of the measurements. Models within a few units "
     "are equally good."),
    ("|w|, tau", "The residual over its standard deviation; tau where sigma is estimated "
     "from the same residuals."),
    ("effective parameters", "How many parameters a displacement field really uses; its "
     "smoothness is chosen by the evidence."),
)  # fmt: skip
"""How each figure of the page is computed."""


def page_of_calibration(done: Done, settings: Sequence[tuple[str, str]]) -> Page:
    """The page of a call of `jaxro calibrate`."""
    verdict, *others = record(report.show_verdict, done)
    assert isinstance(verdict, Prose)
    inside: list[Block] = [*others, *record(report.show_tests, done)]
    inside += record(report.show_residuals, done)
    outside = record(_accuracy, done) if done.cameras else []
    outside += record(report.show_distances, done)
    compared = record(report.show_variants, done)
    parts = [
        Section("Internal consistency: does the model fit the image?", inside),
        Section("Accuracy: station, camera, corrections", outside),
        Section("Models compared", compared),
        Section("Pictures", pictures.of_calibration(done) if done.cameras else []),
        Section("How each figure is computed", [Facts(MEANINGS)]),
    ]
    failed = [one for one in done.photos if not one.usable]
    tone = Tone.good if not failed else Tone.bad if not done.cameras else Tone.mind
    if tone is Tone.good and has_doubtful_fit(done):
        tone = Tone.mind
    return Page(
        title=f"Calibration of {done.title}",
        about=report.contents_in_words(done),
        verdict=Prose(verdict.text, tone),
        mind=sentences(done) if done.cameras else [],
        sections=[part for part in parts if part.blocks],
        settings=settings,
    )


def _accuracy(console: Console, done: Done) -> None:
    report.show_stations(console, done)
    report.show_cameras(console, done)
    report.show_points(console, done)
