"""Graduated non-convexity: truncated least squares from a convex beginning (Blake and Zisserman 1987, Yang 2020)."""

import jax
import jax.numpy as jnp
from jax import lax

from ..elements import RelativePose
from ..orientation import orient
from ..pairs import Pair, cleaned
from ..starts import AbstractStart, Vertical
from .base import AbstractProcedure, Rejection, Round, began, ended, finished, independent, recorded
from .robust import agreeing, at, normalised, reweighted, scaled


class GraduatedNonConvexity(AbstractProcedure):
    """Minimise Σ min(s, c²), s = (r/sigma)², c = `limit`, from absolute residuals over a loss that slowly lets go.

    `absolute` steps with weights 1/|r|; `graded` steps of Geman-McClure, weight (k²/(k² + s))², its k falling from
    `widest` to c in equal ratios; then `rounds` turns of least squares on the points with |w| <= c. Needs no subsets:
    its work grows with n. From about fifty points it stands half of them wrong; with sixteen, a fifth not always.
    """

    sigma: float | None = None
    limit: float = 3.29
    widest: float = 300.0
    absolute: int = 3
    graded: int = 12
    rounds: int = 4
    start: AbstractStart = Vertical(steps=0)

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        begin = self.start(lax.stop_gradient(pair)).pose
        pose, use = self.search(lax.stop_gradient(pair), begin)
        linear = at(pair, pose)
        w = normalised(linear, use)
        solved = orient(pair.with_mask(use), start=pose)
        new = Round(
            jnp.where(pair.mask, w, 0.0),
            jnp.asarray(self.limit),
            pair.mask & ~use,
            solved.parallax,
            independent(solved.pose),
        )
        return ended(recorded(began(pair, 1), new), solved, finished(pair))

    def search(self, pair: Pair, pose: RelativePose):
        """The pose and the points that agree with it."""
        single = _with_dtype(jnp.float32, pair)
        pose = _with_dtype(jnp.float32, pose)

        def absolute(_, pose):
            return reweighted(single, pose, lambda s: 1 / jnp.sqrt(s + 1))

        def graded(i, pose):
            share = i / max(self.graded - 1, 1)
            k2 = jnp.asarray(self.widest**2, jnp.float32) * (self.limit / self.widest) ** (2 * share)
            return reweighted(single, pose, lambda s: (k2 / (k2 + s)) ** 2)

        pose = lax.fori_loop(0, self.absolute, absolute, pose)
        pose = lax.fori_loop(0, self.graded, lambda i, p: graded(i.astype(jnp.float32), p), pose)
        pose = _with_dtype(pair.focal_left.dtype, pose).normalised()
        use = pair.mask & (at(pair, pose).squares <= self.limit**2)
        return agreeing(pair, pose, use, self.limit, self.rounds)


def _with_dtype(dtype, tree):
    return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)
