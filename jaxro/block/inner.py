"""Inner parameters of the cameras of a block as unknowns: the focal length, the
principal point, Brown's coefficients. They are common to many photos, and touched by
each of their rays.

Unknown are small numbers in units of the focal length, from the camera that was given:
they are zero where this is right.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..calibration.camera import Camera, Measured, Station, misfit, perspective

NAMES = ("focal", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
"""The inner parameters; Brown's as in `calibration.brown`."""

POWERS = np.array([1, 1, 1, -2, -4, -6, -1, -1, 0, 0])
"""By which power of the focal length each is multiplied to have the unit of the
photos."""

UPWARDS = np.array([1, 1, -1, 1, 1, 1, 1, -1, 1, -1])
"""By which sign each is multiplied if y counts upwards."""


class Inner(NamedTuple):
    """Which inner parameters are unknown: the focal length, the principal point,
    `radial` of k1, k2, k3, the `tangential` p1 and p2, and `affinity`, b1 and b2."""

    focal: bool = True
    principal: bool = True
    radial: int = 0
    tangential: bool = False
    affinity: bool = False

    @property
    def free(self) -> tuple[int, ...]:
        """The unknown ones of `NAMES`."""
        radial = [number < self.radial for number in range(3)]
        two = lambda one: [one] * 2
        every = [self.focal, *two(self.principal), *radial]
        every += [*two(self.tangential), *two(self.affinity)]
        return tuple(k for k, is_free in enumerate(every) if is_free)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknown ones."""
        return tuple(NAMES[k] for k in self.free)


@dataclass(frozen=True)
class OfRay:
    """The misfit of one ray of a camera with unknown inner parameters. It is compared
    by value: compiled programs are kept by it."""

    inner: Inner

    def __call__(
        self,
        station: Station,
        own: Float[Array, " parameter"],
        point: Float[Array, "3"],
        place: Float[Array, "2"],
    ):
        parameters = [jnp.zeros(())] * len(NAMES)
        for value, k in enumerate(self.inner.free):
            parameters[k] = own[value]
        camera = Camera(
            principal=jnp.stack(parameters[1:3]),
            focal=jnp.stack([1 + parameters[0]]),
            brown=jnp.stack(parameters[3:]),
            field=jnp.zeros(0),
        )
        seen = Measured(place, point, jnp.ones((2, 1)), jnp.zeros((2, 0)))
        return misfit(perspective, station, camera, seen)


class Cameras(NamedTuple):
    """The cameras of a block: the number of that of each photo, and their focal
    lengths. Photos with one focal length have one camera."""

    of_photo: Int[np.ndarray, " photo"]
    focal: Float[np.ndarray, " camera"]

    @property
    def number(self) -> int:
        """How many there are."""
        return len(self.focal)


def cameras_of(focal: Float[np.ndarray, " photo"]) -> Cameras:
    """The cameras of photos with these focal lengths."""
    found, number = np.unique(focal, return_inverse=True)
    return Cameras(number.reshape(-1), found)


class InnerParameters(NamedTuple):
    """The inner parameters of each camera, as they are with what was given, and their
    covariance: in the unit of the photos, y upwards; b1, b2 and Brown's in the powers
    of this unit."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "camera parameter"]
    covariance: Float[np.ndarray, "camera parameter parameter"]

    @property
    def deviations(self) -> Float[np.ndarray, "camera parameter"]:
        """Their standard deviations."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def in_photo_units(
    inner: Inner,
    cameras: Cameras,
    found: Float[np.ndarray, "camera parameter"],
    covariance: Float[np.ndarray, "all all"],
) -> InnerParameters:
    """The parameters of the adjustment, with the covariance of all cameras together, in
    the unit of the photos."""
    free = list(inner.free)
    units = cameras.focal[:, None] ** POWERS[free] * UPWARDS[free]
    n, p = found.shape
    blocks = covariance.reshape(n, p, n, p)
    own = np.array([blocks[k, :, k] for k in range(n)]).reshape(n, p, p)
    values = found * units
    if inner.focal:
        values[:, 0] += cameras.focal
    return InnerParameters(
        inner.names, values, own * units[:, :, None] * units[:, None]
    )
