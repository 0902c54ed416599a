"""The other solution of minimal control: two points known in plan and three in height.

Let u = s r, with r the third row of R, p the vector between the points known in plan,
and d the normal of the triangle known in height. The heights tell u but for u + λ d.
The length in plan, whose square is |u|² p² - (u p)², tells λ by a quadratic equation.
One root is the solution that is known, λ = 0; the other one is

    λ = -2 (u × p)(d × p) / |d × p|².
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..geometry import rotations as rot
from .absolute_model import MeasuredModel
from .similarity import Similarity, Vector


def is_minimal(known: Bool[Array, "point 3"]) -> Bool[Array, ""]:
    """Whether two points are known in plan, three in height, and nothing else."""
    plan = known[:, 0] & known[:, 1]
    one_each = jnp.sum(known[:, :2]) == 2 * jnp.sum(plan)
    return one_each & (jnp.sum(plan) == 2) & (jnp.sum(known[:, 2]) == 3)


def twin(measured: MeasuredModel, found: Similarity) -> Similarity:
    """The other solution beside the one that was `found` for minimal control."""
    first = lambda flags, n: measured.points[jnp.argsort(~flags, stable=True)[:n]]
    plan = first(measured.known[:, 0] & measured.known[:, 1], 2)
    height = first(measured.known[:, 2], 3)
    p = _vector(plan[1] - plan[0])
    d = rot.cross(_vector(height[1] - height[0]), _vector(height[2] - height[0]))
    u = rot.scale(found.rotation[2], found.scale)
    across = rot.cross(d, p)
    square = rot.dot(across, across)
    product = rot.dot(rot.cross(u, p), across)
    factor = -2 * product / jnp.where(square > 0, square, 1.0)
    up = rot.add_scaled(u, d, factor)
    scale = jnp.sqrt(jnp.maximum(rot.dot(up, up), jnp.finfo(square.dtype).tiny))
    third = rot.scale(up, 1 / scale)

    level = *rot.tangents(third), third
    wanted, there = rot.apply(found.rotation, p), rot.apply(level, p)
    angle = jnp.arctan2(wanted[1], wanted[0]) - jnp.arctan2(there[1], there[0])
    turn = rot.product(rot.r_chi(angle), level)
    quaternion = jnp.stack(rot.to_quaternion(turn))
    centred = Similarity(scale, quaternion, jnp.zeros(3))
    in_plan = found.to_ground(plan[0]) - centred.to_ground(plan[0])
    in_height = found.to_ground(height[0]) - centred.to_ground(height[0])
    shift = jnp.stack([in_plan[0], in_plan[1], in_height[2]])
    return Similarity(scale, quaternion, shift)


def _vector(a: Vector) -> rot.Vector:
    return a[0], a[1], a[2]
