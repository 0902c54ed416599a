"""Least median of squares (Rousseeuw 1984; Rousseeuw and Leroy 1987)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import count, total
from .base import Rejection
from .hypotheses import (
    AbstractHypotheses,
    Newton,
    best,
    draws,
    moved_up,
    solutions,
    squares,
)
from .robust import AbstractSearch, Use, Values, improved, judged

BITS = 2 ** np.arange(30, -1, -1, dtype=np.int32)
"""Of a positive number in single precision, the highest first."""


class LeastMedian(AbstractSearch):
    """Of the poses of `count` random subsets of five points the one with the least
    median r²; what is far from it goes.

    The "median" is the r² of rank [n/2] + 3: of the p = 5 points of a subset r is zero,
    so that the rank is [(p+1)/2] above n/2 (Rousseeuw and Leroy, chapter 3). s = 1.4826
    (1 + 5/(n - 5)) sqrt(median r²) estimates sigma from the points that fit best;
    points with |r| > `limit` s are left out, the others solved by least squares, and by
    their sigma0 all are judged once more (`rounds`). Nothing need be known of sigma
    (that of the pair counts as relative weight), and nearly half of the points may be
    wrong. Its price: 2.5 s rejects one good point of eighty even where the estimate is
    good, and with few points it is too small, since the best of many poses fits most of
    them by chance. `count`: 150 subsets hold one without a wrong point with probability
    .99 if half of the points are wrong.
    """

    hypotheses: AbstractHypotheses = Newton()
    count: int = 150
    limit: float = 2.5
    rounds: int = 2
    seed: int = 0

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose, median = self._found(fixed)
        unit = (
            1.4826 * (1 + 5 / jnp.maximum(count(pair.mask) - 5, 1.0)) * jnp.sqrt(median)
        )
        use = pair.mask & (squares(fixed, pose) <= (self.limit * unit) ** 2)
        for _ in range(self.rounds):
            pose = improved(fixed, pose, use)
            after = squares(fixed, pose)
            unit = jnp.sqrt(
                total(jnp.where(use, after, 0.0)) / jnp.maximum(count(use) - 5, 1.0)
            )
            use = pair.mask & (after <= (self.limit * unit) ** 2)
        return judged(pair, pose, use, self.limit * unit)

    def search(self, pair: Pair) -> RelativePose:
        return self._found(pair)[0]

    def _found(self, pair: Pair) -> tuple[RelativePose, Float[Array, ""]]:
        """The best pose and its median r²."""
        begin, points = self.hypotheses.begin(pair), moved_up(pair)

        def searched(old, uniform):
            poses, exist = solutions(self.hypotheses, pair, points, begin, uniform)
            medians = jax.vmap(lambda pose: median(squares(pair, pose), pair.mask))(
                poses
            )
            medians = jnp.where(exist & jnp.isfinite(medians), medians, jnp.inf)
            lowest = jnp.min(medians)
            pick = lambda a, b: jnp.where(lowest < old[1], a, b)
            return jax.tree.map(pick, (best(poses, medians), lowest), old), None

        nothing = vertical(pair.focal_left), jnp.full_like(pair.focal_left, jnp.inf)
        return lax.scan(
            searched, nothing, draws(self.hypotheses, self.count, self.seed)
        )[0]


def median(values: Values, use: Use) -> Float[Array, ""]:
    """The value of rank [n/2] + 3 of those in use, none of them negative, to single
    precision; NaN of four and fewer.

    Positive numbers are ordered as their bits are: bisection of these, without sorting.
    """
    bits = lax.bitcast_convert_type(values.astype(jnp.float32), jnp.int32)
    ones = use.astype(jnp.float32)
    rank = jnp.floor(total(ones) / 2) + 3

    def halved(low, bit):
        middle = low + bit
        return jnp.where(
            total(jnp.where(bits < middle, ones, 0.0)) < rank, middle, low
        ), None

    low, _ = lax.scan(halved, 0 * bits[0], jnp.asarray(BITS))
    return lax.bitcast_convert_type(low, jnp.float32).astype(values.dtype)
