"""Zero elements: parallel photo axes, base along x."""

import jax.numpy as jnp

from ...geometry.pairs import Pair
from .base import AbstractStart, StartingPose, approach


class Vertical(AbstractStart):
    """The normal case of aerial photography, and `steps` Gauss-Newton steps from it.

    The first step is by first-order equations.
    Gauss-Newton reaches the solution from rotations of up to about 20°. With `steps`
    zero the elements begin at zero.
    """

    steps: int = 2

    def __call__(self, pair: Pair) -> StartingPose:
        no = jnp.zeros_like(pair.focal_left, bool)
        return StartingPose(approach(pair, self.steps), no, no)
