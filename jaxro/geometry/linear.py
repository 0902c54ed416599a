"""The conditions of a pair linearised at a pose: what statistics of residuals are made
of."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import coplanarity
from .elements import RelativePose
from .pairs import Coordinates, Pair

Values = Float[Array, "point"]


class Linear(NamedTuple):
    """The conditions of the points at a pose: g, the columns of dg/dx by its five local
    parameters, the gradient B = dg/dl by the coordinates of a point, and the weights
    1/d, d = B Q Bᵀ (zero where masked)."""

    g: Values
    columns: list[Values]
    gradient: Coordinates
    weight: Values

    @property
    def squares(self) -> Values:
        """(r / sigma)² of the points."""
        return self.weight * self.g * self.g

    def corrections(self, pair: Pair) -> Coordinates:
        """v = -Q Bᵀ g / d of the coordinates, which bring the rays to intersection."""
        factor = -self.g * self.weight * pair.sigma**2
        return tuple(factor * b for b in self.gradient)


@jax.jit  # traced once for all who ask
def linearised(pair: Pair, pose: RelativePose) -> Linear:
    """The rigorous conditions of one pair at a pose, with its sigma; the pair is
    free of unusable points."""
    residuals = coplanarity.residuals(pair, pose)
    (g,), jacobian, weight = residuals.columns((jnp.zeros_like(pair.focal_left),) * 5)
    f = coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    of_point = jax.grad(coplanarity.condition, argnums=1)
    gradient = jax.vmap(lambda point: of_point(f, point))(pair.coordinates)
    used = lambda a: jnp.where(pair.mask, a, 0.0)
    columns = [used(column) for (column,) in jacobian]
    return Linear(used(g), columns, tuple(used(b) for b in gradient), weight[0])  # pyright: ignore[reportOptionalSubscript]
