"""Which matches are likely right by their neighbours alone: right matches that lie near
each other in one photo lie near each other in the other one.

    agreement of a point = Σ near(left) near(right) / Σ near(left)

over other points, near(d²) = 1 / (1 + d² / c²)², c = CLOSE mean distances.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

ENOUGH = 40
"""Points from which their neighbours say something."""

NEIGHBOURS = 1024
"""Points that are looked at as neighbours, at most."""

CLOSE = 1.5
"""Distance of a neighbour in units of the mean distance between points."""


def order_by_neighbours(
    rows: Float[Array, "point 4"], of: Float[Array, ""]
) -> Int[Array, "point"]:
    """The places of the points, those first whose neighbours in the left photo are
    their neighbours in the right one; `rows`: x and y in both photos, of which the
    first `of` exist."""
    step = -(-len(rows) // NEIGHBOURS)
    points = rows.astype(jnp.float32)
    there = jnp.arange(len(rows), dtype=of.dtype) < of
    use = there.astype(jnp.float32)
    # one array for each coordinate, so that the compiler works on many points at once
    others, taken = points[::step].T, use[::step]
    some = jnp.maximum(jnp.sum(taken), 1.0)
    near_left = CLOSE**2 * _spread(points[:, :2], use) / some
    near_right = CLOSE**2 * _spread(points[:, 2:], use) / some

    def agreement(point):
        x, y, u, v = ((a - b) ** 2 for a, b in zip(others, point, strict=True))
        left, right = 1 + (x + y) / near_left, 1 + (u + v) / near_right
        near = taken / (left * left)
        both = near / (right * right)
        neighbours = jnp.maximum(jnp.sum(near), 1e-6)
        return jnp.sum(both) / neighbours

    agreements = jax.vmap(agreement)(points)
    agreements = jnp.where(there, agreements, -1.0)
    return jnp.argsort(-agreements)


def _spread(
    points: Float[Array, "point 2"], use: Float[Array, "point"]
) -> Float[Array, ""]:
    """About the area over which the points in use are spread in one photo."""
    x, y = points.T
    n = jnp.maximum(jnp.sum(use), 1.0)
    mean = lambda a: jnp.sum(a * use) / n
    square = mean(x * x) - mean(x) ** 2 + mean(y * y) - mean(y) ** 2
    return 4 * jnp.maximum(square, 1e-12)
