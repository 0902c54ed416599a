"""The normalised residuals of a pair, of which `statistics` makes tests: five
parameters, one row a point, with the sign of g."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import cholesky
from ..geometry.linear import Linear, Values
from ..statistics import normalised
from ..statistics.normalised import Normalised


def normalise(linear: Linear, use: Bool[Array, "point"]) -> Normalised:
    """The normalised residuals of conditions that are linearised at the solution of the
    points in use; no point in use is masked."""
    spanned, squares = orthonormal_columns(linear, use)
    residuals = linear.g * jnp.sqrt(jnp.where(use, linear.weight, 0.0))
    return normalised.normalise(residuals, spanned, use, squares)


def orthonormal_columns(
    linear: Linear, use: Bool[Array, "point"]
) -> tuple[list[Values], Float[Array, ""]]:
    """q = L⁻¹ aᵀ of every point, and Σ r² of the points in use; a is the whitened row
    of a point in the design, and L Lᵀ = N the normal matrix of the points in use.

    h_ij = q_i · q_j; over the points in use the five columns are orthonormal.
    """
    weight = jnp.where(use, linear.weight, 0.0)
    n, _, squares = linear.normal_equations(weight)
    factor, _ = cholesky(n)  # the diagonal holds its inverses
    root = jnp.sqrt(linear.weight)
    whitened = [column * root for column in linear.columns]
    spanned: list[Values] = []
    for i, row in enumerate(factor):
        rest = whitened[i]
        for k in range(i):
            rest = rest - row[k] * spanned[k]
        spanned.append(rest * row[i])
    return spanned, squares
