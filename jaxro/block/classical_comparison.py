"""What the classical adjustment of independent models loses against the rigorous one,
and how far its standard deviations are from the truth: a table, one estimator a row.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .adjust import adjust_block
from .classical import adjust_models, deviations_of
from .classical_models import measure_models
from .measured_block import Ground, MeasuredBlock
from .mock_block import Flight
from .network import Start


class Compared(NamedTuple):
    """An estimator: root mean squares of the true standard deviations of all points
    that are not known, in plan and in height; and the quotients of claimed and true
    ones: the least, the median and the largest with its own sigma0, and the median with
    sigma0 = 1, where its weights are taken at their word."""

    estimator: str
    plan: float
    height: float
    claimed: tuple[float, float, float]
    prior: float


def compare_estimators(
    block: MeasuredBlock,
    start: Start,
    ground: Ground,
    left: Sequence[str],
    right: Sequence[str],
) -> list[Compared]:
    """The rigorous adjustment of a block, and the classical one of the models of some
    pairs, with several weights. The standard deviations of places on photos and of
    known points are taken as true."""
    models = measure_models(block, left, right)
    points = models.without_centres()
    others = np.zeros(len(block.points), bool)
    others[points.point] = True
    others &= ~np.isin(block.points, ground.points)

    rigorous = adjust_block(block, start, ground).check()
    claimed = rigorous.deviations[others]
    true = claimed / rigorous.sigma0
    found = [_compare("rigorous", true, claimed, rigorous.sigma0)]
    own = deviations_of(points, start)
    plan, height = np.sqrt(np.mean(own[:, :2] ** 2)), np.sqrt(np.mean(own[:, 2] ** 2))
    of_axes = np.array([plan, plan, height])
    equal = _on_ground(block, start)
    for name, measured, deviations in (
        ("equal weights, centres tied", models, equal),
        ("plan and height, centres tied", models, of_axes),
        ("equal weights, points only", points, equal),
        ("plan and height, points only", points, of_axes),
        ("variances of the models, points only", points, own),
    ):
        adjusted = adjust_models(measured, start, ground, deviations).check()
        true, claimed = (
            a[: len(others)][others] for a in (adjusted.true, adjusted.claimed)
        )
        found.append(_compare(name, true, claimed, adjusted.sigma0))
    return found


def as_text(compared: Sequence[Compared]) -> str:
    """The table: deviations in the unit of the ground, over those of the first row, and
    claimed over true ones."""
    width = max(len(row.estimator) for row in compared)
    head = (
        f"{'':{width}}   plan  height    over rigorous   claimed over true (range)  "
        "sigma0 = 1"
    )
    first, lines = compared[0], [head]
    for row in compared:
        least, median, most = row.claimed
        over = row.plan / first.plan, row.height / first.height
        lines.append(
            f"{row.estimator:{width}} {row.plan:6.3f} {row.height:7.3f} "
            f"{over[0]:9.2f} {over[1]:6.2f} {median:11.2f} ({least:.2f} - {most:.2f}) "
            f"{row.prior:11.2f}"
        )
    return "\n".join(lines)


def along_strips(flight: Flight) -> tuple[list[str], list[str]]:
    """The neighbouring photos of each strip of a simulated block."""
    strips, models = range(1, flight.strips + 1), range(1, flight.models + 1)
    left = [f"{strip}-{k}" for strip in strips for k in models]
    right = [f"{strip}-{k + 1}" for strip in strips for k in models]
    return left, right


def _compare(
    name: str,
    true: Float[np.ndarray, "point 3"],
    claimed: Float[np.ndarray, "point 3"],
    sigma0: float,
) -> Compared:
    quotients = claimed / true
    least, median, most = np.quantile(quotients, [0.0, 0.5, 1.0])
    return Compared(
        estimator=name,
        plan=float(np.sqrt(np.mean(true[:, :2] ** 2))),
        height=float(np.sqrt(np.mean(true[:, 2] ** 2))),
        claimed=(float(least), float(median), float(most)),
        prior=float(median / sigma0),
    )


def _on_ground(block: MeasuredBlock, start: Start) -> float:
    """The standard deviation of a place on a photo, on the ground."""
    away = start.points[block.point] - start.centres[block.photo]
    distance = np.linalg.norm(away, axis=1)
    return float(np.nanmedian(distance * block.sigma / block.focal[block.photo]))
