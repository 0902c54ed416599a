"""The pictures of a call as files by name; they need matplotlib (pip install
'jaxro[plots]')."""

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from .. import plots
from ..experiments.compare import Comparison, Score
from ..reports import block_plots, calibration_plots, pair_plots, plots as survey_plots
from ..reports.block_model import Done as Block
from ..reports.calibration_model import Done as Calibrated
from ..reports.model import One, Results
from ..reports.survey_files import Done as Survey
from ..reports.verdicts import Verdicts
from ..tables.fields import TableError

Files = dict[str, bytes]

MISSING = "it needs matplotlib: pip install 'jaxro[plots]'"
"""Why there is no picture where matplotlib is not installed."""


def pictures_of_pairs(results: Results, verdicts: Verdicts | None = None) -> Files:
    """The pictures of one pair; of many the distribution of sigma0, and those of the
    `pair_plots.WORST` worst pairs, whose names are in those of the files."""
    if len(results) == 1:
        return to_files(pair_plots.figures_of_pair(One(results, 0), verdicts))
    found = {"sigma0": plots.figure_of(pair_plots.draw_sigma0(results))}
    for rank, number in enumerate(pair_plots.worst(results), 1):
        one = One(results, number)
        start = f"worst_{rank}_{file_name(one.name)}_"
        drawn = pair_plots.figures_of_pair(one, verdicts)
        found |= {start + name: figure for name, figure in drawn.items()}
    return to_files(found)


def pictures_of_calibration(done: Calibrated) -> Files:
    """Differences, corrections, residuals, models."""
    return to_files(calibration_plots.figures(done))


def pictures_of_block(done: Block) -> Files:
    """The block, and the residuals of its photos."""
    return to_files(block_plots.figures(done))


def pictures_of_heights(done: Survey, title: str) -> Files:
    """The surface, where the points have places."""
    return to_files(survey_plots.figures(done, title))


def to_files(figures: dict[str, Any]) -> Files:
    """Figures as PNG."""
    return {f"{name}.png": plots.to_png(figure) for name, figure in figures.items()}


def file_name(name: str) -> str:
    """A name of a pair as a part of the name of a file."""
    return re.sub(r"[^\w-]+", "_", name)[:60]


# -------------------------------------------------------------------------------------
# comparisons of procedures


def check_picture(file: Path | None) -> None:
    """Raises TableError where no picture can be written to such a file."""
    if file is not None and file.suffix.lower() not in plots.WRITERS:
        raise TableError(
            "--plot",
            found=f"the name {file.name!r}",
            expected=f"a name that ends in {', '.join(plots.WRITERS)}",
        )


def picture_of_comparison(found: Comparison, file: Path) -> bytes:
    """The power of the procedures in the format of the file: a picture for each layout
    and number of wrong points, as they are and, beside it, at equal false alarms.
    Raises TableError where nothing was wrong in any trial."""
    settings = [
        (layout, number, list(scores))
        for (layout, number), scores in groupby(
            (s for s in found.scores if s.setting.errors),
            key=lambda s: (s.setting.layout, s.setting.errors),
        )
    ]
    if not settings:
        raise TableError(
            "--plot",
            found="no setting with wrong points",
            expected="--errors 1 or more",
        )
    both = (False, True) if any(s.calibrated for s in found.scores) else (False,)
    figure = plots.new_figure(4.3 * len(settings), 4.8 * len(both))
    rows = figure.subplots(len(settings), len(both), squeeze=False)
    for row, (layout, number, scores) in zip(rows, settings, strict=True):
        alarms = [
            s
            for s in found.scores
            if s.setting.layout == layout and not s.setting.errors
        ]
        for axes, calibrated in zip(row, both, strict=True):
            how = "equal false alarms" if calibrated else "as they are"
            plural = "s" * (number != 1)
            plots.draw_power(
                curves(scores, alarms, calibrated=calibrated),
                title=f"{number} wrong point{plural}, {how}\n{layout}",
                axes=axes,
            )
    return plots.WRITERS[file.suffix.lower()](figure)


def curves(
    scores: Sequence[Score], alarms: Sequence[Score], *, calibrated: bool
) -> list[plots.Curve]:
    """A curve for each procedure, as it is or calibrated; `alarms`: the scores of the
    same layout without errors."""
    of = [s for s in scores if s.calibrated == calibrated]
    by_name = {
        s.procedure: s.alarms.value for s in alarms if s.calibrated == calibrated
    }
    return [
        plots.Curve(
            procedure=name,
            sizes=[s.setting.size for s in of if s.procedure == name],
            found=[s.found.value for s in of if s.procedure == name],
            errors=[s.found.error for s in of if s.procedure == name],
            false_alarms=by_name.get(name),
        )
        for name in dict.fromkeys(s.procedure for s in of)
    ]
