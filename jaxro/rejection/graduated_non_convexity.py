"""Graduated non-convexity: truncated least squares from a convex beginning (Blake and
Zisserman 1987, Yang 2020)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import ScalarLike

from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.starts import AbstractStart, Vertical
from .agreement import keep_agreeing, state_sigma
from .base import Rejection
from .steps import geman_mcclure, in_single, step_by_weights
from .verdict import AbstractSearch, verdict


class GraduatedNonConvexity(AbstractSearch):
    """Minimise Σ min(s, c²), s = (r/sigma)², c = `limit`, from absolute residuals over
    a loss that slowly lets go of far points.

    First come `absolute` steps with weights 1/|r|. Then `graded` steps with the weights
    of Geman and McClure, (k²/(k² + s))², their k falling from `widest` to c in equal
    ratios. Last, `rounds` turns of least squares on the points with |w| <= c. No random
    subsets are needed, so that the work grows with n. With fifty points or more half of
    them may be wrong; with sixteen points sometimes a fifth is too many.
    """

    sigma: ScalarLike | None = None
    limit: ScalarLike = 3.29
    widest: ScalarLike = 300.0
    absolute: int = 3
    graded: int = 12
    rounds: int = 4
    start: AbstractStart = Vertical(steps=0)

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose = self.search(fixed)
        use = fixed.mask & (linearise(fixed, pose).squares <= self.limit**2)
        pose, use = keep_agreeing(fixed, pose, use, self.limit, self.rounds)
        return verdict(pair, pose, use, self.limit)

    def search(self, pair: Pair) -> RelativePose:
        """The pose after all graded steps, which are as good in single precision."""
        single = in_single(pair)

        def step(i, pose):
            share = (i - self.absolute).astype(jnp.float32) / max(self.graded - 1, 1)
            variance = self.widest**2 * (self.limit / self.widest) ** (2 * share)

            def weight(s):
                graded = geman_mcclure(s, variance)
                return jnp.where(i < self.absolute, lax.rsqrt(s + 1), graded)

            return step_by_weights(single, pose, weight)

        pose = in_single(self.start(pair).pose)
        pose = lax.fori_loop(0, self.absolute + self.graded, step, pose)
        double = lambda a: a.astype(pair.focal_left.dtype)
        return jax.tree.map(double, pose).normalise()
