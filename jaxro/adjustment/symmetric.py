"""Inverses of symmetric matrices of hundreds of rows, in plain JAX.

LAPACK called from two threads at once can wait for itself for ever, and `jnp.linalg`
calls it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

BLOCK = 32
"""Rows that are swept together: the rest of the matrix is then changed by one product
of matrices."""


class Inverse(NamedTuple):
    """The inverse of a positive definite matrix, and the relative pivot of each row:
    the part of its diagonal that the rows before it leave. Where one is near zero the
    matrix is singular, and the inverse large but finite."""

    matrix: Float[Array, "p p"]
    pivots: Float[Array, " p"]


def inverse(matrix: Float[Array, "p p"]) -> Inverse:
    """The inverse of a positive definite matrix by sweeps (Goodnight 1979), its
    diagonal scaled to 1 before."""
    diagonal = jnp.diagonal(matrix)
    scale = lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    rows = matrix.shape[0]
    size = min(BLOCK, rows)
    missing = -rows % size
    scaled = matrix * scale[:, None] * scale[None, :]
    scaled = jnp.pad(scaled, (0, missing)) + jnp.diag(
        jnp.where(jnp.arange(rows + missing) >= rows, 1.0, 0.0)
    )
    ones = jnp.ones(rows + missing, matrix.dtype)

    def sweep(k, state):
        """Rows and columns of one block exchanged: [[A, B], [Bᵀ, C]] to [[-A⁻¹, A⁻¹ B],
        [Bᵀ A⁻¹, C - Bᵀ A⁻¹ B]]."""
        whole, pivots = state
        begin = k * size
        rows_of_block = lax.dynamic_slice(whole, (begin, 0), (size, whole.shape[1]))
        own = lax.dynamic_slice(rows_of_block, (0, begin), (size, size))
        inverted, left = _small_inverse(own)
        solved = inverted @ rows_of_block
        rest = whole - rows_of_block.T @ solved
        rest = lax.dynamic_update_slice(rest, solved, (begin, 0))
        rest = lax.dynamic_update_slice(rest, solved.T, (0, begin))
        rest = lax.dynamic_update_slice(rest, -inverted, (begin, begin))
        return rest, lax.dynamic_update_slice(pivots, left, (begin,))

    swept, pivots = lax.fori_loop(0, scaled.shape[0] // size, sweep, (scaled, ones))
    return Inverse(
        -swept[:rows, :rows] * scale[:, None] * scale[None, :], pivots[:rows]
    )


def _small_inverse(matrix: Float[Array, "b b"]) -> Inverse:
    """The same of one block of a matrix with a diagonal of 1, row after row."""
    floor = jnp.finfo(matrix.dtype).eps

    def sweep(k, state):
        whole, pivots = state
        left = whole[k, k]
        row = whole[k] / jnp.maximum(left, floor)
        rest = whole - whole[:, k][:, None] * row[None, :]
        rest = (
            rest.at[k]
            .set(row)
            .at[:, k]
            .set(row)
            .at[k, k]
            .set(-1 / jnp.maximum(left, floor))
        )
        return rest, pivots.at[k].set(left)

    swept, pivots = lax.fori_loop(
        0, matrix.shape[0], sweep, (matrix, jnp.ones_like(matrix[0]))
    )
    return Inverse(-swept, pivots)
