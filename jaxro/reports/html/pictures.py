"""The pictures of a page, as SVG with a caption each."""

from typing import Any

from ... import plots
from .. import block_plots, calibration_plots, pair_plots, plots as survey_plots
from ..block_model import Done as Block
from ..calibration_model import Done as Calibrated
from ..model import One, Results
from ..survey_files import Done as Survey
from ..verdicts import Verdicts
from .page import Figure

CAPTIONS = {
    "residuals": "Corrections of the points on both photos, enlarged by the factor of "
    "the key; crosses are rejected points.",
    "tests": "Tests of the points against their limit.",
    "influence": "How well each point is checked, and what an error does that no test "
    "finds.",
    "model": "Error ellipses of the model points in plan, and standard deviations of "
    "their heights.",
}


def of_residuals(one: One, verdicts: Verdicts | None) -> list[Figure]:
    """Residuals and tests of the points of a pair."""
    return _figures(
        residuals=pair_plots.draw_residuals(one, verdicts),
        tests=pair_plots.draw_tests(one),
    )


def of_accuracy(one: One) -> list[Figure]:
    """What is accurate in the model of a pair, and which points it hangs on."""
    return _figures(
        model=pair_plots.draw_model(one), influence=pair_plots.draw_influence(one)
    )


def of_sigma0(results: Results) -> list[Figure]:
    """The distribution of sigma0 over all pairs."""
    drawn = pair_plots.draw_sigma0(results)
    return [_figure(drawn, "How sigma0 is distributed over the pairs.")]


def of_block(done: Block) -> list[Figure]:
    """The block, and the residuals of its photos."""
    return [_figure(drawn) for drawn in block_plots.figures(done).values()]


def of_calibration(done: Calibrated) -> list[Figure]:
    """Corrections, residuals, differences, models."""
    return [_figure(drawn) for drawn in calibration_plots.figures(done).values()]


def of_surface(done: Survey, title: str) -> list[Figure]:
    """The surface, where the points have places."""
    return [_figure(drawn) for drawn in survey_plots.figures(done, title).values()]


def _figures(**drawn: Any) -> list[Figure]:
    """Those that could be drawn."""
    return [
        _figure(axes, CAPTIONS[name])
        for name, axes in drawn.items()
        if axes is not None
    ]


def _figure(drawn: Any, caption: str = "") -> Figure:
    return Figure(plots.to_svg(drawn), caption)
