"""The suite of reading an adjustment: what reliability costs beside the orientation it
is read from."""

from collections.abc import Callable
from functools import partial

import numpy as np

import jaxro

from .common import Size, pair_of, rate, ready
from .metrics import Metric, median_seconds
from .workload import aerial


def _read(
    pair: jaxro.Pair, orientation: jaxro.Orientation
) -> tuple[jaxro.Orientation, jaxro.Reliability]:
    return orientation, jaxro.assess(pair, orientation, sigma0=0.01)


def reading(size: Size) -> list[Metric]:
    """Orientation alone, and with everything `assess` tells, of 10,000 pairs of 16
    points on the whole machine."""
    pairs = pair_of(aerial(10_000, 16))
    calls = {
        "orientation": partial(ready, jaxro.orient_batch, pairs),
        "both": partial(ready, partial(jaxro.orient_batch, read=_read), pairs),
    }
    calls["orientation"]()
    _, found = calls["both"]()
    worst = float(np.max(np.abs(np.sum(np.asarray(found.redundancy), axis=1) - 11)))
    if not worst <= 1e-9:
        raise ArithmeticError(
            f"reading: the redundancy numbers of a pair add up to {worst:.1e} beside 11"
        )
    seconds = median_seconds(
        calls, 5 * size.repeats
    )  # a tenth of a second each, of which page faults are a part
    return [
        rate("reading, 16 points: orientation", seconds["orientation"] / 10_000),
        rate(
            "reading, 16 points: orientation and reliability", seconds["both"] / 10_000
        ),
        Metric(
            "reading, 16 points: reliability against the orientation",
            seconds["both"] / seconds["orientation"] - 1,
            "times",
            "lower",
            goal=1,
        ),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {"reading": reading}
