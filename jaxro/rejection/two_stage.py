"""One procedure after another."""

import jax.numpy as jnp

from ..geometry.pairs import Pair
from .base import OUTCOMES, AbstractProcedure, Log, Rejection
from .dorozhinsky import Dorozhinsky
from .leave_one_out_grubbs import LeaveOneOutGrubbs


class TwoStage(AbstractProcedure):
    """Residual parallaxes first, Grubbs on the points left: the two stages of table 2
    of 1989.

    Its residual-parallax stage (eqs 2 to 4) is the algorithm of 1971. Any two
    procedures can be chained. A pair on which the first needs an operator is still
    given to the second, and keeps that outcome.
    """

    first: AbstractProcedure = Dorozhinsky()
    second: AbstractProcedure = LeaveOneOutGrubbs()

    def __call__(self, pair: Pair) -> Rejection:
        one = self.first(pair)
        two = self.second(pair.with_mask(one.mask))
        later = two.order > 0
        log = Log(
            *(
                jnp.concatenate([a, b])
                for a, b in zip(_parts(one.log), _parts(two.log), strict=True)
            )
        )
        unfinished = one.outcome == OUTCOMES.operator_needed
        return Rejection(
            mask=two.mask,
            order=jnp.where(later, two.order + jnp.max(one.order), one.order),
            statistic=jnp.where(one.order > 0, one.statistic, two.statistic),
            log=log,
            orientation=two.orientation,
            outcome=OUTCOMES.where(unfinished, one.outcome, two.outcome),
            undecided=two.undecided,
        )


def _parts(log: Log) -> tuple:
    return (
        log.happened,
        log.statistic,
        log.limit,
        log.rejected,
        log.parallax,
        log.elements,
    )
