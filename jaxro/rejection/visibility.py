"""Which points can be seen from both photos of a pose."""

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.passes import count
from .masked import Use


def seen(pair: Pair, pose: RelativePose, limit: ArrayLike) -> Use:
    """The points in front of both photos, and those whose rays are so nearly parallel
    that the sign of their depth says nothing."""
    return in_front(pair, pose) | parallel(pair, pose, limit)


def in_front(pair: Pair, pose: RelativePose) -> Use:
    """The points in front of both photos, with the sign of the base that puts most
    points there."""
    rotation, base = pose.relative()

    def depths(point):
        *_, first, second = coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )
        return first, second

    first, second = jax.vmap(depths)(pair.coordinates)
    front = pair.mask & (first > 0) & (second > 0)
    behind = pair.mask & (first < 0) & (second < 0)
    return jnp.where(count(front) >= count(behind), front, behind)


def parallel(pair: Pair, pose: RelativePose, limit: ArrayLike) -> Use:
    """The points whose rays are parallel within `limit` standard deviations of the
    angle between them."""
    rotation, base = pose.relative()

    def is_parallel(point, sigma):
        first, second, sine, *_ = coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )
        one = rot.dot(first, first)
        other = rot.dot(second, second)
        variance = sigma**2 * (1 / one + 1 / other)
        most = jnp.asarray(limit, sine.dtype) ** 2 * variance
        # |r1 x r2|² = |r1|² |r2|² sin² of the angle
        return sine <= most * one * other

    return pair.mask & jax.vmap(is_parallel)(pair.coordinates, pair.sigma)
