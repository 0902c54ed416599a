"""The third algorithm of 1971: the largest residual parallax goes, and all begins
again."""

import jax.numpy as jnp

from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import count
from .base import (
    OUTCOMES,
    AbstractProcedure,
    Rejection,
    Round,
    began,
    by_parallax,
    ended,
    finished,
    largest,
    mean_of,
    repeated,
    values,
)


class WorstPoint(AbstractProcedure):
    """While any point has |q| - mean |q| >= eps, reject the one with the largest |q|,
    down to `least` points.

    Each round is solved to convergence. Applies to more than `more_than` points
    (Dorozhinsky 1971, eqs 1 and 3).
    """

    eps: float = 0.01
    more_than: int = 9
    least: int = 6

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        enough = pair.count > self.more_than

        def judge(mask, history):
            # from zero in every round: a start that earlier points have spoiled gains
            # nothing
            solved = by_parallax(pair, mask)
            q = jnp.abs(solved.parallax)
            excess = q - mean_of(q, mask)
            go_on = (
                (count(mask & (excess >= self.eps)) > 0)
                & (count(mask) > self.least)
                & enough
            )
            return Round(
                q,
                self.eps + mean_of(q, mask),
                largest(q, mask) & go_on,
                solved.parallax,
                values(solved.elements),
            )

        history = repeated(
            judge, began(pair, max(pair.x_left.shape[0] - self.least, 0) + 1)
        )
        outcome = OUTCOMES.where(enough, finished(pair), OUTCOMES.nothing_to_test)
        return ended(history, by_parallax(pair, history.mask), outcome)
