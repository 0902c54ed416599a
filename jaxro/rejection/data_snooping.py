"""Data snooping: the largest normalised residual goes (Baarda 1968, Pope 1976)."""

import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, ScalarLike

from ..adjustment import critical_values
from ..assessment.correlations import normalise
from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..orientation.starts import AbstractStart, Vertical
from ..statistics.explanations import DOUBT, misfit
from ..statistics.familywise import largest_tau, largest_w
from ..statistics.normalised import Normalised
from ..xla.passes import count
from .agreement import state_sigma
from .base import AbstractProcedure, PointValues, Rejection
from .rounds import (
    Round,
    conclude,
    finished_outcome,
    independent_values,
    repeat_rounds,
    rounds_of_one,
)


class DataSnooping(AbstractProcedure):
    """Reject the point with the largest |w|, w = r / (sigma sqrt(redundancy)), while it
    exceeds the critical value.

    `sigma`: standard deviation of a coordinate, the one of the pair if None; w is
    normal (Baarda). `estimated`: sigma0 of the adjustment takes its place (Pope's tau).
    `level`: of the test of a single point; with `familywise` of all tests of the pair
    together, by their correlations (`familywise.largest_w`). Rigorous residuals, one
    point a round, down to `least` points.

    If the omission of another point would explain the misfit as well, these points are
    `undecided`, none of them is rejected, and the procedure stops. `doubt`: the
    probability that a wrong point is passed over for another one (see
    `statistics.explanations`); with 1 the largest |w| always goes.
    """

    level: ScalarLike = 0.001
    sigma: ScalarLike | None = None
    estimated: bool = False
    familywise: bool = False
    least: int = 6
    start: AbstractStart = Vertical()
    doubt: ScalarLike = DOUBT

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        # the optimum does not depend on where it is sought
        start = self.start(lax.stop_gradient(pair)).pose

        def judge(mask):
            solved = orient(pair.with_mask(mask), start=start)
            w, limit, wrong = self._test(pair, mask, solved.pose)
            decided = (count(wrong) == 1) & (count(mask) > self.least)
            return Round(
                statistic=w,
                limit=limit,
                rejected=wrong & decided,
                parallax=solved.parallax,
                elements=independent_values(solved.pose),
            )

        history = repeat_rounds(judge, pair, rounds_of_one(pair, self.least))
        solved = orient(pair.with_mask(history.mask), start=start)
        _, _, wrong = self._test(pair, history.mask, solved.pose)
        undecided = wrong & (count(wrong) > 1)
        return conclude(history, solved, finished_outcome(pair), undecided)

    def _test(
        self, pair: Pair, mask: Bool[Array, "point"], pose: RelativePose
    ) -> tuple[PointValues, Float[Array, ""], Bool[Array, "point"]]:
        """|w| or |tau| of every point, the critical value, and the points one of which
        is wrong."""
        found = normalise(linearise(pair.with_mask(mask), pose), mask)
        limit = self._limit(found)
        w, wrong = misfit(found, limit, self.doubt, self.estimated)
        return w, limit, wrong

    def _limit(self, found: Normalised) -> Float[Array, ""]:
        if self.familywise:
            largest = largest_tau if self.estimated else largest_w
            return largest(self.level, found)
        return critical_values.by_count(
            self._point_limit, found.w.shape[0], found.freedom + 5
        )

    def _point_limit(self, n: np.ndarray) -> critical_values.Scalar:
        """The critical value of one of n points, tested alone."""
        level = self.level + 0 * n
        if self.estimated:
            return critical_values.tau(level, np.maximum(n - 5, 1.0))
        return critical_values.normal(level)
