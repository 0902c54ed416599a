"""Correlations of the normalised residuals w: which points an adjustment can tell
apart.

The whitened residuals of a pair are r = (I - H) e, with errors e of standard deviation
1 and the projection H on the five columns of the design. With the redundancy numbers
1 - h_ii

    w_i = r_i / sqrt(1 - h_ii),    rho_ij = -h_ij / sqrt((1 - h_ii) (1 - h_jj))    (Förstner 1983)

An error that moves w_i by delta moves w_j by rho_ij delta. If |rho| is near 1, nothing
tells whether the error is in i or in j. With one degree of freedom every |rho| is 1.
All n² correlations follow from five numbers a point.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..adjustment.critical_values import UNTESTABLE
from ..adjustment.normal_equations import cholesky
from ..geometry.linear import Linear, Values


class Normalised(NamedTuple):
    """The normalised residuals `w` of the points in use, for sigma0 = 1, with the sign
    of g.

    `basis`: five orthonormal columns that span those of the design, each entry divided
    by the root of the redundancy number of its point, so that rho_ij = -b_i · b_j.
    `tested`: the points in use that others check; w and basis are zero at all other
    points. `squares`: Σ r² of the points in use. `freedom`: their number less five, at
    least zero.
    """

    w: Values
    basis: Float[Array, "point 5"]
    redundancy: Values
    tested: Bool[Array, "point"]
    squares: Float[Array, ""]
    freedom: Float[Array, ""]

    def row(self, point: Int[Array, ""]) -> Values:
        """Correlations of the w of one point with the w of all points: 1 with its own,
        0 where a point is not tested."""
        own = jnp.arange(self.w.shape[0]) == point
        chosen = jnp.sum(jnp.where(own[:, None], self.basis, 0.0), axis=0)
        between = -jnp.sum(self.basis * chosen[None, :], axis=1)
        alone = jnp.where(self.tested, 1.0, 0.0)
        return jnp.where(own, alone, jnp.clip(between, -1.0, 1.0))

    def matrix(self) -> Float[Array, "point point"]:
        """All correlations."""
        between = -jnp.sum(self.basis[:, None, :] * self.basis[None, :, :], axis=-1)
        own = jnp.eye(self.w.shape[0], dtype=bool)
        alone = jnp.where(self.tested, 1.0, 0.0)[:, None]
        return jnp.where(own, alone, jnp.clip(between, -1.0, 1.0))


def normalise(linear: Linear, use: Bool[Array, "point"]) -> Normalised:
    """The normalised residuals of conditions that are linearised at the solution of the
    points in use; no point in use is masked."""
    spanned, squares = orthonormal_columns(linear, use)
    redundancy = jnp.where(use, 1 - sum(q * q for q in spanned), 0.0)
    tested = use & (redundancy > UNTESTABLE)
    root = jnp.sqrt(jnp.where(tested, redundancy, 1.0))
    scale = lambda values: jnp.where(tested, values / root, 0.0)
    residuals = linear.g * jnp.sqrt(jnp.where(use, linear.weight, 0.0))
    basis = jnp.stack([scale(q) for q in spanned], axis=-1)
    points = jnp.sum(use.astype(basis.dtype))
    return Normalised(
        w=scale(residuals),
        basis=basis,
        redundancy=redundancy,
        tested=tested,
        squares=squares,
        freedom=jnp.maximum(points - 5, 0.0),
    )


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
