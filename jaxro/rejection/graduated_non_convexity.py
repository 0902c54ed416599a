"""Graduated non-convexity: truncated least squares from a convex beginning (Blake and
Zisserman 1987, Yang 2020)."""

import jax
import jax.numpy as jnp
from jax import lax

from ..geometry.elements import RelativePose
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.starts import AbstractStart, Vertical
from .base import Rejection
from .robust import AbstractSearch, agreeing, in_single, judged, reweighted, scaled


class GraduatedNonConvexity(AbstractSearch):
    """Minimise Σ min(s, c²), s = (r/sigma)², c = `limit`, from absolute residuals over
    a loss that slowly lets go.

    `absolute` steps with weights 1/|r|; `graded` steps of Geman-McClure, weight (k²/(k²
    + s))², its k falling from `widest` to c in equal ratios; then `rounds` turns of
    least squares on the points with |w| <= c. Needs no subsets: its work grows with n.
    From about fifty points it stands half of them wrong; with sixteen, a fifth not
    always.
    """

    sigma: float | None = None
    limit: float = 3.29
    widest: float = 300.0
    absolute: int = 3
    graded: int = 12
    rounds: int = 4
    start: AbstractStart = Vertical(steps=0)

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose = self.search(fixed)
        use = fixed.mask & (linearised(fixed, pose).squares <= self.limit**2)
        return judged(
            pair, *agreeing(fixed, pose, use, self.limit, self.rounds), self.limit
        )

    def search(self, pair: Pair) -> RelativePose:
        """The pose after all graded steps, which are as good in single precision."""
        single = in_single(pair)

        def absolute(_, pose):
            return reweighted(single, pose, lambda s: 1 / jnp.sqrt(s + 1))

        def graded(i, pose):
            share = i.astype(jnp.float32) / max(self.graded - 1, 1)
            k2 = self.widest**2 * (self.limit / self.widest) ** (2 * share)
            return reweighted(single, pose, lambda s: (k2 / (k2 + s)) ** 2)

        pose = in_single(self.start(pair).pose)
        pose = lax.fori_loop(0, self.absolute, absolute, pose)
        pose = lax.fori_loop(0, self.graded, graded, pose)
        return jax.tree.map(lambda a: a.astype(pair.focal_left.dtype), pose).normalise()
