"""Pairs of photographs in which a facade repeats itself: is what looks like another
place of it taken for the pose?"""

import numpy as np

from . import scenes
from .common import Size
from .metrics import Metric
from .photos import RIGHT, Program, errors, recommended
from .scenes import Scenes


def counted(pairs: Scenes, program: Program) -> tuple[float, float]:
    """The share of pairs that are claimed and right, and of those claimed and wrong."""
    found = program(pairs)
    fine = pairs.common & (errors(found, pairs) < RIGHT)
    right, wrong = found.claimed & fine, found.claimed & ~fine
    return float(np.mean(right)), float(np.mean(wrong))


def facades(size: Size) -> list[Metric]:
    """By kind the share of pairs that are claimed and wrong, and where there is a
    common view of those that are right."""
    count = 8 if size.robust == 1 else 200
    metrics = []
    for kind in scenes.FACADES:
        right, wrong = counted(scenes.repeated_facades(kind, count), recommended())
        label = f"repeated facades, {kind}"
        told = Metric(f"{label}: claimed and wrong", wrong, "of 1", "lower", 1, 0.005)
        metrics.append(told)
        if kind != "none":
            key = f"{label}: right"
            metrics.append(Metric(key, right, "of 1", "higher", 0.05))
    return metrics


SUITES = {"facades": facades}
