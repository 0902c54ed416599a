"""The third algorithm of 1971: reject the largest residual parallax, and begin again."""

import jax.numpy as jnp
from jaxtyping import ScalarLike

from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import count
from .base import AbstractProcedure, Rejection
from .masked import mean_of
from .parallaxes import adjust_parallaxes
from .rounds import (
    Round,
    conclude,
    element_values,
    finished_if,
    largest,
    repeat_rounds,
    rounds_of_one,
)


class WorstPoint(AbstractProcedure):
    """While any point has |q| - mean |q| >= eps, reject the one with the largest |q|,
    down to `least` points.

    Each round is solved to convergence. Applies to more than `more_than` points
    (Dorozhinsky 1971, eqs 1 and 3).
    """

    eps: ScalarLike = 0.01
    more_than: int = 9
    least: int = 6

    def clean(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        enough = pair.count > self.more_than

        def judge(mask):
            # every round begins with zero elements: the last solution is spoiled by the
            # point that was rejected
            solved = adjust_parallaxes(pair, mask)
            q = jnp.abs(solved.parallax)
            mean = mean_of(q, mask)
            wrong = mask & (q - mean >= self.eps)
            go_on = (count(wrong) > 0) & (count(mask) > self.least) & enough
            return Round(
                statistic=q,
                limit=mean + self.eps,
                rejected=largest(q, mask) & go_on,
                parallax=solved.parallax,
                elements=element_values(solved.elements),
            )

        history = repeat_rounds(judge, pair, rounds_of_one(pair, self.least))
        final = adjust_parallaxes(pair, history.mask)
        return conclude(history, final, finished_if(enough))
