"""The algorithm proposed in 1971, and the count of its iterations.

The paper asks for two iterations before a point is judged, and says that "the first
iteration is the one in which the elements are zero". Its table 2 prints under iteration
2 the parallaxes after one correction of the elements, and the paper concludes from this
table that points are to be rejected after the second iteration. There a wrong point has
the largest parallax (59 hundredths of mm at point 8, 58 at the good point 4); after two
corrections the good point has it. So two iterations are one correction from zero
elements: `Dorozhinsky()`. `Dorozhinsky(corrections=2)` is the other reading, which
rejects good points in place of wrong ones in table 1 of the paper.
"""

import jax.numpy as jnp

from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import while_loop
from ..xla.passes import count
from .base import (
    OUTCOMES,
    AbstractProcedure,
    History,
    Rejection,
    Round,
    at_most,
    began,
    by_parallax,
    ended,
    finished,
    iterated,
    largest,
    mean_of,
    parallaxes,
    recorded,
    values,
    zero_elements,
)

CONVERGENCE = 10
"""Corrections allowed after the last rejection by the mean; three are usual."""


class Dorozhinsky(AbstractProcedure):
    """Five steps (Dorozhinsky 1971, eqs 11 to 13), from zero elements:

    1. points with |q| > eps1 go, once;
    2. `corrections` corrections of the elements;
    3. while mean |q| > eps3 the point with the largest |q| goes, and 2 is repeated from
       zero; with `least` points left the outcome is `operator_needed`;
    4. corrections until no element changes by eps2;
    5. points with |q| - mean |q| >= eps4 go, once, at least `least` stay; new solution.

    The log has a round per correction: parallaxes before it, elements after it, as in
    table 2; and one per decision.

    One correction leaves the terms of second order of the elements in the parallaxes.
    Where these exceed eps3, the procedure rejects good points or calls the operator: it
    needs photos that are nearly parallel, or coordinates that were turned by
    approximate elements.
    """

    eps1: float = 7.0
    eps2: float = 1e-4
    eps3: float = 0.1
    eps4: float = 0.01
    corrections: int = 1
    least: int = 6

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        zero = zero_elements(pair)
        cycles = max(pair.x_left.shape[0] - self.least, 0) + 1
        history = began(pair, 1 + cycles * (self.corrections + 1) + CONVERGENCE + 1)
        first = jnp.abs(parallaxes(pair, pair.mask, zero))
        gross = pair.mask & (first > self.eps1)
        history = recorded(
            history, Round(first, jnp.asarray(self.eps1), gross, first, values(zero))
        )

        def cycle(state):
            history, *_ = state
            elements = zero
            for _ in range(self.corrections):
                history, elements = self._correction(pair, history, elements)
            q = parallaxes(pair, history.mask, elements)
            mean = mean_of(jnp.abs(q), history.mask)
            wrong, few = mean > self.eps3, count(history.mask) <= self.least
            out = largest(jnp.abs(q), history.mask) & wrong & ~few
            # the mean decides whether, the size which: a point's statistic is its size,
            # or zero while the mean is good
            statistic = jnp.where(wrong, jnp.abs(q), 0.0)
            new = Round(statistic, jnp.asarray(self.eps3), out, q, values(elements))
            # what no elements can be determined from is no case for the operator
            solvable = count(history.mask) >= 5
            return (
                recorded(history, new),
                elements,
                wrong & few & solvable,
                ~wrong | few,
            )

        no = jnp.zeros_like(pair.focal_left, bool)
        state = while_loop(
            lambda state: ~state[3], cycle, (history, zero, no, no), pair.focal_left
        )
        history, elements, stuck, _ = state

        def converge(state):
            history, elements, _, taken = state
            history, new = self._correction(pair, history, elements)
            change = jnp.max(jnp.abs(values(new) - values(elements)))
            return history, new, change >= self.eps2, taken + 1

        go = ~stuck
        state = (history, elements, go, history.rounds * 0)
        history, elements, _, _ = while_loop(
            lambda s: s[2] & (s[3] < CONVERGENCE), converge, state, pair.focal_left
        )
        q = parallaxes(pair, history.mask, elements)
        excess = jnp.abs(q) - mean_of(jnp.abs(q), history.mask)
        bad = history.mask & (excess >= self.eps4)
        bad = at_most(bad, jnp.abs(q), history.mask, self.least)
        history = recorded(
            history, Round(excess, jnp.asarray(self.eps4), bad, q, values(elements)), go
        )
        outcome = OUTCOMES.where(stuck, OUTCOMES.operator_needed, finished(pair))
        return ended(history, by_parallax(pair, history.mask, elements), outcome)

    def _correction(
        self, pair: Pair, history: History, elements: AbstractElements
    ) -> tuple[History, AbstractElements]:
        new = iterated(pair, history.mask, elements)
        q = parallaxes(pair, history.mask, elements)
        none = jnp.zeros_like(history.mask)
        return recorded(
            history, Round(jnp.abs(q), jnp.asarray(jnp.inf), none, q, values(new))
        ), new
