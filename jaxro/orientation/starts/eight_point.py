"""The linear start: the E that minimises the weighted sum of squares of p1ᵀ E p2, |E| =
1, from eight or more points.

Hartley 1997, In defense of the eight-point algorithm: each photo's coordinates are
first centred and scaled. The nine entries of E are the eigenvector of the smallest
eigenvalue of the 9x9 matrix of sums; it is the column to which the powers of the
inverse tend, so no eigenvalue routine is needed. Eight points have their one E exactly,
at right angles to the eight rows. Points in one plane do not determine E this way.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ...adjustment.null_space import null_space
from .problems_last import problems_last

TINY = 1e-300
SHIFT = 1e-15
SQUARINGS = 6


def eight_point(
    left: Float[Array, "point 3"],
    right: Float[Array, "point 3"],
    weights: Float[Array, "point"],
) -> Float[Array, "3 3"]:
    """E with p1ᵀ E p2 = 0 as well as the points allow; p = (x/f, y/f, -1), weight 0
    leaves a point out.

    Of full rank where the coordinates are measured: `decomposition` finds the
    orientation nearest to it.
    """
    return (_exact if len(left) == 8 else _overdetermined)(left, right, weights)


def _solve(
    left: Float[Array, "point 3 problem"], right, weights: Float[Array, "point problem"]
):
    weights = weights / jnp.maximum(jnp.sum(weights, axis=0, keepdims=True), TINY)
    first, second = _conditioning(left, weights), _conditioning(right, weights)
    p1, p2 = (
        jnp.sum(t[None] * p[:, None], axis=2)
        for t, p in ((first, left), (second, right))
    )
    rows = (p1[:, :, None] * p2[:, None]).reshape(len(left), 9, -1)
    sums = jnp.sum((weights[:, None] * rows)[:, :, None] * rows[:, None], axis=0)
    e = _smallest_eigenvector(sums).reshape(3, 3, -1)
    e = jnp.sum(first[:, :, None] * e[:, None], axis=0)
    e = jnp.sum(e[:, :, None] * second[None], axis=1)
    return e / jnp.sqrt(jnp.maximum(jnp.sum(e * e, axis=(0, 1), keepdims=True), TINY))


def _conditioning(
    p: Float[Array, "point 3 problem"], weights: Float[Array, "point problem"]
):
    """T that takes (x, y, -1) to the centre of the points and their mean square
    distance from it to 2."""
    x, y = (jnp.sum(weights * p[:, k], axis=0) for k in (0, 1))
    spread = jnp.sum(
        weights * ((p[:, 0] - x[None]) ** 2 + (p[:, 1] - y[None]) ** 2), axis=0
    )
    s = jnp.sqrt(2 / jnp.where(spread > 1e-30, spread, 2.0))
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    return jnp.stack(
        [
            jnp.stack([s, zero, s * x]),
            jnp.stack([zero, s, s * y]),
            jnp.stack([zero, zero, one]),
        ]
    )


def _solve_eight(
    left: Float[Array, "8 3 problem"], right, weights: Float[Array, "8 problem"]
):
    rows = (left[:, :, None] * right[:, None]).reshape(8, 9, -1)
    return null_space(rows * weights[:, None]).reshape(3, 3, -1)


_exact, _overdetermined = problems_last(_solve_eight), problems_last(_solve)


def _smallest_eigenvector(m: Float[Array, "9 9 problem"]) -> Float[Array, "9 problem"]:
    identity = jnp.eye(9, dtype=m.dtype)[:, :, None]

    def sweep(k, a):
        """Gauss-Jordan in place: after all nine sweeps -a⁻¹; u = column - e makes one
        rank-one step of it."""
        e = (jnp.arange(9) == k).astype(a.dtype)[:, None]
        column = jnp.sum(a * e[None], axis=1)
        pivot = jnp.maximum(jnp.sum(column * e, axis=0), SHIFT / 10)
        u = column - e
        return a - u[:, None] * u[None] / pivot[None, None] - 2 * e[:, None] * e[None]

    def squared(_, a):
        a = jnp.sum(a[:, :, None] * a[None], axis=1)
        return a / jnp.max(jnp.abs(a), axis=(0, 1), keepdims=True)

    trace = jnp.maximum(jnp.sum(m * identity, axis=(0, 1), keepdims=True), TINY)
    power = lax.fori_loop(0, 9, sweep, m / trace + SHIFT * identity)
    power = lax.fori_loop(
        0,
        SQUARINGS,
        squared,
        power / jnp.max(jnp.abs(power), axis=(0, 1), keepdims=True),
    )
    size = jnp.sum(power * power, axis=1)
    longest = size >= jnp.max(size, axis=0, keepdims=True)
    first = longest & (jnp.cumsum(longest, axis=0) == 1)
    return jnp.sum(jnp.where(first[None], power, 0.0), axis=1)
