"""The first algorithm of 1971: residual parallaxes against their mean."""

import jax.numpy as jnp
from jaxtyping import ScalarLike

from ..geometry.pairs import Pair
from .base import AbstractProcedure, Rejection
from .masked import mean_of
from .parallaxes import reject_once


class MeanParallax(AbstractProcedure):
    """Reject, once, every point with |q| - mean |q| >= eps after convergence
    (Dorozhinsky 1971, eqs 1 and 3).

    Applies to more than `more_than` points and leaves at least `least`; the points of
    largest |q| go first.
    """

    eps: ScalarLike = 0.01
    more_than: int = 9
    least: int = 6

    def clean(self, pair: Pair) -> Rejection:
        def judge(pair, solved):
            q = jnp.abs(solved.parallax)
            excess = q - mean_of(q, pair.mask)
            return excess, jnp.asarray(self.eps), excess >= self.eps

        return reject_once(pair, judge, self.more_than, self.least)
