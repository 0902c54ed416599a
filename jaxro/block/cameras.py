"""The cameras of a block: which photo was taken by which, and their inner parameters in
the unit of the photos."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..camera.inner import Inner
from .measured_block import MeasuredBlock

POWERS = np.array([1, 1, 1, -2, -4, -6, -1, -1, 0, 0])
"""By which power of the focal length each is multiplied to have the unit of the
photos."""

UPWARDS = np.array([1, 1, -1, 1, 1, 1, 1, -1, 1, -1])
"""By which sign each is multiplied if y counts upwards."""

MOST_FIELDS = 10
"""Cameras with a displacement field in one block at most: their coefficients are in one
dense matrix."""


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
