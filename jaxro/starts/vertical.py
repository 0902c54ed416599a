"""Zero elements: parallel photo axes, base along x."""

import jax.numpy as jnp

from ..elements import vertical
from ..pairs import Pair
from .base import AbstractStart, Begin


class Vertical(AbstractStart):
    """The normal case of aerial photography. Gauss-Newton reaches the solution from rotations of up to about 20°."""

    def __call__(self, pair: Pair) -> Begin:
        no = jnp.zeros_like(pair.focal_left, bool)
        return Begin(vertical(pair.focal_left), no, no)
