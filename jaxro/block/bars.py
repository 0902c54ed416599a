"""Scale bars: known distances between points of a block.

    |X_one - E| - length = 0,    X_other - E = 0 (next to exactly)

A condition touches one eliminated point at most. So the other end E of each bar is an
unknown of its own, a common one, and the point there is tied to it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..adjustment import Term
from ..adjustment.guarded import root
from .measured_block import MeasuredBlock

TIED = 1e-4
"""Standard deviation of the tie, as a part of that of a point: the square of it is lost
of the accuracy of the solution, 1e-8."""


class NoBar(ValueError):
    """No bar has both of its points in a block."""


class Bars(NamedTuple):
    """Known distances between two points each, with standard deviations."""

    one: tuple[str, ...]
    other: tuple[str, ...]
    length: Float[np.ndarray, " bar"]
    sigma: Float[np.ndarray, " bar"]

    def take(self, some: np.ndarray) -> "Bars":
        """Some of them."""
        numbers = np.arange(len(self.one))[some]
        names = lambda column: tuple(column[k] for k in numbers)
        return Bars(
            names(self.one), names(self.other), self.length[some], self.sigma[some]
        )

    def numbers_in(self, block: MeasuredBlock) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of both points in a block, -1 where it has not got them."""
        number = {name: k for k, name in enumerate(block.points)}
        of = lambda names: np.array([number.get(name, -1) for name in names], int)
        return of(self.one), of(self.other)


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
