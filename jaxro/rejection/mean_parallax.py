"""The first algorithm of 1971: residual parallaxes against their mean."""

import jax.numpy as jnp

from ..geometry.pairs import Pair, mask_unusable
from .base import (
    OUTCOMES,
    AbstractProcedure,
    Rejection,
    Round,
    at_most,
    began,
    by_parallax,
    ended,
    finished,
    mean_of,
    recorded,
    values,
)


class MeanParallax(AbstractProcedure):
    """Reject, once, every point with |q| - mean |q| >= eps (Dorozhinsky 1971, eqs 1 and
    3), after convergence.

    Applies to more than `more_than` points and leaves at least `least`, the points of
    largest |q| going first.
    """

    eps: float = 0.01
    more_than: int = 9
    least: int = 6

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        first = by_parallax(pair, pair.mask)
        q = jnp.abs(first.parallax)
        excess = q - mean_of(q, pair.mask)
        enough = pair.count > self.more_than
        bad = pair.mask & (excess >= self.eps) & enough
        bad = at_most(bad, q, pair.mask, self.least)
        new = Round(
            excess, jnp.asarray(self.eps), bad, first.parallax, values(first.elements)
        )
        history = recorded(began(pair, 1), new)
        outcome = OUTCOMES.where(enough, finished(pair), OUTCOMES.nothing_to_test)
        return ended(history, by_parallax(pair, history.mask, first.elements), outcome)
