"""The model points of an oriented pair: where the rays of the corrected coordinates meet."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import coplanarity, rotations as rot
from .elements import AbstractElements, RelativePose
from .pairs import Pair
from .programs import part

Points = tuple[Float[Array, " point"], Float[Array, " point"], Float[Array, " point"]]
Flags = Bool[Array, " point"]

AT_INFINITY = 1e-3
"""Base over distance below which a point counts as infinitely far, so that the sign of its depth says nothing."""


def model_points(
    pair: Pair, pose: RelativePose, chosen: AbstractElements, scale: Float[Array, ""]
) -> tuple[Points, Flags, Flags]:
    """(X, Y, Z) in the frame of the chosen elements with a base of length `scale`, which points lie in front of both
    photos, and which are infinitely far; zero and False where masked."""
    rotation, base = pose.relative()
    focals = pair.focal_left, pair.focal_right
    f = coplanarity.fundamental_matrix(rotation, base, *focals)

    def met(point, use):
        corrected = tuple(c + dv for c, dv in zip(point, coplanarity.corrections(f, point, use), strict=True))
        return corrected, *coplanarity.depths(*coplanarity.directions(None, rotation, corrected, *focals), base)

    frame, right, placed = None, rotation, base
    if not isinstance(chosen, RelativePose):
        x, y, z = chosen.model_frame()
        frame = rot.scaled(x, scale), rot.scaled(y, scale), rot.scaled(z, scale)
        right, placed = rot.product(frame, rotation), rot.apply(frame, base)

    def one(corrected, lam, mu, near, use):
        in_front = use & (lam > 0) & (mu > 0)  # of parallel rays by the side on which they would meet
        lam, mu = lam * near, mu * near
        model = coplanarity.halfway(*coplanarity.directions(frame, right, corrected, *focals), placed, lam, mu)
        least = jnp.minimum(jnp.abs(lam) * pair.focal_left, jnp.abs(mu) * pair.focal_right)
        finite = use & (near > 0)
        keep = finite & jnp.isfinite(lam) & jnp.isfinite(mu)
        return tuple(jnp.where(keep, c, 0.0) for c in model), in_front, use & ~(finite & (least * AT_INFINITY < 1))

    # inside a kernel a `part` makes XLA compute the depths once; outside, it is quicker to compute them for each result
    return jax.vmap(one)(*part(jax.vmap(met))(pair.coordinates, pair.mask), pair.mask)
