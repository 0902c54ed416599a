"""Iteratively reweighted least squares with the weight functions of robust statistics
and geodesy."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment.losses import AbstractWeight, Huber, Tukey
from ..geometry.elements import RelativePose
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.starts import AbstractStart, Vertical
from ..xla.kernels import while_loop
from ..xla.passes import count
from .base import OUTCOMES, Rejection
from .robust import AbstractSearch, Values, judged, normalised, scaled, stepped

PLAIN, CONVEX, FULL = 2, 5, 15
"""Steps of least squares, steps with Huber's weights, steps with those of the function
itself; what follows uses the mean of new and last weights.

A function that lets go of a point has many local optima, and large errors spoil that
next to least squares: of 1,000 pairs of 16 points with up to three errors of 4 to 1,000
sigma Tukey's function alone cleans 57 % perfectly, after Huber's 87 %. It can also take
a point up and let it go for ever: 10 % of these pairs, with the means none.
"""

HOLDS = 1e-6
"""Factor of a weight above which a point holds the pose."""


class Reweighting(AbstractSearch):
    """Least squares with the weights `function`(w²), w the standardised residuals,
    until the pose rests; |w| > `limit` goes.

    Standardised, not plain residuals are weighed, since a point of large leverage draws
    the solution to itself. Least squares and a few steps with Huber's weights come
    first, since a function that lets go of a point needs a start that is robust
    already. Ends when no local parameter moves by more than `tolerance` (rad), or after
    `rounds`: outcome `did_not_rest`. `limit`: root of the chi-squared value of one
    degree of freedom at .001.
    """

    function: AbstractWeight = Tukey()
    limit: float = 3.29
    rounds: int = 100
    tolerance: float = 1e-7
    sigma: float | None = None
    start: AbstractStart = Vertical()

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        rests, pose, share = self._solved(fixed)
        w = normalised(linearised(fixed, pose), share)
        return judged(pair, pose, pair.mask & (w <= self.limit), self.limit, w).only_if(
            rests, OUTCOMES.did_not_rest
        )

    def search(self, pair: Pair) -> RelativePose:
        return self._solved(pair)[1]

    def _solved(self, pair: Pair) -> tuple[Bool[Array, ""], RelativePose, Values]:
        """Whether it rests, the pose, and the factors of the weights at it."""
        zero = jnp.zeros_like(pair.focal_left)

        def more(state):
            rounds, moved, *_ = state
            return (rounds < self.rounds) & (
                (moved > self.tolerance) | (rounds <= PLAIN + CONVEX)
            )

        def turn(state):
            rounds, _, pose, share = state
            linear = linearised(pair, pose)
            w = normalised(linear, share)
            new = jnp.where(
                rounds < PLAIN + CONVEX,
                Huber().weight(w * w),
                self.function.weight(w * w),
            )
            new = jnp.where(rounds < PLAIN + CONVEX + FULL, new, (share + new) / 2)
            share = jnp.where(rounds < PLAIN, share, jnp.where(pair.mask, new, 0.0))
            after = stepped(pose, linear, linear.weight * share)
            return rounds + 1, _distance(pose, after), after, share

        full = pair.mask.astype(pair.sigma.dtype)
        start = zero.astype(int), zero + jnp.inf, self.start(pair).pose, full
        _, moved, pose, share = while_loop(more, turn, start, pair.focal_left)
        # a pose that no five points hold cannot move, which is no rest
        rests = (moved <= self.tolerance) & (count(share > HOLDS) >= 5)
        return rests, pose, share  # pyright: ignore[reportReturnType]


def _distance(one: RelativePose, other: RelativePose) -> Float[Array, ""]:
    """The largest difference of a component of quaternion or base, which is at least
    half the angle between them."""
    worst = one.qw * 0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        worst = jnp.maximum(worst, jnp.abs(a - b))
    return worst
