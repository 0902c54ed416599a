"""Scale bars: known distances between points of a block.

    |X_one - E| - length = 0,    X_other - E = 0 (next to exactly)

A condition touches one eliminated point at most. So the other end E of each bar is an
unknown of its own, a common one, and the point there is tied to it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..adjustment import Term
from ..adjustment.guarded import root
from .measured_block import MeasuredBlock

TIED = 1e-4
"""Standard deviation of the tie, as a part of that of a point: the square of it is lost
of the accuracy of the solution, 1e-8."""

LEAST = 1e-30
"""What stands for a length of zero where it divides."""


HALF = 1e-9
"""Part of the half of all weight within which it is just half."""


class NoBar(ValueError):
    """No bar has both of its points in a block."""


class Bars(NamedTuple):
    """Known distances between two points each, with standard deviations. A length that
    is NaN takes no part in an adjustment."""

    one: tuple[str, ...]
    other: tuple[str, ...]
    length: Float[np.ndarray, " bar"]
    sigma: Float[np.ndarray, " bar"]

    def without(self, rows: Bool[np.ndarray, " bar"]) -> "Bars":
        """The same without the lengths of some bars, which keep their numbers."""
        return self._replace(length=np.where(rows, np.nan, self.length))

    def are_in(self, block: MeasuredBlock) -> Bool[np.ndarray, " bar"]:
        """Whether a block has both points of each bar."""
        return np.all(np.stack(self.numbers_in(block)) >= 0, axis=0)

    def numbers_in(self, block: MeasuredBlock) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of both points in a block, -1 where it has not got them."""
        number = {name: k for k, name in enumerate(block.points)}
        of = lambda names: np.array([number.get(name, -1) for name in names], int)
        return of(self.one), of(self.other)


def differences(
    given: Bars,
    block: MeasuredBlock,
    coordinates: Float[np.ndarray, "point 3"],
    covariances: Float[np.ndarray, "point 3 3"],
) -> tuple[Float[np.ndarray, " bar"], Float[np.ndarray, " bar"]]:
    """Lengths between adjusted points minus given ones, whether they took part or not,
    and the standard deviations of the former, both ends as if they were independent; NaN
    where an end has no coordinates."""
    one, other = given.numbers_in(block)
    there = (one >= 0) & (other >= 0)
    apart = coordinates[one] - coordinates[other]
    length = np.linalg.norm(apart, axis=1)
    along = apart / np.maximum(length, LEAST)[:, None]
    both = covariances[one] + covariances[other]
    variance = np.einsum("bi,bij,bj->b", along, both, along)
    spread = np.sqrt(np.maximum(variance, 0.0))
    masked = lambda values: np.where(there, values, np.nan)
    return masked(length - given.length), masked(spread)


def scale_of(
    given: Bars, block: MeasuredBlock, coordinates: Float[np.ndarray, "point 3"]
) -> float:
    """What a network is to be multiplied by to have the lengths of its bars: the median
    of their ratios, each with the weight of its precision; 1 where no bar has both
    ends."""
    one, other = given.numbers_in(block)
    apart = np.linalg.norm(coordinates[one] - coordinates[other], axis=1)
    ratios = given.length / np.maximum(apart, LEAST)
    there = (one >= 0) & (other >= 0) & np.isfinite(ratios)
    if not np.any(there):
        return 1.0
    order = np.argsort(ratios[there])
    below = np.cumsum((apart / given.sigma)[there][order])
    half = below[-1] / 2
    # where just half of the weight lies below, the median is between two ratios
    middle = np.searchsorted(below, [half * (1 - HALF), half * (1 + HALF)])
    return float(np.mean(ratios[there][order][middle]))


def no_bars() -> Bars:
    """The bars of a block that has none."""
    return bars((), (), np.zeros(0), 1.0)


def bars(
    one: Sequence[str],
    other: Sequence[str],
    length: Float[ArrayLike, " bar"],
    sigma: Float[ArrayLike, "..."],
) -> Bars:
    """Scale bars. Raises ValueError for a bar between a point and itself, and for
    lengths and standard deviations that are not positive."""
    lengths = np.asarray(length, float)
    deviations = np.broadcast_to(np.asarray(sigma, float), lengths.shape)
    for a, b, *numbers in zip(one, other, lengths, deviations, strict=True):
        if a == b:
            raise ValueError(f"bars: a bar from point {a!r} to itself")
        if not all(value > 0 for value in numbers):
            raise ValueError(
                f"bars: the bar from {a!r} to {b!r} has a length or a standard deviation "
                "that is not positive"
            )
    return Bars(tuple(one), tuple(other), lengths, deviations)


def of_length(point: Float[Array, "3"], end: Float[Array, "3"], length: Array):
    """The misfit of one known distance."""
    return root(jnp.sum((point - end) ** 2)) - length


def of_tie(point: Float[Array, "3"], end: Float[Array, "3"], apart: Array):
    """The misfit of a point that is tied to the end of a bar."""
    return point - end - apart


def bar_terms(
    between: tuple[np.ndarray, np.ndarray],
    length: Float[np.ndarray, " bar"],
    sigma: Float[np.ndarray, " bar"],
    deviation: float,
) -> tuple[Term, Term]:
    """The conditions of bars between points of the adjustment, by their numbers there,
    in its units; `deviation`: of a point, about."""
    one, other = between
    end = np.arange(len(one))
    tie = np.full((len(one), 3), (TIED * deviation) ** 2)
    return (
        Term(
            of_tie,
            np.zeros((len(one), 3)),
            tie,
            touches=[("point", other), ("end", end)],
        ),
        Term(of_length, length, sigma**2, touches=[("point", one), ("end", end)]),
    )
