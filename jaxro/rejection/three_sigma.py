"""The second algorithm of 1971: residual parallaxes against 3 m_q."""

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
    recorded,
    values,
)


class ThreeSigma(AbstractProcedure):
    """Reject, once, every point with |q| >= factor m_q, m_q = sqrt([qq]/(n-5))
    (Dorozhinsky 1971, eqs 2 and 4).

    Applies to more than `more_than` points and leaves at least `least`, the points of
    largest |q| going first.
    """

    factor: float = 3.0
    more_than: int = 9
    least: int = 6

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        first = by_parallax(pair, pair.mask)
        q = jnp.abs(first.parallax)
        limit = self.factor * first.m_q
        enough = pair.count > self.more_than
        bad = pair.mask & (q >= limit) & (q > 1e-12 * pair.focal_left) & enough
        bad = at_most(bad, q, pair.mask, self.least)
        history = recorded(
            began(pair, 1), Round(q, limit, bad, first.parallax, values(first.elements))
        )
        outcome = OUTCOMES.where(enough, finished(pair), OUTCOMES.nothing_to_test)
        return ended(history, by_parallax(pair, history.mask, first.elements), outcome)
