"""Two procedures, one after the other."""

import jax
import jax.numpy as jnp

from ..geometry.pairs import Pair
from .base import OUTCOMES, AbstractProcedure, Rejection
from .dorozhinsky import Dorozhinsky
from .leave_one_out_grubbs import LeaveOneOutGrubbs


class TwoStage(AbstractProcedure):
    """Residual parallaxes first, then Grubbs' test on the points left: the two stages
    of table 2 of Burshtynskaya and Tumskaya (1989).

    Their residual-parallax stage (eqs 2 to 4) is the algorithm of 1971. Any two
    procedures can be chained. A pair for which the first one needs an operator goes
    through the second as well, and keeps that outcome.
    """

    first: AbstractProcedure = Dorozhinsky()
    second: AbstractProcedure = LeaveOneOutGrubbs()

    def clean(self, pair: Pair) -> Rejection:
        one = self.first(pair)
        two = self.second(pair.with_mask(one.mask))
        early, late = one.order > 0, two.order > 0
        unfinished = one.outcome == OUTCOMES.operator_needed
        return Rejection(
            mask=two.mask,
            order=jnp.where(late, two.order + jnp.max(one.order), one.order),
            statistic=jnp.where(early, one.statistic, two.statistic),
            log=jax.tree.map(lambda *both: jnp.concatenate(both), one.log, two.log),
            orientation=two.orientation,
            outcome=OUTCOMES.where(unfinished, one.outcome, two.outcome),
            undecided=two.undecided,
            in_use=two.in_use,
            unchecked=one.unchecked | two.unchecked,
            rivals=two.rivals,
        )
