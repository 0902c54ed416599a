"""The few sizes that pairs of every length are padded to, and how many pairs go through
a program together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

SIZES = 8
"""Sizes to which pairs are padded at most: each is another program to compile."""

FEWER = 3
"""The same where a program takes longer to compile: general starts, searches for wrong
points."""

CHEAP = 250_000
"""Padded points that take less time to calculate than it takes to load another
program."""

SHORTEST = 8
"""The smallest size."""


def steps(longest: int) -> Int[np.ndarray, " some"]:
    """The sizes there are to choose from, 8, 10, 12, 14, 16, 20, ...: the same for
    every table, so that programs that were compiled for one serve others."""
    return np.array(
        [
            (4 + quarter) << k
            for k in range(1, max(longest, SHORTEST).bit_length())
            for quarter in range(4)
        ]
    )


def sizes(lengths: Int[np.ndarray, " pair"], most: int = SIZES) -> tuple[int, ...]:
    """The at most `most` of all `steps` with the least padding, found by dynamic
    programming; a size more only where it saves more than it costs."""
    if not len(lengths):
        return (SHORTEST,)
    known = steps(int(np.max(lengths)))
    counts = np.bincount(np.searchsorted(known, lengths), minlength=len(known))
    known, counts = (
        known[: np.flatnonzero(counts)[-1] + 1],
        counts[: np.flatnonzero(counts)[-1] + 1],
    )
    below = np.concatenate([[0], np.cumsum(counts)])  # pairs up to each step
    # of all pairs up to a step, with the sizes so far
    cost = np.where(np.arange(len(below)) == 0, 0.0, np.inf)
    choices, best = [], (np.inf, 0)
    for k in range(most):
        whole = cost[None, :] + known[:, None] * (below[1:, None] - below[None, :])
        whole[np.arange(len(below))[None, :] > np.arange(len(known))[:, None]] = np.inf
        choices.append(np.argmin(whole, axis=1))
        cost = np.concatenate([[np.inf], np.min(whole, axis=1)])
        best = min(best, (cost[-1] + CHEAP * k, k))
    end, out = len(known), []
    for choice in reversed(choices[: best[1] + 1]):
        out.append(int(known[end - 1]))
        end = int(choice[end - 1])
    return tuple(reversed(out))


class Plan(NamedTuple):
    """Sizes to pad to, ascending, and the pairs of a call of each program; one plan for
    many parts of one table, so that no part compiles anything."""

    sizes: tuple[int, ...]
    slabs: tuple[int, ...]
    fewer: tuple[int, ...]


CALL_POINTS = tuple(1 << bits for bits in (17, 15, 13))
"""Points per call of a program: few choices, so that programs that were compiled for
one table serve others."""


def plan_for(lengths: Int[np.ndarray, " pair"], parts: int = 1) -> Plan:
    """A plan for pairs of these lengths that come in so many parts of about the same
    kind."""
    chosen = sizes(lengths)
    members = (
        np.bincount(np.searchsorted(chosen, lengths), minlength=len(chosen)) / parts
    )
    # a call holds a third of the pairs of a part at most: what the last one is filled
    # up with is not much
    fits = lambda size, own: next(
        (c for c in CALL_POINTS if c * 3 <= own * size), CALL_POINTS[-1]
    )
    slabs = tuple(
        max(1, fits(size, own) // size)
        for size, own in zip(chosen, members, strict=True)
    )
    return Plan(chosen, slabs, sizes(lengths, FEWER))
