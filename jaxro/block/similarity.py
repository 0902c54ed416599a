"""The similarity that places a model on the ground.

    X = s R x + T

with the scale s, any rotation R and the shift T. An adjustment knows it in the units of
a `Frame`, in which all numbers are near 1.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment import AbstractParameters
from ..adjustment.guarded import root
from ..geometry import rotations as rot
from ..xla.passes import count

Vector = Float[Array, "3"]
Points = Float[Array, "point 3"]

TURN_AND_SHIFT = (1, 2, 3), (4, 5, 6)
"""The local parameters of a `Similarity` behind the change of its scale."""


class Similarity(AbstractParameters):
    """Scale, the quaternion of the rotation from model to ground (of any length), and
    shift.

    Its seven local parameters have a meaning on the ground: the relative change of the
    scale, turns about the X, Y and Z axis of the ground, and shifts along them in units
    of the model.
    """

    scale: Float[Array, "*model"]
    quaternion: Float[Array, "*model 4"]
    shift: Float[Array, "*model 3"]

    @property
    def count(self) -> int:
        return 7

    def move(self, step) -> "Similarity":
        turn, along = (jnp.stack([step[k] for k in axes]) for axes in TURN_AND_SHIFT)
        turned = rot.turn_quaternion(self.quaternion, turn)
        scale = self.scale * jnp.exp(step[0])
        return Similarity(scale, turned, self.shift + self.scale * along)

    def normalise(self) -> "Similarity":
        turned = rot.unit_quaternion(self.quaternion)
        return Similarity(self.scale, turned, self.shift)

    @property
    def rotation(self) -> rot.Matrix:
        """R."""
        turn = rot.from_quaternion(*(self.quaternion[k] for k in range(4)))
        one = 1 / jnp.sum(self.quaternion**2)
        return rot.scale(turn[0], one), rot.scale(turn[1], one), rot.scale(turn[2], one)

    def to_ground(self, point: Vector) -> Vector:
        """s R x + T of one point."""
        turned = rot.apply(self.rotation, (point[0], point[1], point[2]))
        return self.scale * jnp.stack(turned) + self.shift


class Frame(eqx.Module):
    """The units of an adjustment: model and ground are counted from the middle of the
    control in each, in units of its extent."""

    model_centre: Vector
    model_size: Float[Array, ""]
    ground_centre: Vector
    ground_size: Float[Array, ""]

    def without(self, similarity: Similarity) -> Similarity:
        """A similarity in the units of the frame as one between the coordinates
        themselves."""
        scale = similarity.scale * self.ground_size / self.model_size
        of_frame = Similarity(scale, similarity.quaternion, self.ground_centre)
        shift = of_frame.to_ground(-self.model_centre)
        shift = shift + self.ground_size * similarity.shift
        return Similarity(scale, similarity.quaternion, shift)


def frame(points: Points, ground: Points, known: Bool[Array, "point 3"]) -> Frame:
    """The frame of model points whose ground coordinates are partly known."""
    used = jnp.broadcast_to(jnp.any(known, axis=1)[:, None], known.shape)
    return Frame(*_middle_and_extent(points, used), *_middle_and_extent(ground, known))


def _middle_and_extent(
    points: Points, known: Bool[Array, "point 3"]
) -> tuple[Vector, Float[Array, ""]]:
    """The mean of each coordinate, and the root mean square distance from it."""
    number = jnp.maximum(count(known.T), 1.0)
    middle = jnp.sum(jnp.where(known, points, 0.0), axis=0) / number
    apart = jnp.where(known, points - middle[None], 0.0)
    extent = root(jnp.sum(jnp.sum(apart**2, axis=0) / number))
    return middle, jnp.where(extent > 0, extent, 1.0)
