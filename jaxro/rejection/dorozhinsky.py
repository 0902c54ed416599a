"""The algorithm proposed in 1971, and how its iterations are counted.

The paper asks for two iterations before a point is judged, and says that "the first
iteration is the one in which the elements are zero". Its table 2 prints under iteration
2 the parallaxes after one correction of the elements, and the paper concludes from this
table that points are to be rejected after the second iteration. There a wrong point has
the largest parallax (59 hundredths of mm at point 8, 58 at the good point 4); after two
corrections the good point has it. So two iterations are one correction from zero
elements: `Dorozhinsky()`. `Dorozhinsky(corrections=2)` is the other reading, which
rejects good points in place of wrong ones in table 1 of the paper.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, ScalarLike

from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import while_loop
from ..xla.passes import count
from .base import OUTCOMES, AbstractProcedure, Rejection
from .masked import mean_of
from .parallaxes import adjust_parallaxes, iterate_once, parallaxes, zero_elements
from .rounds import (
    History,
    Round,
    add_round,
    conclude,
    element_values,
    empty_history,
    finished_outcome,
    keep_at_least,
    largest,
)

CONVERGENCE = 10
"""Corrections allowed after the last rejection by the mean; three are usual."""


class State(NamedTuple):
    """Between two steps: what was decided so far, the elements, whether an operator is
    needed, and whether the current step goes on."""

    history: History
    elements: AbstractElements
    stuck: Bool[Array, ""]
    going: Bool[Array, ""]


class Dorozhinsky(AbstractProcedure):
    """The proposed algorithm (Dorozhinsky 1971, eqs 11 to 13), from zero elements:

    1. points with |q| > eps1 go, once;
    2. `corrections` corrections of the elements;
    3. while mean |q| > eps3 the point with the largest |q| goes, and step 2 begins
       again from zero; with `least` points left the outcome is `operator_needed`;
    4. corrections until no element changes by eps2;
    5. points with |q| - mean |q| >= eps4 go, once; at least `least` stay; then the
       points kept are solved again.

    The log has a round for each correction, with the parallaxes before it and the
    elements after it, as in table 2, and a round for each decision.

    One correction leaves the terms of second order of the elements in the parallaxes.
    If these exceed eps3, the procedure rejects good points or calls the operator: it
    needs photos that are nearly parallel, or coordinates that were turned by
    approximate elements.
    """

    eps1: ScalarLike = 7.0
    eps2: ScalarLike = 1e-4
    eps3: ScalarLike = 0.1
    eps4: ScalarLike = 0.01
    corrections: int = 1
    least: int = 6

    def clean(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        history = self._reject_gross(pair)
        state = self._reject_by_mean(pair, history)
        stuck = state.stuck
        history, elements = self._converge(pair, state)
        history = self._reject_small(pair, history, elements, ~stuck)
        final = adjust_parallaxes(pair, history.mask, elements)
        outcome = OUTCOMES.where(
            stuck, OUTCOMES.operator_needed, finished_outcome(pair)
        )
        return conclude(history, final, outcome)

    def _reject_gross(self, pair: Pair) -> History:
        """Step 1, with room in the log for all steps."""
        cycles = max(pair.x_left.shape[0] - self.least, 0) + 1
        rounds = 1 + cycles * (self.corrections + 1) + CONVERGENCE + 1
        zero = zero_elements(pair)
        q = parallaxes(pair, pair.mask, zero)
        size = jnp.abs(q)
        gross = Round(
            statistic=size,
            limit=jnp.asarray(self.eps1),
            rejected=pair.mask & (size > self.eps1),
            parallax=size,
            elements=element_values(zero),
        )
        return add_round(empty_history(pair, rounds), gross)

    def _reject_by_mean(self, pair: Pair, history: History) -> State:
        """Steps 2 and 3: the elements after the last corrections, and whether an
        operator is needed."""
        zero = zero_elements(pair)

        def cycle(state: State) -> State:
            history, elements = state.history, zero
            for _ in range(self.corrections):
                history, elements = self._correct(pair, history, elements)
            mask = history.mask
            q = parallaxes(pair, mask, elements)
            size = jnp.abs(q)
            wrong = mean_of(size, mask) > self.eps3
            few = count(mask) <= self.least
            # the mean decides whether a point goes, the size which: the statistic of a
            # point is its size, or zero while the mean is good
            decision = Round(
                statistic=jnp.where(wrong, size, 0.0),
                limit=jnp.asarray(self.eps3),
                rejected=largest(size, mask) & wrong & ~few,
                parallax=q,
                elements=element_values(elements),
            )
            # too few points for any elements are no case for the operator
            solvable = count(mask) >= 5
            return State(
                history=add_round(history, decision),
                elements=elements,
                stuck=wrong & few & solvable,
                going=wrong & ~few,
            )

        no = jnp.zeros_like(pair.focal_left, bool)
        start = State(history=history, elements=zero, stuck=no, going=~no)
        return while_loop(lambda state: state.going, cycle, start, pair.focal_left)

    def _converge(self, pair: Pair, state: State) -> tuple[History, AbstractElements]:
        """Step 4; nothing happens where an operator is needed."""

        def more(loop: tuple[State, Int[Array, ""]]) -> Bool[Array, ""]:
            state, taken = loop
            return state.going & (taken < CONVERGENCE)

        def body(loop: tuple[State, Int[Array, ""]]) -> tuple[State, Int[Array, ""]]:
            state, taken = loop
            history, new = self._correct(pair, state.history, state.elements)
            moved = element_values(new) - element_values(state.elements)
            going = jnp.max(jnp.abs(moved)) >= self.eps2
            state = State(history=history, elements=new, stuck=state.stuck, going=going)
            return state, taken + 1

        start = state._replace(going=~state.stuck), state.history.rounds * 0
        state, _ = while_loop(more, body, start, pair.focal_left)
        return state.history, state.elements

    def _reject_small(
        self,
        pair: Pair,
        history: History,
        elements: AbstractElements,
        active: Bool[Array, ""],
    ) -> History:
        """The rejection of step 5."""
        q = parallaxes(pair, history.mask, elements)
        size = jnp.abs(q)
        excess = size - mean_of(size, history.mask)
        wrong = history.mask & (excess >= self.eps4)
        decision = Round(
            statistic=excess,
            limit=jnp.asarray(self.eps4),
            rejected=keep_at_least(self.least, wrong, size, history.mask),
            parallax=q,
            elements=element_values(elements),
        )
        return add_round(history, decision, active)

    def _correct(
        self, pair: Pair, history: History, elements: AbstractElements
    ) -> tuple[History, AbstractElements]:
        """One correction of the elements, which is a round without a decision."""
        new = iterate_once(pair, history.mask, elements)
        q = parallaxes(pair, history.mask, elements)
        iteration = Round(
            statistic=jnp.abs(q),
            limit=jnp.asarray(jnp.inf),
            rejected=jnp.zeros_like(history.mask),
            parallax=q,
            elements=element_values(new),
        )
        return add_round(history, iteration), new
