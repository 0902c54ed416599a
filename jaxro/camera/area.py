"""The area of an image in which something was measured."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..xla.passes import count

Places = Float[Array, "point 2"]
Pair = Float[Array, "2"]

NODES = 15
"""Nodes along each side of the area where something is summed over it."""


class Area(eqx.Module):
    """The measured area in the units of the frame: the points used, its half sides
    along x and y, the centroid of the points and the principal place as far as it is
    known."""

    u: Places
    mask: Bool[Array, " point"]
    half_sides: Pair
    principal: Pair

    @property
    def grid(self) -> Places:
        """Nodes over the whole area."""
        axis = np.linspace(-1.0, 1.0, NODES)
        square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        return jnp.asarray(square) * self.half_sides[None]

    @property
    def centroid(self) -> Pair:
        """The centroid of the measured points."""
        return jnp.sum(self.u, axis=0) / jnp.maximum(count(self.mask), 1.0)
