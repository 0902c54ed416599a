"""Random sample consensus with truncated squares and local optimisation."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, ScalarLike

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import while_loop
from ..xla.passes import count, total
from .agreement import (
    familywise_limit,
    keep_agreeing,
    points_within,
    squares,
    state_sigma,
)
from .base import Rejection
from .hypotheses import AbstractHypotheses, FivePoint, best, solve_block
from .masked import choose
from .steps import improve_within
from .subsets import draw, move_up_coordinates, subsets_enough
from .verdict import AbstractSearch, verdict


class Found(NamedTuple):
    """The best pose so far and its cost, the blocks of subsets solved, and the number
    of subsets that are enough for it."""

    pose: RelativePose
    cost: Float[Array, ""]
    blocks: Int[Array, ""]
    enough: Float[Array, ""]


class Ransac(AbstractSearch):
    """Find the pose with the least Σ min((r/sigma)², limit²) among those of random
    subsets of a few points.

    The cost is that of MSAC (Torr and Zisserman 2000), with local optimisation (Chum,
    Matas and Kittler 2003). `limit`: root of the chi-squared value of one degree of
    freedom at .001. The pose of a subset contains the errors of its points, so that a
    good point has the variance 1 + h, h about one: subsets are compared with `margin`
    times the limit. The best of each block takes `steps` Gauss-Newton steps on the
    points within that and one on those within the limit, and is compared with the best
    so far. The search ends after `count` subsets, or when 1 - (1 - p)^k reaches
    `confidence`, k the subsets so far, p the share of those without a point beyond the
    limit. Then follow, in `rounds` turns, least squares and the rejection of points
    with |w| above the normal value of `level` / n: `level` is the probability that a
    pair without errors loses a point.
    """

    hypotheses: AbstractHypotheses = FivePoint()
    count: int = 512
    confidence: ScalarLike = 0.9999
    limit: ScalarLike = 3.29
    margin: ScalarLike = math.sqrt(2)
    steps: int = 2
    rounds: int = 2
    level: ScalarLike = 0.01
    seed: int = 0
    sigma: ScalarLike | None = None

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose = self.search(fixed)
        use = points_within(fixed, pose, self.limit)
        critical = familywise_limit(self.level, pair)
        pose, use = keep_agreeing(fixed, pose, use, critical, self.rounds)
        return verdict(pair, pose, use, critical)

    def search(self, pair: Pair) -> RelativePose:
        return self.find(pair).pose

    def find(self, pair: Pair) -> Found:
        """The best pose, and what it took."""
        begin, rows = self.hypotheses.begin(pair), move_up_coordinates(pair)
        size, block = self.hypotheses.size, self.hypotheses.block
        uniform = draw(size, block, self.count, self.seed)
        n = count(pair.mask)

        def more(old: Found):
            solved = old.blocks.astype(old.enough.dtype) * block
            return (old.blocks < uniform.shape[0]) & (solved < old.enough)

        def search_block(old: Found) -> Found:
            numbers = uniform[old.blocks]
            poses, exist = solve_block(self.hypotheses, pair, rows, begin, numbers)
            wide = self.margin * self.limit
            costs = jax.vmap(lambda pose: _cost(squares(pair, pose), wide))(poses)
            new = best(poses, jnp.where(exist, costs, jnp.inf))
            new = improve_within(pair, new, self.limit, self.margin, self.steps + 1)
            cost = _cost(squares(pair, new), self.limit)
            lower = cost < old.cost
            pose = choose(lower, new, old.pose)
            agree = count(points_within(pair, pose, self.limit))
            return Found(
                pose=pose,
                cost=jnp.where(lower, cost, old.cost),
                blocks=old.blocks + 1,
                enough=subsets_enough(agree, n, size, self.confidence),
            )

        zero = jnp.zeros_like(pair.focal_left)
        start = Found(
            pose=vertical(zero),
            cost=zero + jnp.inf,
            blocks=zero.astype(int),
            # an empty pair, of those that fill up a batch, needs no search
            enough=jnp.where(n >= size, jnp.inf, zero),
        )
        return while_loop(more, search_block, start, pair.focal_left)


def _cost(squares: Float[Array, "point"], limit: ScalarLike) -> Float[Array, ""]:
    """Σ min((r/sigma)², limit²); infinite where it is no number."""
    value = total(jnp.minimum(squares, limit**2))
    return jnp.where(jnp.isfinite(value), value, jnp.inf)
