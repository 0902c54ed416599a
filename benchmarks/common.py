"""Sizes of the suites, poses and their comparison, and the metrics that most suites
have."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

import jaxro

from .metrics import Metric
from .peers import Coordinates
from .workload import FOCAL

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
"""R (pairs, 3, 3) and unit base (pairs, 3)"""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    `pairs`: number of pairs by their number of points; slower programs get one of
    `peer_share` pairs. `repeats`: of each measurement of time; `processes`: new
    processes, and `calls` in each. `robust`: multiplies the numbers of pairs with wrong
    points. `trials`: simulated pairs in the comparison of procedures. `rows`: of large
    tables.
    """

    pairs: dict[int, int] = field(
        default_factory=lambda: {16: 131_072, 200: 16_384, 1000: 4_096}
    )
    peer_share: int = 4
    repeats: int = 7
    processes: int = 5
    calls: int = 200
    robust: int = 8
    trials: int = 100_000
    rows: int = 16_000_000


QUICK = Size(
    {16: 8_192, 200: 1_024, 1000: 256},
    peer_share=4,
    repeats=3,
    processes=1,
    calls=20,
    robust=1,
    trials=2_048,
    rows=1_048_576,
)


def share(coordinates: Coordinates, pairs: int) -> Coordinates:
    return tuple(c[:pairs] for c in coordinates)


def pair_of(coordinates: Coordinates) -> jaxro.Pair:
    return jaxro.pair(*coordinates, focal=FOCAL)


def ready(call: Callable, *arguments: Any) -> Any:
    return jax.block_until_ready(call(*arguments))


def poses(pose: jaxro.RelativePose) -> Poses:
    rotation, base = pose.relative()
    return np.moveaxis(np.array(rotation), (0, 1), (-2, -1)), np.moveaxis(
        np.array(base), 0, -1
    )


def difference(one: Poses, other: Poses) -> float:
    """The largest difference of any entry of R or of the unit base: radians, for small
    ones."""
    count = min(len(one[0]), len(other[0]))
    return max(
        float(np.max(np.abs(a[:count] - b[:count])))
        for a, b in zip(one, other, strict=True)
    )


def agreement(key: str, ours: Poses, theirs: Poses, bound: float) -> Metric:
    """The metric of an accuracy comparison. Raises ArithmeticError beyond `bound`:
    nothing is timed then."""
    found = difference(ours, theirs)
    if not found <= bound:
        raise ArithmeticError(
            f"{key}: the answers differ by {found:.1e}, more than {bound:.0e}; nothing "
            "timed"
        )
    return Metric(key, found, "rad", "lower", tolerance=np.inf, goal=bound)


def rate(key: str, seconds: float) -> Metric:
    return Metric(key, seconds * 1e6, "µs a pair", "lower", tolerance=0.5)


def ratio(key: str, peer: float, ours: float, goal: float | None) -> Metric:
    return Metric(key, peer / ours, "times", "higher", goal=goal)


def pose(orientation: jaxro.Orientation) -> jaxro.RelativePose:
    """The pose alone, as other programs compute it. The compiler leaves out the
    rest."""
    return orientation.pose


def listed(orientation: jaxro.Orientation) -> tuple:
    """The pose, covariance, residuals, redundancy numbers and model points: the results
    that the goal of the whole orientation names."""
    o = orientation
    return o.pose, o.covariance, o.residuals, o.redundancy, o.model
