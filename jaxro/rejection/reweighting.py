"""Iteratively reweighted least squares with the weight functions of robust statistics
and geodesy."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..adjustment.losses import AbstractWeight, Huber, Tukey
from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.starts import AbstractStart, Vertical
from ..xla.kernels import while_loop
from ..xla.passes import count
from .agreement import normalised_residuals, state_sigma
from .base import OUTCOMES, Rejection
from .masked import Values
from .steps import take_step
from .verdict import AbstractSearch, verdict

PLAIN, CONVEX, FULL = 2, 5, 15
"""Steps of least squares, steps with Huber's weights, steps with the weights of the
function itself; what follows uses the mean of new and last weights.

A function that lets go of a point has many local optima, and large errors spoil the one
next to least squares: of 1,000 pairs of 16 points with up to three errors of 4 to 1,000
sigma Tukey's function alone cleans 57 % perfectly, after Huber's 87 %. It can also take
a point up and let it go for ever: 10 % of these pairs, with the means none.
"""

HOLDS = 1e-6
"""Factor of a weight above which a point holds the pose."""


class State(NamedTuple):
    """After some steps: the largest change of the last one, the pose, and the factors
    of the weights by which it was found."""

    steps: Int[Array, ""]
    moved: Float[Array, ""]
    pose: RelativePose
    share: Values


class Reweighting(AbstractSearch):
    """Least squares with the weights `function`(w²), w the normalised residuals, until
    the pose comes to rest; points with |w| > `limit` are rejected.

    Normalised residuals are weighed, since a point of large leverage draws the solution
    to itself and has a small residual. Least squares and a few steps with Huber's
    weights come first, since a function that lets go of a point needs a start that is
    robust already. Ends when no local parameter moves by more than `tolerance` (rad),
    or after `rounds`, with the outcome `did_not_rest`. `limit`: root of the chi-squared
    value of one degree of freedom at .001.
    """

    function: AbstractWeight = Tukey()
    limit: ScalarLike = 3.29
    rounds: int = 100
    tolerance: ScalarLike = 1e-7
    sigma: ScalarLike | None = None
    start: AbstractStart = Vertical()

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        found = self._solve(fixed)
        w = normalised_residuals(linearise(fixed, found.pose), found.share)
        use = pair.mask & (w <= self.limit)
        result = verdict(pair, found.pose, use, self.limit, w)
        return result.only_if(self._rests(found), OUTCOMES.did_not_rest)

    def search(self, pair: Pair) -> RelativePose:
        return self._solve(pair).pose

    def _rests(self, found: State) -> Bool[Array, ""]:
        """Whether the pose came to rest; one that no five points hold only cannot
        move."""
        return (found.moved <= self.tolerance) & (count(found.share > HOLDS) >= 5)

    def _solve(self, pair: Pair) -> State:
        def more(state: State) -> Bool[Array, ""]:
            robust = state.steps > PLAIN + CONVEX
            moving = state.moved > self.tolerance
            return (state.steps < self.rounds) & (moving | ~robust)

        def step(state: State) -> State:
            steps, share = state.steps, state.share
            linear = linearise(pair, state.pose)
            s = normalised_residuals(linear, share) ** 2
            convex = steps < PLAIN + CONVEX
            new = jnp.where(convex, Huber().weight(s), self.function.weight(s))
            damped = steps >= PLAIN + CONVEX + FULL
            new = jnp.where(damped, (share + new) / 2, new)
            new = jnp.where(pair.mask, new, 0.0)
            share = jnp.where(steps < PLAIN, share, new)
            pose = take_step(state.pose, linear, linear.weight * share)
            return State(
                steps=steps + 1,
                moved=_distance(state.pose, pose),
                pose=pose,
                share=share,
            )

        zero = jnp.zeros_like(pair.focal_left)
        start = State(
            steps=zero.astype(int),
            moved=zero + jnp.inf,
            pose=self.start(pair).pose,  # pyright: ignore[reportArgumentType]
            share=pair.mask.astype(pair.sigma.dtype),
        )
        return while_loop(more, step, start, pair.focal_left)


def _distance(one: RelativePose, other: RelativePose) -> Float[Array, ""]:
    """The largest difference of a component of quaternion or base, which is at least
    half the angle between them."""
    difference = jax.tree.map(lambda a, b: jnp.abs(a - b), one, other)
    largest = one.qw * 0
    for component in jax.tree.leaves(difference):
        largest = jnp.maximum(largest, component)
    return largest
