"""Near-vertical photos go straight to Gauss-Newton, everything else through the general
start."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, ScalarLike

from ...geometry.elements import RelativePose
from ...geometry.pairs import Pair
from ...xla.kernels import while_loop
from ..inspection import Inspection, inspect
from .base import AbstractStart, StartingPose, approach
from .general import General


class Auto(AbstractStart):
    """A few Gauss-Newton steps from the vertical; where they fit, that is the start,
    elsewhere `general`.

    "Fit" means: rotation and base within `tilt` (rad) of the normal case and a root
    mean square distance below `tolerance` times the focal length, far above any
    measuring error and far below what a wrong orientation leaves. In photos of a narrow
    angle it leaves less: there it is `tolerance` times twice the `spread` of the
    points. Of the two solutions of an exactly plane scene this takes the one near the
    normal case without mention; pass `General()` where photos in other positions look
    at a plane. `steps` count inside a caller's `jit`, where the solution ends when the
    next step would be below 1e-10 instead of 1e-12; alone and in batches all steps from
    the vertical are taken before it is asked whether they fit.
    """

    general: AbstractStart = General()
    steps: int = 2
    tilt: ScalarLike = 0.35
    tolerance: ScalarLike = 1e-3

    def fits(self, pose: RelativePose, inspected: Inspection) -> Bool[Array, ""]:
        """Whether a pose reached from the vertical is near it and explains the points;
        the base may point backwards."""
        longest = 2 * jnp.maximum(
            jnp.maximum(jnp.abs(pose.qx), jnp.abs(pose.qy)), jnp.abs(pose.qz)
        )
        longest = jnp.maximum(longest, jnp.maximum(jnp.abs(pose.by), jnp.abs(pose.bz)))
        return (longest < self.tilt) & (
            inspected.distance < self.tolerance * jnp.minimum(1.0, 2 * inspected.spread)
        )

    def __call__(self, pair: Pair) -> StartingPose:
        near = approach(pair, self.steps)
        fits = self.fits(near, inspect(pair, near))

        # A loop of at most one round: under vmap it is entered only if some pair of the
        # batch needs it, where a `cond` would be turned into a `select` and always
        # compute the general start of every pair. The points depend on the round,
        # without which XLA would compute the general start before the loop, needed or
        # not.
        def needed(state):
            return state[0]

        def general(state) -> tuple[Array, StartingPose]:
            pick = lambda new, old: jnp.where(state[0], new, old)
            with jax.named_scope("general"):
                found = self.general(pair.with_mask(pair.mask & state[0]))
            return jnp.zeros_like(state[0]), jax.tree.map(pick, found, state[1])

        no = jnp.zeros_like(fits)
        return while_loop(
            needed, general, (~fits, StartingPose(near, no, no)), pair.focal_left
        )[1]
