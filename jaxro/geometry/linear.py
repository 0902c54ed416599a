"""The coplanarity conditions of a pair, linearised at given elements.

For the condition g of a point with the coordinates l, and the local parameters x of the
elements:

    a = √d ∂(g / √d) / ∂x,    B = ∂g / ∂l,    d = B Q Bᵀ,

d being the variance of g for sigma0 = 1. g / √d is the whitened residual, a / √d its
row of the design. All statistics of residuals start from these numbers; this is the
only place that computes them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..adjustment.normal_equations import Lower, accumulate
from . import coplanarity
from .cofactor_roots import CofactorRoots
from .elements import AbstractElements
from .pairs import Coordinates, Pair

Values = Float[Array, "point"]


class Linear(NamedTuple):
    """The linearised conditions of all points: `g`, the five `columns` of a, the
    `gradient` B, and the `weight` 1 / d. All are zero where a point is masked. `roots`:
    those of the pair."""

    g: Values
    columns: list[Values]
    gradient: Coordinates
    weight: Values
    roots: CofactorRoots | None = None

    @property
    def lever(self) -> Coordinates:
        """Q Bᵀ / sigma²: B itself where the coordinates of a point are equally
        accurate."""
        if self.roots is None:
            return self.gradient
        return self.roots.displace(self.roots.pull(self.gradient))

    @property
    def squares(self) -> Values:
        """(r / sigma)², the squared whitened residuals."""
        return self.weight * self.g * self.g

    def corrections(self, pair: Pair) -> Coordinates:
        """v = -Q Bᵀ g / d: corrections of the coordinates with which the rays
        intersect."""
        factor = -self.g * self.weight * pair.sigma**2
        return tuple(factor * entry for entry in self.lever)

    def times(self, x: Sequence[Any]) -> Values:
        """A x of every point: the change of g by these local parameters, which may
        differ from point to point."""
        return sum(a * e for a, e in zip(self.columns, x, strict=True))  # pyright: ignore[reportReturnType]

    def normal_equations(
        self, weight: Values | None = None
    ) -> tuple[Lower, list[Array], Array]:
        """Σ w aᵀ a (its lower triangle), Σ w a g and Σ w g² with the weights w, those
        of the conditions if None."""
        weight = self.weight if weight is None else weight
        columns = [[column] for column in self.columns]
        n, right, squares = accumulate([self.g], columns, [weight])
        return n, right, squares


@jax.jit  # traced once for all callers
def linearise(pair: Pair, elements: AbstractElements) -> Linear:
    """The rigorous conditions of one pair without unusable points at these elements,
    with its sigma.

    Works under jit, vmap and grad.
    """
    residuals = coplanarity.residuals(pair, elements)
    f, slopes = residuals.slopes()
    of_points = jax.vmap(residuals.linearise(f, slopes))
    (g,), jacobian, weight = of_points(*residuals.of_groups)
    by_coordinates = jax.grad(coplanarity.condition, argnums=1)
    gradient = jax.vmap(lambda point: by_coordinates(f, point))(pair.coordinates)
    used = lambda values: jnp.where(pair.mask, values, 0.0)
    return Linear(
        g=used(g),
        columns=[used(column) for (column,) in jacobian],
        gradient=tuple(used(b) for b in gradient),
        weight=weight[0],
        roots=pair.roots,
    )


def namespace(values: Any) -> Any:
    """NumPy if `values` is an array of NumPy, else jax.numpy.

    Reports evaluate formulas by NumPy, which has nothing to compile.
    """
    return np if isinstance(values, np.ndarray) else jnp
