"""Pairs whose base is weakly determined or not there at all, with wrong points among
them: is a pair that is called successful right?

Right points of photos that only turn, of a scene far away, or of one plane say little
or nothing of the base. One or two wrong points that are kept with them would say it
exactly, and fit exactly.
"""

import numpy as np
from numpy.typing import NDArray

import jaxro
from jaxro.rejection import OUTCOMES, Recommended, Rejection

from . import scenes
from .common import Size
from .metrics import Metric
from .photos import pair_of
from .scenes import Scenes

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)

POINTS = 50

FAR_ROTATION, FAR_BASE = 2.0, 10.0
"""Degrees from which a pose is grossly wrong."""


def read(rejection: Rejection) -> tuple:
    """Pose, and whether it is called successful."""
    solved = rejection.orientation
    settled = rejection.outcome == OUTCOMES.finished
    named = settled | (rejection.outcome == OUTCOMES.undecided)
    return solved.pose.relative(), named & (solved.result == jaxro.RESULTS.successful)


def gross(
    rotation: NDArray[np.float64], base: NDArray[np.float64], pairs: Scenes
) -> NDArray[np.bool_]:
    """Which poses are grossly wrong: any base is where there is none."""
    turned = np.sum((rotation - pairs.rotation) ** 2, axis=(1, 2)) / 8
    shifted = np.sum((base - pairs.base) ** 2, axis=1) / 4
    angle = lambda square: np.rad2deg(2 * np.arcsin(np.sqrt(np.clip(square, 0, 1))))
    far = (angle(turned) > FAR_ROTATION) | (angle(shifted) > FAR_BASE)
    return far | ~pairs.common


def counted(pairs: Scenes) -> tuple[int, int]:
    """How many pairs are called successful, and how many of these are grossly wrong."""
    found = jaxro.clean_batch(pair_of(pairs), Recommended(), select=read)
    (rotation, base), successful = found
    rotation = np.moveaxis(np.array(rotation), (0, 1), (-2, -1))
    wrong = gross(rotation, np.moveaxis(np.array(base), 0, -1), pairs)
    successful = np.asarray(successful)
    return int(np.sum(successful)), int(np.sum(successful & wrong))


def weak_bases(size: Size) -> list[Metric]:
    """Of each kind the share of pairs that are called successful and are grossly wrong,
    of all pairs, and of planes of those called successful; and how many pairs in space
    are successful."""
    count = 25 * size.robust
    metrics = []
    for kind in (*scenes.WITHOUT_BASE, "space"):
        every = [counted(scenes.weak_bases(kind, count, POINTS, s)) for s in SHARES]
        successful, wrong = np.sum(every, axis=0) / (count * len(SHARES))
        label = f"weak bases, {kind}, {POINTS} points"
        told = Metric(
            f"{label}: successful and gross", wrong, "of 1", "lower", 1, 0.001
        )
        metrics.append(told)
        if kind == "space":
            key = f"{label}: successful"
            metrics.append(Metric(key, successful, "of 1", "higher", 0.01))
    for points in (20, POINTS):
        planes = scenes.weak_bases("plane", 6 * count, points, 0.3)
        successful, wrong = counted(planes)
        key = f"weak bases, plane, {points} points: gross of those successful"
        value = wrong / max(successful, 1)
        metrics.append(Metric(key, value, "of 1", "lower", 1, 0.01))
    return metrics


SUITES = {"weak bases": weak_bases}
