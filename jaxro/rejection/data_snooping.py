"""Data snooping: the largest normalised residual goes (Baarda 1968, Pope 1976)."""

import jax.numpy as jnp
from jax import lax

from .. import critical_values
from ..orientation import orient
from ..pairs import Pair, cleaned
from ..reductions import count
from ..starts import AbstractStart, Vertical
from .base import AbstractProcedure, Rejection, Round, began, ended, finished, independent, largest, repeated
from .robust import scaled

UNTESTABLE = 1e-6
"""Redundancy number below which a point is not checked by the others."""


class DataSnooping(AbstractProcedure):
    """Reject the point with the largest |w|, w = r / (sigma sqrt(redundancy)), while it exceeds the critical value.

    `sigma`: standard deviation of a coordinate, that of the pair if None (Baarda's w, normal). `estimated`: sigma0 of
    the adjustment in its place (Pope's tau). `level`: of every point; `familywise`: of all together, shared out by
    level / n. Rigorous residuals, one point a round, down to `least` points.
    """

    level: float = 0.001
    sigma: float | None = None
    estimated: bool = False
    familywise: bool = False
    least: int = 6
    start: AbstractStart = Vertical()

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        pose = self.start(lax.stop_gradient(pair)).pose  # the optimum does not depend on where it is sought

        def judge(mask, history):
            solved = orient(pair.with_mask(mask), start=pose)
            unit = solved.sigma0 if self.estimated else jnp.ones_like(solved.sigma0)
            known = mask & (solved.redundancy > UNTESTABLE) & (unit > 0)
            spread = unit * jnp.sqrt(jnp.where(known, solved.redundancy, 1.0))
            w = jnp.where(known, jnp.abs(solved.residuals) / jnp.where(known, spread, 1.0), 0.0)
            limit = critical_values.by_count(self._limit, mask.shape[0], count(mask))
            out = largest(w, known) & (w > limit) & (count(mask) > self.least)
            return Round(w, limit, out, solved.parallax, independent(solved.pose))

        history = repeated(judge, began(pair, max(pair.x_left.shape[0] - self.least, 0) + 1))
        return ended(history, orient(pair.with_mask(history.mask), start=pose), finished(pair))

    def _limit(self, n):
        level = self.level / jnp.maximum(n, 1.0) if self.familywise else self.level + 0 * n
        return critical_values.tau(level, jnp.maximum(n - 5, 1.0)) if self.estimated else critical_values.normal(level)
