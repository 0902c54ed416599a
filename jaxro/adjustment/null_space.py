"""Vectors at right angles to a few rows, by Householder reflections (Golub and Van
Loan, Matrix Computations, 5.2).

Arrays carry the problems on their last axis. Nothing is squared, so that nothing of the
precision is lost; rows that depend on others give more vectors than are returned, of
which these are some.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

TINY = 1e-300


def null_space(
    rows: Float[Array, "row column problem"],
) -> Float[Array, "rest column problem"]:
    """Orthonormal vectors at right angles to the rows, as many as columns are more: the
    last of Q in rowsᵀ = Q R."""
    count, size, _ = rows.shape
    m, reflectors = jnp.swapaxes(rows, 0, 1), []
    for _ in range(count):
        reflectors.append(reflector(m[:, 0]))
        m = reflected(reflectors[-1], m)[1:, 1:]
    basis = jnp.broadcast_to(
        jnp.eye(size - count, dtype=rows.dtype)[:, :, None],
        (size - count,) * 2 + rows.shape[2:],
    )
    for v in reversed(reflectors):
        basis = reflected(v, jnp.pad(basis, ((1, 0), (0, 0), (0, 0))))
    return jnp.swapaxes(basis, 0, 1)


def reflector(x: Float[Array, "n problem"]) -> Float[Array, "n problem"]:
    """The Householder vector v that turns x onto its first axis, scaled so that H = I -
    v vᵀ."""
    length = jnp.sqrt(jnp.sum(x * x, axis=0))
    first = x[0] + jnp.where(x[0] < 0, -length, length)
    scale = lax.rsqrt(jnp.maximum(length * jnp.abs(first), TINY))
    return jnp.concatenate([first[None], x[1:]]) * scale[None]


def reflected(
    v: Float[Array, "n problem"], m: Float[Array, "n k problem"]
) -> Float[Array, "n k problem"]:
    """H m."""
    return m - v[:, None] * jnp.sum(v[:, None] * m, axis=0)[None]
