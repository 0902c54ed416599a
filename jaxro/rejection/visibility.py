"""Which points can be seen from both photos of a pose."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.passes import count
from .masked import Use


class Visibility(NamedTuple):
    """The points in front of both photos, with the sign of the base that puts most of
    those that agree there; and those whose rays are parallel within a limit."""

    in_front: Use
    parallel: Use


def seen(pair: Pair, pose: RelativePose, limit: ArrayLike, use: Use) -> Use:
    """The points in front of both photos, and those whose rays are so nearly parallel
    that the sign of their depth says nothing. The points in `use` tell on which side of
    the left photo the right one is: of many wrong ones most may lie behind."""
    visible = look(pair, pose, limit, use)
    return visible.in_front | visible.parallel


def look(
    pair: Pair, pose: RelativePose, limit: ArrayLike = 0.0, use: Use | bool = True
) -> Visibility:
    """`Visibility` of the points; `limit`: in standard deviations of the angle between
    the rays; `use`: the points that agree with the pose."""
    rotation, base = pose.relative()
    focals = pair.focal_left, pair.focal_right

    def of_point(point, sigma):
        first, second, sine, *depths = coplanarity.rays(
            None, rotation, base, point, *focals
        )
        one = rot.dot(first, first)
        other = rot.dot(second, second)
        variance = sigma**2 * (1 / one + 1 / other)
        most = jnp.asarray(limit, sine.dtype) ** 2 * variance
        # |r1 x r2|² = |r1|² |r2|² sin² of the angle
        return sine <= most * one * other, *depths

    parallel, left, right = jax.vmap(of_point)(pair.coordinates, pair.sigma)
    front = pair.mask & (left > 0) & (right > 0)
    behind = pair.mask & (left < 0) & (right < 0)
    return Visibility(
        in_front=jnp.where(count(front & use) >= count(behind & use), front, behind),
        parallel=pair.mask & parallel,
    )
