"""The camera that took an image, and the condition between a place and its object
point.

    m = t + A(m) a + W(m) f ∘ p - Brown(m - t; k),    p = (Xc/Zc, Yc/Zc),  Xc = R (X - S)

Station S and rotation R; t, the principal place; the focal lengths f by zones, of which
W(m) are the weights along x and along y; Brown's coefficients k; the coefficients a of
a displacement field. W and A are looked up at the measured place once, so that the way
from a place to its ray is explicit: p = (m - t - A a + Brown) / W f.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adjustment import AbstractParameters
from ..geometry import rotations as rot
from .area import Pair
from .brown import corrections

Vector = Float[Array, "3"]

TURN_AND_SHIFT = (0, 1, 2), (3, 4, 5)
"""The local parameters of a `Station`."""


class Station(AbstractParameters):
    """Where the camera stood and how it was turned: the projection centre, and the unit
    quaternion of R, object to camera (x to the right, y down, z forward).

    Its six local parameters are a small rotation vector w in the camera's axes, which
    enters as the quaternion (1, w/2), and the three coordinates.
    """

    quaternion: Float[Array, "*image 4"]
    centre: Float[Array, "*image 3"]

    @property
    def count(self) -> int:
        return 6

    def move(self, step) -> "Station":
        turn, along = (jnp.stack([step[k] for k in axes]) for axes in TURN_AND_SHIFT)
        turned = rot.turn_quaternion(self.quaternion, turn)
        return Station(turned, self.centre + along)

    def normalise(self) -> "Station":
        return Station(rot.unit_quaternion(self.quaternion), self.centre)

    def to_camera(self, point: Vector) -> rot.Vector:
        """R (X - S), times the squared length of the quaternion."""
        apart = point - self.centre
        turn = rot.from_quaternion(*(self.quaternion[k] for k in range(4)))
        return rot.apply(turn, (apart[0], apart[1], apart[2]))


class Camera(eqx.Module):
    """The inner orientation and the distortion of an image, in the units of its
    frame. `brown` has seven coefficients or none."""

    principal: Float[Array, "*camera 2"]
    focal: Float[Array, "*camera zone"]
    brown: Float[Array, "*camera coefficient"]
    field: Float[Array, "*camera mode"]


class Measured(NamedTuple):
    """One measured point: its place, its object coordinates, and the weights of the
    focal lengths and of the field's coefficients there, for x and for y."""

    place: Pair
    point: Vector
    focal: Float[Array, "2 zone"]
    field: Float[Array, "2 mode"]


@dataclass(frozen=True, repr=False)
class Rays:
    """How a ray through the projection centre meets the image of the focal length 1:
    its `image`, infinite where there is none, and the `direction` of an image."""

    image: Callable[[rot.Vector], tuple[Array, Array]]
    direction: Callable[[Pair], rot.Vector]

    def __call__(self, ray: rot.Vector) -> tuple[Array, Array]:
        return self.image(ray)

    def __repr__(self) -> str:
        # without addresses, which differ from process to process: compiled programs are
        # kept under such texts
        return f"Rays({_name(self.image)}, {_name(self.direction)})"


def _name(function: Callable) -> str:
    """Where a function is found; with its address, if it is not found by its name."""
    name = f"{function.__module__}.{function.__qualname__}"
    return f"{name} {id(function)}" if "<" in name else name


def _perspective(ray: rot.Vector) -> tuple[Array, Array]:
    x, y, z = ray
    ahead = z > 0
    safe = jnp.where(ahead, z, 1.0)
    behind = lambda value: jnp.where(ahead, value / safe, jnp.inf)
    return behind(x), behind(y)


def _stereographic(ray: rot.Vector) -> tuple[Array, Array]:
    x, y, z = ray
    sum_ = jnp.sqrt(rot.dot(ray, ray)) + z
    seen = sum_ > 0
    safe = jnp.where(seen, sum_, 1.0)
    opposite = lambda value: jnp.where(seen, 2 * value / safe, jnp.inf)
    return opposite(x), opposite(y)


def _perspective_direction(p: Pair) -> rot.Vector:
    return p[0], p[1], jnp.ones_like(p[0])


def _stereographic_direction(p: Pair) -> rot.Vector:
    return p[0], p[1], 1 - (p[0] * p[0] + p[1] * p[1]) / 4


perspective = Rays(_perspective, _perspective_direction)
"""Xc/Zc, Yc/Zc; infinite behind the camera."""

stereographic = Rays(_stereographic, _stereographic_direction)
"""2 Xc / (|Xc| + Zc), 2 Yc / (|Xc| + Zc): for fields of view beyond some 100°."""


def corrected(camera: Camera, measured: Measured) -> Pair:
    """The place about the principal place, free of distortion."""
    displaced = jnp.sum(measured.field * camera.field[None], axis=1)
    about = measured.place - camera.principal
    if camera.brown.size == 0:
        return about - displaced
    return about + corrections(about, camera.brown) - displaced


def scale(camera: Camera, measured: Measured) -> Pair:
    """The focal lengths along x and y at a place."""
    return jnp.sum(measured.focal * camera.focal[None], axis=1)


def misfit(rays: Rays, station: Station, camera: Camera, measured: Measured) -> Pair:
    """The corrected place minus the image of the object point: zero if both fit."""
    ray = jnp.stack(rays(station.to_camera(measured.point)))
    return corrected(camera, measured) - scale(camera, measured) * ray
