"""Least median of squares (Rousseeuw 1984; Rousseeuw and Leroy 1987)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, ScalarLike

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import count, total
from .agreement import points_within, squares
from .base import Rejection
from .hypotheses import AbstractHypotheses, Newton, best, solve_block
from .masked import Use, Values, choose, sum_of
from .steps import improve
from .subsets import draw, move_up_coordinates
from .verdict import AbstractSearch, verdict

NORMAL = 1.4826
"""The standard deviation of normal numbers over the median of their absolute values."""

BITS = 2 ** np.arange(30, -1, -1, dtype=np.int32)
"""The bits of a positive number in single precision, the highest first."""


class LeastMedian(AbstractSearch):
    """Of the poses of `count` random subsets of five points take the one with the least
    median r²; reject the points that are far from it.

    The "median" is the r² of rank [n/2] + 3: of the p = 5 points of a subset r is zero,
    so that the rank is [(p+1)/2] above n/2 (Rousseeuw and Leroy, chapter 3). s = 1.4826
    (1 + 5/(n - 5)) sqrt(median r²) estimates sigma from the points that fit best.
    Points with |r| > `limit` s are left out, the others are solved by least squares,
    and by their sigma0 all are judged once more, `rounds` times. Nothing need be known
    of sigma (the sigma of the pair counts as relative weight), and nearly half of the
    points may be wrong. In return 2.5 s rejects one good point of eighty even where the
    estimate is good, and with few points it is too small, since the best of many poses
    fits most of them by chance. `count`: 150 subsets hold one without a wrong point
    with probability .99 if half of the points are wrong.
    """

    hypotheses: AbstractHypotheses = Newton()
    count: int = 150
    limit: ScalarLike = 2.5
    rounds: int = 2
    seed: int = 0

    def clean(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose, median = self._find(fixed)
        freedom = jnp.maximum(count(pair.mask) - 5, 1.0)
        sigma = NORMAL * (1 + 5 / freedom) * jnp.sqrt(median)
        use = points_within(fixed, pose, self.limit * sigma)
        for _ in range(self.rounds):
            pose = improve(fixed, pose, use)
            after = squares(fixed, pose)
            misfit = sum_of(after, use)
            sigma = jnp.sqrt(misfit / jnp.maximum(count(use) - 5, 1.0))
            most = (self.limit * sigma) ** 2
            use = pair.mask & (after <= most)
        return verdict(pair, pose, use, self.limit * sigma)

    def search(self, pair: Pair) -> RelativePose:
        return self._find(pair)[0]

    def _find(self, pair: Pair) -> tuple[RelativePose, Float[Array, ""]]:
        """The best pose and its median r²."""
        hypotheses = self.hypotheses
        begin, rows = hypotheses.begin(pair), move_up_coordinates(pair)
        uniform = draw(hypotheses.size, hypotheses.block, self.count, self.seed)

        def search_block(old, numbers):
            poses, exist = solve_block(hypotheses, pair, rows, begin, numbers)
            median_of = lambda pose: median(squares(pair, pose), pair.mask)
            medians = jax.vmap(median_of)(poses)
            medians = jnp.where(exist & jnp.isfinite(medians), medians, jnp.inf)
            lowest = jnp.min(medians)
            new = best(poses, medians), lowest
            return choose(lowest < old[1], new, old), None

        nothing = vertical(pair.focal_left), jnp.full_like(pair.focal_left, jnp.inf)
        return lax.scan(search_block, nothing, uniform)[0]


def median(values: Values, use: Use) -> Float[Array, ""]:
    """The value of rank [n/2] + 3 of the n in use, none of them negative, to single
    precision; NaN of four and fewer.

    The bits of positive numbers are ordered as the numbers are, so that bisection of
    the bits finds the value without sorting.
    """
    bits = lax.bitcast_convert_type(values.astype(jnp.float32), jnp.int32)
    ones = use.astype(jnp.float32)
    rank = jnp.floor(total(ones) / 2) + 3

    def halve(low, bit):
        middle = low + bit
        below = sum_of(ones, bits < middle)
        return jnp.where(below < rank, middle, low), None

    low, _ = lax.scan(halve, 0 * bits[0], jnp.asarray(BITS))
    return lax.bitcast_convert_type(low, jnp.float32).astype(values.dtype)
