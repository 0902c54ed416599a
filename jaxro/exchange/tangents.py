"""How other programs measure a small displacement of a pose: six numbers, of which they
write covariances and information matrices.

A pose T = (R, t) turns camera axes into those of the world, X = R Y + t, with axes x to
the right, y down, z forward. From T to a pose T' near it are

    right tangent    Log(T⁻¹ T')    T' = T Exp(ξ)    `gtsam`
    left tangent     Log(T' T⁻¹)    T' = Exp(ξ) T    `left`

with ξ = (w, v), the rotation vector first. COLMAP writes the inverse, cam_from_world =
T⁻¹, and takes the left tangent of that: Exp(ξ) T⁻¹ = T'⁻¹. g2o's edges write the
translation first, and of the rotation the vector part (qx, qy, qz) of a quaternion,
which is half the rotation vector: a variance is a quarter, a weight four times that.

Each is a function (T, T') -> 6 numbers, zero at T' = T. Derivatives come from automatic
differentiation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..geometry import rotations as rot
from ..geometry.camera_axes import invert

Six = Float[Array, "6"]

SMALL = 1e-6
"""Squared half angle below which the logarithm is that of a series: its next term is
1e-12 of the first."""


class CameraPose(NamedTuple):
    """Where a camera stands: X = R Y + t takes its axes to those of the world."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]

    @property
    def inverse(self) -> "CameraPose":
        """T⁻¹"""
        return CameraPose(*invert(self.rotation, self.translation))

    def then(self, other: "CameraPose") -> "CameraPose":
        """The product: self after `other`."""
        translation = self.rotation @ other.translation + self.translation
        return CameraPose(self.rotation @ other.rotation, translation)


Tangent = Callable[[CameraPose, CameraPose], Six]
"""The displacement from one pose to another one, as a program writes it."""


def gtsam(at: CameraPose, pose: CameraPose) -> Six:
    """Rotation vector and translation in the right tangent: `Pose3` of GTSAM."""
    return logarithm(at.inverse.then(pose))


def left(at: CameraPose, pose: CameraPose) -> Six:
    """Rotation vector and translation in the left tangent."""
    return logarithm(pose.then(at.inverse))


def colmap(at: CameraPose, pose: CameraPose) -> Six:
    """Rotation vector and translation in the left tangent of cam_from_world, as COLMAP
    propagates covariances of a `Rigid3d`."""
    return left(at.inverse, pose.inverse)


def g2o(at: CameraPose, pose: CameraPose) -> Six:
    """The error of an edge EDGE_SE3:QUAT: translation of T⁻¹ T', then the vector part
    of its quaternion."""
    moved = at.inverse.then(pose)
    return jnp.concatenate([moved.translation, _quaternion(moved)[1:]])


def g2o_angles(at: CameraPose, pose: CameraPose) -> Six:
    """The same with a rotation vector: what GTSAM and Ceres' example take for granted
    when they read edges."""
    moved = at.inverse.then(pose)
    return jnp.concatenate([moved.translation, logarithm(moved)[:3]])


def logarithm(pose: CameraPose) -> Six:
    """ξ = (w, v) with Exp(ξ) = T, for rotations by less than half a turn.

    With half the angle h, q = (cos h, sin h e): w = 2 h e, and

        v = t - w × t / 2 + (1 - h cos h / sin h) / (2 h)² w × (w × t)
    """
    w, *vector = _quaternion(pose)
    axis = jnp.stack(vector)
    squared = axis @ axis
    near = squared < SMALL
    # of the branch that is not taken, too, derivatives have to be finite
    sine = jnp.sqrt(jnp.where(near, 1.0, squared))
    half = jnp.arctan2(sine, w)
    turn = axis * jnp.where(near, 2 + squared / 3, 2 * half / sine)
    far = (1 - half * w / sine) / (4 * half**2)
    factor = jnp.where(near, 1 / 12 + squared / 180, far)
    across = jnp.cross(turn, pose.translation)
    along = pose.translation - across / 2 + factor * jnp.cross(turn, across)
    return jnp.concatenate([turn, along])


def _quaternion(pose: CameraPose) -> Float[Array, "4"]:
    """(w, x, y, z) of its rotation, w >= 0."""
    return jnp.stack(rot.to_quaternion(rot.as_matrix(pose.rotation)))
