"""Correlations of the normalised residuals w: which points an adjustment can tell
apart.

The whitened residuals of a pair are r = (I - H) e, e of standard deviation 1 and H the
projection on the five columns of the design. With the redundancy numbers 1 - h_ii

    w_i = r_i / sqrt(1 - h_ii),    rho_ij = -h_ij / sqrt((1 - h_ii) (1 - h_jj))    (Förstner 1983)

An error that moves w_i by delta moves w_j by rho_ij delta: near |rho| = 1 nothing tells
whether the error is in i or in j. With one degree of freedom every |rho| is 1. All n²
correlations follow from five numbers a point, so that one row costs as much as one
residual.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..adjustment.normal_equations import accumulate, cholesky
from ..geometry.linear import Linear, Values

UNTESTABLE = 1e-6
"""Redundancy number below which a point is not checked by the others."""


class Normalised(NamedTuple):
    """The normalised residuals of the points in use, by sigma0 = 1, with the sign of g.

    `basis`: five orthonormal columns that span those of the design, each entry over
    sqrt(redundancy) of its point, so that rho_ij = -b_i · b_j. `tested`: the points in
    use that others check; w and basis are zero at all other points. `squares`: Σ r² of
    the points in use. `freedom`: their number less five, at least zero.
    """

    w: Values
    basis: Float[Array, "point 5"]
    redundancy: Values
    tested: Bool[Array, "point"]
    squares: Float[Array, ""]
    freedom: Float[Array, ""]

    def row(self, point: Int[Array, ""]) -> Values:
        """Correlations of the w of one point with those of all; 1 with its own, 0 where
        a point is not tested."""
        own = jnp.arange(self.w.shape[0]) == point
        chosen = jnp.sum(jnp.where(own[:, None], self.basis, 0.0), axis=0)
        between = -jnp.sum(self.basis * chosen[None, :], axis=1)
        return jnp.where(
            own, jnp.where(self.tested, 1.0, 0.0), jnp.clip(between, -1.0, 1.0)
        )

    def matrix(self) -> Float[Array, "point point"]:
        """All correlations."""
        products = -jnp.sum(self.basis[:, None, :] * self.basis[None, :, :], axis=-1)
        own = jnp.eye(self.w.shape[0], dtype=bool)
        return jnp.where(
            own,
            jnp.where(self.tested, 1.0, 0.0)[:, None],
            jnp.clip(products, -1.0, 1.0),
        )


def normalised(linear: Linear, use: Bool[Array, "point"]) -> Normalised:
    """Of the conditions linearised at the solution of the points in use, which are not
    masked."""
    weight = jnp.where(use, linear.weight, 0.0)
    spanned, squares = orthonormal(linear, use)
    redundancy = jnp.where(use, 1 - sum(q * q for q in spanned), 0.0)
    tested = use & (redundancy > UNTESTABLE)
    root = jnp.sqrt(jnp.where(tested, redundancy, 1.0))
    of_tested = lambda values: jnp.where(tested, values / root, 0.0)
    basis = jnp.stack([of_tested(q) for q in spanned], axis=-1)
    points = jnp.sum(use.astype(basis.dtype))
    freedom = jnp.maximum(points - 5, 0.0)
    return Normalised(
        w=of_tested(linear.g * jnp.sqrt(weight)),
        basis=basis,
        redundancy=redundancy,
        tested=tested,
        squares=squares,
        freedom=freedom,
    )


def orthonormal(
    linear: Linear, use: Bool[Array, "point"]
) -> tuple[list[Values], Float[Array, ""]]:
    """q = L⁻¹ aᵀ of every point, a its whitened row of the design and N = L Lᵀ of the
    points in use, and their Σ r².

    h_ij = q_i · q_j; over the points in use the five columns are orthonormal.
    """
    n, _, squares = accumulate(
        [linear.g], [[c] for c in linear.columns], [jnp.where(use, linear.weight, 0.0)]
    )
    factor, _ = cholesky(n)  # with the inverses of the diagonal in its place
    whitened = [column * jnp.sqrt(linear.weight) for column in linear.columns]
    spanned: list[Values] = []
    for i, row in enumerate(factor):
        rest = whitened[i]
        for k in range(i):
            rest = rest - row[k] * spanned[k]
        spanned.append(rest * row[i])
    return spanned, squares
