"""The figure of a survey of heights."""

from typing import Any

import numpy as np

from .. import plots
from .survey_files import Done


def figures(done: Done, title: str) -> dict[str, Any]:
    """The figure by name; none where the points have no places."""
    if done.named.places is None:
        return {}
    return {"surface": plots.figure_of(draw(done, title))}


def draw(done: Done, title: str) -> Any:
    """The surface through the points, and the standard deviations of their heights."""
    assert done.named.places is not None
    n = done.named.points
    value, deviation = (
        np.asarray(a.value[:n]) for a in (done.found.heights, done.found.deviations)
    )
    axes = plots.draw_heights(
        *done.named.places,
        value,
        deviation,
        legs=_legs(done),
        names=done.named.names[:n],
    )
    figure = plots.figure_of(axes)
    figure.suptitle(plots.plain(f"Heights of {title}"), fontsize=plots.TITLE)
    return axes


def _legs(done: Done) -> np.ndarray:
    """The first and the last point of every leg between points that have a place."""
    survey = done.named.survey
    both = np.stack([np.asarray(survey.start), np.asarray(survey.end)])
    return both[:, np.all(both < done.named.points, axis=0)]
