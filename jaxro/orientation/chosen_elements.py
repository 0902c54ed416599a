"""The elements that were asked for, of a solved pose: their system, scale, side and
cofactors."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool

from ..geometry.elements import (
    AbstractElements,
    DependentElements,
    IndependentElements,
    RelativePose,
    convert,
    to_pose,
)
from ..geometry.pairs import Pair
from ..xla.passes import total
from .inspection import Inspection


def face_points(
    pose: RelativePose, inspected: Inspection, free: bool
) -> tuple[RelativePose, Bool[Array, ""]]:
    """The pose with the sign of its base that puts most points in front: g does not
    know that sign."""
    if not free:
        return pose, jnp.zeros_like(pose.qw, bool)
    turn = inspected.in_front < 0
    return pose.turn_base(jnp.where(turn, -1.0, 1.0)), turn


def length(
    pair: Pair,
    system: type[AbstractElements],
    base: ArrayLike | None,
    pose: RelativePose,
):
    """bx of the dependent system, b of the independent one: as given, else the mean
    x-parallax on the side of b."""
    if system is RelativePose:
        return jnp.ones_like(pose.bx)
    if base is not None:
        return jnp.broadcast_to(jnp.asarray(base, pose.bx.dtype), pose.bx.shape)
    mean = jnp.abs(
        total(jnp.where(pair.mask, pair.x_left - pair.x_right, 0.0))
        / jnp.maximum(pair.count, 1.0)
    )
    # a choice of scale, not a measurement: elements have no derivative through it
    mean = lax.stop_gradient(
        jnp.where(mean > 1e-6 * pair.focal_left, mean, pair.focal_left)
    )
    return jnp.where((pose.bx < 0) & (system is DependentElements), -mean, mean)


def in_system(
    solved: AbstractElements, cofactor, flipped, system: type[AbstractElements], length
):
    """The elements in the chosen system and their cofactors J Q Jᵀ."""
    if type(solved) is system and system is IndependentElements:
        return solved, cofactor
    sign = jnp.where(flipped, -1.0, 1.0)

    def at(step: tuple) -> AbstractElements:
        pose = to_pose(solved.move(step)).turn_base(sign)
        return convert(pose, system, length)

    origin = (jnp.zeros_like(length),) * 5
    found = at(origin)
    # `tangents` of -b are those of b, the second one turned: b1 changes its sign
    if isinstance(found, RelativePose) and isinstance(solved, RelativePose):
        one = jnp.ones_like(sign)
        signs = jnp.stack([one, one, one, sign, one])
        return found, cofactor * signs[:, None] * signs[None, :]

    def values(*x: Array) -> Array:
        moved = at(x)
        if isinstance(found, RelativePose) and isinstance(moved, RelativePose):
            return jnp.stack(found.step_to(moved))  # its parameters are local
        return jnp.stack(moved.values())

    push = jax.linearize(values, *origin)[1]
    jacobian = jax.vmap(push, out_axes=1)(*jnp.eye(5, dtype=cofactor.dtype))
    right = jnp.sum(jacobian[:, :, None] * cofactor[None, :, :], axis=1)
    return found, jnp.sum(right[:, None, :] * jacobian[None, :, :], axis=2)


def wrong_side(
    system: type[AbstractElements], base: ArrayLike | None, pose: RelativePose
) -> Bool[Array, ""]:
    """Whether the given bx points away from where the right photo lies."""
    if system is not DependentElements or base is None:
        return jnp.zeros_like(pose.bx, bool)
    return pose.bx * jnp.asarray(base, pose.bx.dtype) < 0
