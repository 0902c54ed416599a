"""Data snooping: the largest normalised residual goes (Baarda 1968, Pope 1976)."""

import jax.numpy as jnp
from jax import lax

from ..adjustment import critical_values
from ..assessment.correlations import Normalised, normalised
from ..assessment.familywise import largest_tau, largest_w
from ..assessment.undecided import DOUBT, misfit
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..orientation.starts import AbstractStart, Vertical
from ..xla.passes import count
from .base import (
    AbstractProcedure,
    Rejection,
    Round,
    began,
    ended,
    finished,
    independent,
    repeated,
)
from .robust import scaled


class DataSnooping(AbstractProcedure):
    """Reject the point with the largest |w|, w = r / (sigma sqrt(redundancy)), while it
    exceeds the critical value.

    `sigma`: standard deviation of a coordinate, that of the pair if None (Baarda's w,
    normal). `estimated`: sigma0 of the adjustment in its place (Pope's tau). `level`:
    of every point; `familywise`: of all together, by their correlations
    (`familywise.largest_w`). Rigorous residuals, one point a round, down to `least`
    points.

    Where the omission of other points explains the largest |w| as well, all these
    points are `undecided`, none of them is rejected, and the procedure stops. `doubt`:
    the probability that a wrong point is passed over for another one (see `undecided`);
    with 1 the largest |w| always goes.
    """

    level: float = 0.001
    sigma: float | None = None
    estimated: bool = False
    familywise: bool = False
    least: int = 6
    start: AbstractStart = Vertical()
    doubt: float = DOUBT

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        pose = self.start(
            lax.stop_gradient(pair)
        ).pose  # the optimum does not depend on where it is sought

        def tested(mask, solved):
            found = normalised(linearised(pair.with_mask(mask), solved.pose), mask)
            limit = self._limit(found)
            w, wrong = misfit(found, limit, self.doubt, self.estimated)
            return w, limit, wrong

        def judge(mask, history):
            solved = orient(pair.with_mask(mask), start=pose)
            w, limit, wrong = tested(mask, solved)
            out = wrong & (count(wrong) == 1) & (count(mask) > self.least)
            return Round(w, limit, out, solved.parallax, independent(solved.pose))

        history = repeated(
            judge, began(pair, max(pair.x_left.shape[0] - self.least, 0) + 1)
        )
        solved = orient(pair.with_mask(history.mask), start=pose)
        _, _, wrong = tested(history.mask, solved)
        return ended(history, solved, finished(pair), wrong & (count(wrong) > 1))

    def _limit(self, found: Normalised):
        if self.familywise:
            return (largest_tau if self.estimated else largest_w)(self.level, found)
        return critical_values.by_count(
            self._of_a_point, found.w.shape[0], found.freedom + 5
        )

    def _of_a_point(self, n):
        level = self.level + 0 * n
        return (
            critical_values.tau(level, jnp.maximum(n - 5, 1.0))
            if self.estimated
            else critical_values.normal(level)
        )
