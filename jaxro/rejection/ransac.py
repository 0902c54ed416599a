"""Random sample consensus with truncated squares and local optimisation."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..adjustment import critical_values
from ..geometry.elements import RelativePose, vertical
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import while_loop
from ..xla.passes import count, total
from .base import Rejection
from .hypotheses import (
    AbstractHypotheses,
    FivePoint,
    best,
    draws,
    moved_up,
    solutions,
    squares,
)
from .robust import AbstractSearch, agreeing, judged, scaled, stepped

CERTAIN = 1e-12
"""No share of good subsets is taken as nearer to 0 or 1 than this."""


class Found(NamedTuple):
    """The best pose so far and its score, the blocks of subsets it took, and the
    subsets that are enough for it."""

    pose: RelativePose
    score: Float[Array, ""]
    blocks: Int[Array, ""]
    enough: Float[Array, ""]


class Ransac(AbstractSearch):
    """Find the pose with the least Σ min((r/sigma)², limit²) among those of random
    subsets of a few points.

    MSAC (Torr and Zisserman 2000), local optimisation (Chum, Matas and Kittler 2003).
    `limit`: root of the chi-squared value of one degree of freedom at .001. The pose of
    a subset contains the errors of its points, so that a good point has the variance 1
    + h, h about one: subsets are compared with `margin` times the limit. The best of
    each block takes `steps` Gauss-Newton steps on the points within that and one on
    those within the limit, and is scored. The search ends after `count` subsets, or
    when 1 - (1 - p)^k reaches `confidence`, k the subsets so far, p the share of those
    without a point beyond the limit. `search` is followed by least squares and the
    rejection of points with |w| above the normal value of `level` / n, in `rounds`
    turns: `level` is the probability that a pair without errors loses a point.
    """

    hypotheses: AbstractHypotheses = FivePoint()
    count: int = 512
    confidence: float = 0.9999
    limit: float = 3.29
    margin: float = math.sqrt(2)
    steps: int = 2
    rounds: int = 2
    level: float = 0.01
    seed: int = 0
    sigma: float | None = None

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose = self.search(fixed)
        each = lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0))
        critical = critical_values.by_count(
            each, pair.x_left.shape[0], count(pair.mask)
        )
        use = pair.mask & (squares(fixed, pose) <= self.limit**2)
        return judged(
            pair, *agreeing(fixed, pose, use, critical, self.rounds), critical
        )

    def search(self, pair: Pair) -> RelativePose:
        return self.found(pair).pose

    def found(self, pair: Pair) -> Found:
        """The best pose, and what it took."""
        begin, points = self.hypotheses.begin(pair), moved_up(pair)
        block = self.hypotheses.block
        table = draws(self.hypotheses, self.count, self.seed)

        def more(old: Found):
            return (old.blocks < table.shape[0]) & (
                old.blocks.astype(old.enough.dtype) * block < old.enough
            )

        def searched(old: Found):
            poses, exist = solutions(
                self.hypotheses, pair, points, begin, table[old.blocks]
            )
            wide = jax.vmap(
                lambda pose: score(squares(pair, pose), self.margin * self.limit)
            )(poses)
            new = self.optimised(pair, best(poses, jnp.where(exist, wide, jnp.inf)))
            lower = score(squares(pair, new), self.limit)
            pick = lambda a, b: jnp.where(lower < old.score, a, b)
            pose = jax.tree.map(pick, new, old.pose)
            agree = count(pair.mask & (squares(pair, pose) <= self.limit**2))
            return Found(
                pose,
                pick(lower, old.score),
                old.blocks + 1,
                self.enough(agree, count(pair.mask)),
            )

        zero = jnp.zeros_like(pair.focal_left)
        # an empty pair, of those that fill up a batch, would run through all subsets
        wanted = jnp.where(count(pair.mask) >= self.hypotheses.size, jnp.inf, zero)
        start = Found(vertical(zero), zero + jnp.inf, zero.astype(int), wanted)
        return while_loop(more, searched, start, pair.focal_left)

    def optimised(self, pair: Pair, pose: RelativePose) -> RelativePose:
        """Gauss-Newton on the points within the wider limit, at last on those within
        the limit."""

        def step(k, pose):
            limit = self.limit * jnp.where(k < self.steps, self.margin, 1.0)
            linear = linearised(pair, pose)
            return stepped(
                pose, linear, jnp.where(linear.squares <= limit**2, linear.weight, 0.0)
            )

        return lax.fori_loop(0, self.steps + 1, step, pose)

    def enough(self, agree: Float[Array, ""], of: Float[Array, ""]) -> Float[Array, ""]:
        """How many subsets hold one of agreeing points alone with probability
        `confidence`."""
        share = math.prod(
            jnp.maximum(agree - k, 0.0) / jnp.maximum(of - k, 1.0)
            for k in range(self.hypotheses.size)
        )
        share = jnp.clip(share, CERTAIN, 1 - CERTAIN)
        return math.log1p(-self.confidence) / jnp.log1p(-share)


def score(squares: Float[Array, "point"], limit: float) -> Float[Array, ""]:
    """Σ min((r/sigma)², limit²)."""
    value = total(jnp.minimum(squares, limit**2))
    return jnp.where(jnp.isfinite(value), value, jnp.inf)
