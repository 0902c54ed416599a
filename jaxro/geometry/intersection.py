"""The model point of an oriented pair: where the rays of the corrected coordinates
meet."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import coplanarity, rotations as rot
from .elements import AbstractElements, RelativePose
from .pairs import Pair
from .rotations import Matrix, Vector

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
    """A function of the coordinates of a point, their standard deviation, whether it
    is used, and its `roots`: (X, Y, Z) in the frame of the chosen elements with a base of length
    `scale`; whether it lies in front of both photos; and whether behind one of them,
    though not infinitely far, nor so far that `noise` times its deviation could have
    put it there. Zero and False where it is not used."""
    rotation, base = pose.relative()
    focals = pair.focal_left, pair.focal_right
    f = coplanarity.fundamental_matrix(rotation, base, *focals)
    frame, right, placed = _in_frame(chosen, rotation, base, scale)

    def of_point(point, sigma, use, roots):
        v = coplanarity.corrections(f, point, use, roots)
        corrected = tuple(c + dv for c, dv in zip(point, v, strict=True))
        rays = coplanarity.directions(None, rotation, corrected, *focals)
        lam, mu, near = coplanarity.depths(*rays, base)
        uncertain = _is_uncertain(rays, near, noise * sigma)
        # of parallel rays by the side on which they would meet
        in_front = use & (lam > 0) & (mu > 0)
        lam, mu = lam * near, mu * near
        placed_rays = coplanarity.directions(frame, right, corrected, *focals)
        model = coplanarity.halfway(*placed_rays, placed, lam, mu)
        distances = jnp.abs(lam) * pair.focal_left, jnp.abs(mu) * pair.focal_right
        finite = use & (near > 0)
        near_enough = jnp.minimum(*distances) * AT_INFINITY < 1
        behind = finite & near_enough & ~uncertain & ~in_front
        keep = finite & jnp.isfinite(lam) & jnp.isfinite(mu)
        return tuple(jnp.where(keep, c, 0.0) for c in model), in_front, behind

    return of_point


def _in_frame(
    chosen: AbstractElements, rotation: Matrix, base: Vector, scale: Float[Array, ""]
) -> tuple[Matrix | None, Matrix, Vector]:
    """The rotations of left and right rays, and the base, in the model frame of the
    chosen elements and with its scale; None for the left photo's own frame."""
    if isinstance(chosen, RelativePose):
        return None, rotation, base
    x, y, z = (rot.scale(row, scale) for row in chosen.model_frame())
    frame = x, y, z
    return frame, rot.product(frame, rotation), rot.apply(frame, base)


def _is_uncertain(
    rays: tuple[Vector, Vector], near: Float[Array, ""], deviation: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the angle between two rays may as well have the other sign: it has the
    variance deviation² (1 / |r1|² + 1 / |r2|²)."""
    squares = sum(rot.dot(ray, ray) for ray in rays)
    return (SIGNIFICANT * deviation) ** 2 * squares * near > 1
