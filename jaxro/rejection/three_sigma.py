"""The second algorithm of 1971: residual parallaxes against 3 m_q."""

import jax.numpy as jnp
from jaxtyping import ScalarLike

from ..geometry.pairs import Pair
from .base import AbstractProcedure, Rejection
from .parallaxes import reject_once

ROUNDING = 1e-12
"""Parallaxes up to this part of the focal length are rounding errors: the limit of a
pair without any error is zero."""


class ThreeSigma(AbstractProcedure):
    """Reject, once, every point with |q| >= factor m_q, m_q = sqrt([qq]/(n-5))
    (Dorozhinsky 1971, eqs 2 and 4).

    Applies to more than `more_than` points and leaves at least `least`; the points of
    largest |q| go first.
    """

    factor: ScalarLike = 3.0
    more_than: int = 9
    least: int = 6

    def clean(self, pair: Pair) -> Rejection:
        def judge(pair, solved):
            q = jnp.abs(solved.parallax)
            limit = self.factor * solved.m_q
            real = q > ROUNDING * pair.focal_left
            return q, limit, (q >= limit) & real

        return reject_once(pair, judge, self.more_than, self.least)
