"""The points of a pair that lie in one plane, whatever its pose.

A pose that a wrong point has pulled to itself shows the points of a plane away from it.
So the plane is found without a pose: points of a plane are seen in the right photo
through a homography, which four of them determine. With the left and right image
vectors p, q of four points and

    r1 = p2 x p3,  s1 = q2 x q3  (and in turns),

it takes a vector p to

    Σ q_i (s_i · q4) / (r_i · p4) (r_i · p).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..geometry import rotations as rot
from ..geometry.pairs import Pair
from ..orientation.starts.general import vectors
from ..xla.passes import count
from .masked import Use
from .subsets import choose_places, draw, move_up

SUBSETS = 32
"""Homographies of four points that are compared."""

WIDE = 2.0
"""Multiple of the limit up to which a homography of four points, which carries their
errors, explains a point."""

TINY = 1e-12
"""Of products of three unit vectors: below it they lie in one plane."""


def points_in_plane(pair: Pair, use: Use, limit: Float[Array, ""]) -> Use:
    """Of the points in use those that the homography of four of them explains, of
    that which explains most. `limit`: in standard deviations of a coordinate."""
    own = pair.with_mask(use)
    left, right = (move_up(own, rays).T for rays in vectors(pair))
    places = choose_places(draw(4, SUBSETS, SUBSETS, seed=0)[0], count(use))
    square = (WIDE * limit) ** 2

    def explain(four: Array) -> Use:
        corners = [tuple(rays[:, place] for place in four) for rays in (left, right)]
        return use & (_transfer_errors(pair, *corners) <= square)

    explained = jax.vmap(explain)(places.T)
    return explained[jnp.argmax(jax.vmap(count)(explained))]


def _transfer_errors(
    pair: Pair, left: Sequence[Array], right: Sequence[Array]
) -> Float[Array, "point"]:
    """The squared distance of every point from where the homography of four points
    takes it, over 2 sigma²; infinite where they have none."""
    before, after = (_dual(corners) for corners in (left, right))
    share = [
        rot.dot(s, tuple(right[3])) / _safe(rot.dot(r, tuple(left[3])))
        for r, s in zip(before, after, strict=True)
    ]
    first, second, third = (tuple(corner) for corner in right[:3])
    to_right = rot.transpose((first, second, third))

    def of_point(x1, y1, x2, y2, sigma):
        p = x1 / pair.focal_left, y1 / pair.focal_left, -jnp.ones_like(x1)
        u, v, w = (k * rot.dot(r, p) for k, r in zip(share, before, strict=True))
        across, along, away = rot.apply(to_right, (u, v, w))
        dx, dy = (-pair.focal_right * v / _safe(away) for v in (across, along))
        square = ((dx - x2) ** 2 + (dy - y2) ** 2) / (2 * sigma**2)
        return jnp.where(jnp.isfinite(square), square, jnp.inf)

    return jax.vmap(of_point)(*pair.coordinates, pair.sigma)


def _dual(corners: Sequence[Array]) -> list[rot.Vector]:
    """The products of two of the first three vectors each."""
    a, b, c = (tuple(corner) for corner in corners[:3])
    return [rot.cross(b, c), rot.cross(c, a), rot.cross(a, b)]


def _safe(value: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(jnp.abs(value) > TINY, value, jnp.nan)
