"""Inner parameters of the cameras of a block as unknowns: the focal length, the
principal point, Brown's coefficients, a displacement field. They are common to many
photos, and touched by each of their rays.

Unknown are small numbers in units of the focal length, from the camera that was given:
they are zero where this is right.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..calibration.brown import Brown
from ..calibration.camera import Camera, Measured, Station, misfit, perspective
from ..calibration.field import Field
from .measured_block import MeasuredBlock

NAMES = ("focal", "x0", "y0", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
"""The inner parameters; Brown's as in `calibration.brown`."""

POWERS = np.array([1, 1, 1, -2, -4, -6, -1, -1, 0, 0])
"""By which power of the focal length each is multiplied to have the unit of the
photos."""

MODES = 48
"""Functions of a displacement field for each of dx and dy: the many photos of a block
show what those of a single image leave out."""

MOST_FIELDS = 10
"""Cameras with a displacement field in one block at most: their coefficients are in one
dense matrix."""

UPWARDS = np.array([1, 1, -1, 1, 1, 1, 1, -1, 1, -1])
"""By which sign each is multiplied if y counts upwards."""


class Inner(NamedTuple):
    """Which inner parameters are unknown: the focal length, the principal point,
    `radial` of k1, k2, k3, the `tangential` p1 and p2, and `affinity`, b1 and b2.

    `field`: corrections that change over the photo in any smooth way, as far as the
    other inner parameters and the poses do not make them; True: how smooth and how
    large is found by the evidence (`field_choice`)."""

    focal: bool = True
    principal: bool = True
    radial: int = 0
    tangential: bool = False
    affinity: bool = False
    field: Field | bool = False

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

    @property
    def brown(self) -> Brown:
        """Which of Brown's coefficients are among them."""
        both = self.affinity, self.affinity
        return Brown(self.radial, self.tangential, *both)

    @property
    def modes(self) -> int:
        """The coefficients of the field, which stand behind the others. Raises
        ValueError where its strength is yet to be found."""
        if self.field is True:
            raise ValueError(
                "Inner: the strength of the displacement field is not known yet: "
                "Inner(field=Field(length, strength)), or orient_block, which finds it"
            )
        return 2 * MODES if self.field else 0

    @property
    def count(self) -> int:
        """The unknowns of a camera."""
        return len(self.free) + self.modes


def names_of(inner: Inner) -> tuple[str, ...]:
    """The unknown inner parameters as `--inner` names them."""
    groups = {
        "focal": inner.focal,
        "principal": inner.principal,
        "k1": inner.radial > 0,
        "k2": inner.radial > 1,
        "k3": inner.radial > 2,
        "tangential": inner.tangential,
        "affinity": inner.affinity,
        "field": bool(inner.field),
    }
    return tuple(name for name, is_unknown in groups.items() if is_unknown)


@dataclass(frozen=True)
class OfRay:
    """The misfit of one ray of a camera with unknown inner parameters, `free` of `NAMES`
    and the coefficients of a field; of the ray its place, and the displacements there
    that each coefficient makes. It is compared by value: compiled programs are kept by
    it."""

    free: tuple[int, ...]

    def __call__(
        self,
        station: Station,
        own: Float[Array, " parameter"],
        point: Float[Array, "3"],
        seen: tuple[Float[Array, "2"], Float[Array, "2 mode"]],
    ):
        parameters = [jnp.zeros(())] * len(NAMES)
        for value, k in enumerate(self.free):
            parameters[k] = own[value]
        camera = Camera(
            principal=jnp.stack(parameters[1:3]),
            focal=jnp.stack([1 + parameters[0]]),
            brown=jnp.stack(parameters[3:]),
            field=own[len(self.free) :],
        )
        place, field = seen
        measured = Measured(place, point, jnp.ones((2, 1)), field)
        return misfit(perspective, station, camera, measured)


class Cameras(NamedTuple):
    """The cameras of a block: the number of that of each photo, their names and focal
    lengths."""

    of_photo: Int[np.ndarray, " photo"]
    names: tuple[str, ...]
    focal: Float[np.ndarray, " camera"]

    @property
    def number(self) -> int:
        """How many there are."""
        return len(self.focal)


def cameras_of(block: MeasuredBlock) -> Cameras:
    """The cameras of the photos: by their names where the block has them, else photos
    with one focal length have one camera. Raises ValueError for a camera with two focal
    lengths."""
    if block.cameras is None:
        found, number = np.unique(block.focal, return_inverse=True)
        names = tuple(str(k + 1) for k in range(len(found)))
        return Cameras(number.reshape(-1), names, found)
    names, first, number = np.unique(
        block.cameras, return_index=True, return_inverse=True
    )
    focal = block.focal[first]
    if np.any(off := block.focal != focal[number]):
        name = block.cameras[int(np.flatnonzero(off)[0])]
        raise ValueError(f"MeasuredBlock: camera {name!r} has two focal lengths")
    return Cameras(number.reshape(-1), tuple(map(str, names)), focal)


class InnerParameters(NamedTuple):
    """The inner parameters of each camera, as they are with what was given, and their
    covariance: in the unit of the photos, y upwards; b1, b2 and Brown's in the powers
    of this unit. `cameras`: their names."""

    cameras: tuple[str, ...]
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
    n, p = len(found), len(free)
    own = own_blocks(covariance, n)[:, :p, :p]
    values = found[:, :p] * units
    if inner.focal:
        values[:, 0] += cameras.focal
    spread = own * units[:, :, None] * units[:, None]
    return InnerParameters(cameras.names, inner.names, values, spread)


def own_blocks(
    covariance: Float[np.ndarray, "all all"], cameras: int
) -> Float[np.ndarray, "camera parameter parameter"]:
    """The parts of a covariance that belong to each camera alone."""
    p = len(covariance) // cameras
    blocks = covariance.reshape(cameras, p, cameras, p)
    return np.array([blocks[k, :, k] for k in range(cameras)]).reshape(cameras, p, p)
