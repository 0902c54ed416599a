"""Iteratively reweighted least squares with the weight functions of robust statistics and geodesy."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..conditions import linearised
from ..elements import RelativePose
from ..losses import AbstractWeight, Tukey
from ..pairs import Pair, cleaned
from ..starts import AbstractStart, Vertical
from .base import Rejection
from .robust import AbstractSearch, Values, judged, normalised, scaled, stepped

PLAIN = 2
"""Steps of least squares before the first reweighted one."""


class Reweighting(AbstractSearch):
    """Least squares with the weights `function`(w²), w the standardised residuals, until the pose rests; |w| > `limit`
    goes.

    Standardised, not plain residuals are weighed, since a point of large leverage draws the solution to itself. A
    solution of least squares comes first, so that with the functions that let go of a point (all but Huber's and
    least absolute residuals) it is the local optimum next to that. Ends after `rounds`, or when no local parameter
    moves by more than `tolerance` (rad). `limit`: root of the chi-squared value of one degree of freedom at .001.
    """

    function: AbstractWeight = Tukey()
    limit: float = 3.29
    rounds: int = 50
    tolerance: float = 1e-7
    sigma: float | None = None
    start: AbstractStart = Vertical()

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose, share = self._solved(fixed)
        use = pair.mask & (normalised(linearised(fixed, pose), share) <= self.limit)
        return judged(pair, pose, use, self.limit)

    def search(self, pair: Pair) -> RelativePose:
        return self._solved(pair)[0]

    def _solved(self, pair: Pair) -> tuple[RelativePose, Values]:
        """The pose and the factors of the weights at it."""
        zero = jnp.zeros_like(pair.focal_left)

        def more(state):
            rounds, moved, *_ = state
            return (rounds < self.rounds) & ((moved > self.tolerance) | (rounds <= PLAIN))

        def turn(state):
            rounds, _, pose, share = state
            linear = linearised(pair, pose)
            w = normalised(linear, share)
            new = jnp.where(pair.mask, self.function.weight(w * w), 0.0)
            share = jnp.where(rounds < PLAIN, share, new)
            after = stepped(pose, linear, linear.weight * share)
            return rounds + 1, _distance(pose, after), after, share

        full = pair.mask.astype(pair.sigma.dtype)
        _, _, pose, share = lax.while_loop(more, turn, (zero.astype(int), zero + jnp.inf, self.start(pair).pose, full))
        return pose, share  # pyright: ignore[reportReturnType]


def _distance(one: RelativePose, other: RelativePose) -> Float[Array, ""]:
    """The largest difference of a component of quaternion or base, which is at least half the angle between them."""
    worst = one.qw * 0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        worst = jnp.maximum(worst, jnp.abs(a - b))
    return worst
