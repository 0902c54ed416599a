"""The six conclusions of Burshtynskaya and Tumskaya (1989), simulated.

One error a pair at each of the sixteen points in turn; two errors of equal size, of
equal and of opposite sign, at every two points of a zone; pairs without an error.
Normal errors of 0.01 mm in all four coordinates. The paper's own pairs had no noise.
"""

from dataclasses import dataclass
from itertools import combinations

import jax
import numpy as np

from ..geometry import mock_pairs
from ..geometry.mock_pairs import noisy, plant
from ..geometry.pairs import Pair

SIGMA = 0.01
"""mm"""
SIZES = (0.10, 0.15, 0.30, 0.50)
"""mm, of single errors."""
SMALL = 0.10
"""mm, of two errors in a zone; the paper's conclusion 3 speaks of this size."""
DRAWS = 30
"""Pairs of every single error and of every two errors."""
CLEAN = 500
"""Pairs without an error."""
ZONES = np.array(mock_pairs.row_layout().zone)
MIDDLE = np.isin(ZONES, (1, 2))
"""The points of zones 1 and 2."""


@dataclass(frozen=True)
class Plan:
    """The planted errors, (pair, point) in mm, and what follows from them."""

    errors: np.ndarray

    @property
    def wrong(self) -> np.ndarray:
        """Which points have an error, (pair, point)."""
        return self.errors != 0

    @property
    def count(self) -> np.ndarray:
        """Number of errors, (pair,)."""
        return np.sum(self.wrong, axis=1)

    @property
    def size(self) -> np.ndarray:
        """Size of the errors (mm), (pair,)."""
        return np.max(np.abs(self.errors), axis=1)


def plan() -> Plan:
    """All pairs: single errors, two errors in a zone, none."""
    points = np.eye(len(ZONES))
    single = [size * point for size in SIZES for point in points]
    every_two = combinations(range(len(ZONES)), 2)
    same_zone = [(i, j) for i, j in every_two if ZONES[i] == ZONES[j]]
    double = [
        SMALL * (points[i] + sign * points[j]) for i, j in same_zone for sign in (1, -1)
    ]
    wrong = np.repeat(single + double, DRAWS, axis=0)
    return Plan(np.concatenate([wrong, np.zeros((CLEAN, len(ZONES)))]))


def measure(exact: Pair, errors, key) -> Pair:
    """The pairs of a plan with noise."""
    one = lambda row, key: plant(noisy(exact, key, SIGMA), y_right=row)
    return jax.vmap(one)(errors, jax.random.split(key, len(errors)))


@dataclass(frozen=True)
class Conclusions:
    """Shares of 1, by the number of the conclusion.

    1 `by_size`: single errors rejected by parallax, by size. 2 `outer`, `middle`:
    single errors of 0.1 mm in zones 3 to 6, and in zones 1 and 2. 3
    `two_in_the_middle`: of two errors of 0.1 mm in zone 1 or 2, whatever their signs;
    beside `middle`. 4 `neighbour`: of pairs with one error, by size, those that lose
    this point and a good point of its zone. 5 `instead_single`, `instead_double`: pairs
    that lose a good point of the zone while an error there stays. 6 `by_parallax`,
    `with_grubbs`: single errors of 0.1 mm rejected by the first and by either stage;
    `clean_parallax`, `clean_grubbs`: pairs without an error that lose a point to the
    first and to the second stage.
    """

    by_size: dict[float, float]
    outer: float
    middle: float
    two_in_the_middle: float
    neighbour: dict[float, float]
    instead_single: float
    instead_double: float
    with_grubbs: float
    by_parallax: float
    clean_parallax: float
    clean_grubbs: float


def conclude(planned: Plan, first: np.ndarray, second: np.ndarray) -> Conclusions:
    """From what each stage rejected, (pair, point)."""
    wrong, single, double = planned.wrong, planned.count == 1, planned.count == 2
    in_middle = np.any(wrong & MIDDLE, axis=1)
    small = single & (planned.size == SMALL)
    of_size = {size: single & (planned.size == size) for size in SIZES}
    share = lambda out, pairs: float(
        np.sum(out[pairs] & wrong[pairs]) / np.sum(wrong[pairs])
    )
    zone_of_error = np.array([np.isin(ZONES, ZONES[row]) for row in wrong])
    good_lost = np.any(first & zone_of_error & ~wrong, axis=1)
    all_found = np.all(first | ~wrong, axis=1)
    part = lambda what, pairs: float(np.mean(what[pairs]))
    clean = planned.count == 0
    return Conclusions(
        by_size={size: share(first, pairs) for size, pairs in of_size.items()},
        outer=share(first, small & ~in_middle),
        middle=share(first, small & in_middle),
        two_in_the_middle=share(first, double & in_middle),
        neighbour={
            size: part(good_lost & all_found, pairs) for size, pairs in of_size.items()
        },
        instead_single=part(good_lost & ~all_found, small),
        instead_double=part(good_lost & ~all_found, double & ~in_middle),
        with_grubbs=share(first | second, small),
        by_parallax=share(first, small),
        clean_parallax=part(np.any(first, axis=1), clean),
        clean_grubbs=part(np.any(second, axis=1), clean),
    )


def describe(c: Conclusions) -> list[tuple[str, str, str]]:
    """(the paper's conclusion, what simulation gives, whether it holds) of the six."""
    percent = lambda value: f"{100 * value:.0f} %"
    sizes = lambda shares: ", ".join(
        f"{size:g} mm {percent(share)}" for size, share in shares.items()
    )
    return [
        (
            "1 errors of .3-.5 mm are found most surely by parallax",
            sizes(c.by_size),
            "true, and weak",
        ),
        (
            "2 points of largest y (zones 3 to 6) are rejected more surely",
            f"0.1 mm: zones 3-6 {percent(c.outer)}, zones 1, 2 {percent(c.middle)}",
            "refuted",
        ),
        (
            "3 errors of .1 mm in zones 1, 2 are not rejected",
            f"one {percent(c.middle)}, two in one zone {percent(c.two_in_the_middle)}",
            "only of two in a zone",
        ),
        (
            "4 a good point of the zone goes with the wrong one",
            sizes(c.neighbour),
            "true",
        ),
        (
            "5 a good point goes and the wrong one of its zone stays",
            f"one error {percent(c.instead_single)}, two in zones 3-6 "
            f"{percent(c.instead_double)}",
            "only of two in a zone",
        ),
        (
            "6 Grubbs' test improves much",
            f"0.1 mm: {percent(c.by_parallax)}, with Grubbs {percent(c.with_grubbs)}; "
            "pairs without an error that "
            f"lose a point: {percent(c.clean_parallax)}, to Grubbs "
            f"{percent(c.clean_grubbs)}",
            "not with noise",
        ),
    ]
