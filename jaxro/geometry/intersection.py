"""The model point of an oriented pair: where the rays of the corrected coordinates
meet."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import coplanarity, rotations as rot
from .elements import AbstractElements, RelativePose
from .pairs import Pair

AT_INFINITY = 1e-3
"""Base over distance below which a point counts as infinitely far, so that the sign of
its depth says nothing."""

SIGNIFICANT = 4.0
"""Standard deviations of the angle between two rays up to which they may as well meet
on the other side."""


def model_point(
    pair: Pair,
    pose: RelativePose,
    chosen: AbstractElements,
    scale: Float[Array, ""],
    noise: Float[Array, ""],
) -> Callable:
    """A function of the coordinates of a point, their standard deviation and whether it
    is used: (X, Y, Z) in the frame of the chosen elements with a base of length
    `scale`; whether it lies in front of both photos; and whether behind one of them,
    though not infinitely far, nor so far that `noise` times its deviation could have
    put it there. Zero and False where it is not used."""
    rotation, base = pose.relative()
    focals = pair.focal_left, pair.focal_right
    f = coplanarity.fundamental_matrix(rotation, base, *focals)

    frame, right, placed = None, rotation, base
    if not isinstance(chosen, RelativePose):
        x, y, z = chosen.model_frame()
        frame = rot.scale(x, scale), rot.scale(y, scale), rot.scale(z, scale)
        right, placed = rot.product(frame, rotation), rot.apply(frame, base)

    def one(point, sigma, use):
        x1, y1, x2, y2 = (
            c + dv
            for c, dv in zip(point, coplanarity.corrections(f, point, use), strict=True)
        )
        corrected = x1, y1, x2, y2
        rays = coplanarity.directions(None, rotation, corrected, *focals)
        lam, mu, near = coplanarity.depths(*rays, base)
        # the angle between the rays has the variance sigma² (1 / |r1|² + 1 / |r2|²)
        uncertain = (SIGNIFICANT * noise * sigma) ** 2 * sum(
            rot.dot(ray, ray) for ray in rays
        ) * near > 1
        # of parallel rays by the side on which they would meet
        in_front = use & (lam > 0) & (mu > 0)
        lam, mu = lam * near, mu * near
        model = coplanarity.halfway(
            *coplanarity.directions(frame, right, corrected, *focals), placed, lam, mu
        )
        least = jnp.minimum(
            jnp.abs(lam) * pair.focal_left, jnp.abs(mu) * pair.focal_right
        )
        finite = use & (near > 0)
        keep = finite & jnp.isfinite(lam) & jnp.isfinite(mu)
        behind = finite & (least * AT_INFINITY < 1) & ~uncertain & ~in_front
        return tuple(jnp.where(keep, c, 0.0) for c in model), in_front, behind

    return one
