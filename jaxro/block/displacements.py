"""The displacement field of a camera of a block (`camera.field`): its functions at
the places of the photos, and what was found of it.

Functions and coefficients are those of a single image. The measured area is that of all
photos of the camera together, in units of half its longer side; displacements are in
units of the focal length, y downwards.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..adjustment.sparse import with_room
from ..camera.area import Area
from ..camera.brown import Brown
from ..camera.field import Field, columns
from ..camera.inner import MODES, Inner
from ..xla.programs import compiled
from .cameras import Cameras, cameras_of
from .measured_block import MeasuredBlock

ACROSS = 21
"""Places in a row of the grid over which a field is told."""

NEARLY_ALL, FAR = 0.9, 2.0
"""A place belongs to the area of a camera if it is no farther from the middle than so
many times the distance to which evenly spread places would reach, as that part of them
tells it."""


class MeasuredArea(NamedTuple):
    """The area that photos of one camera have places in: its middle and its half sides,
    in units of the focal length, y downwards."""

    middle: Float[np.ndarray, "2"]
    half_sides: Float[np.ndarray, "2"]

    @property
    def unit(self) -> float:
        """Half of its longer side."""
        return float(np.max(self.half_sides))

    @property
    def grid(self) -> Float[np.ndarray, "place 2"]:
        """Places all over it, in equal distances."""
        axis = np.linspace(-1.0, 1.0, ACROSS)
        square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        return self.middle + square * self.half_sides


def areas_of(
    cameras: Cameras,
    camera: Int[np.ndarray, " ray"],
    places: Float[np.ndarray, "ray 2"],
) -> list[MeasuredArea]:
    """The measured area of each camera; `camera`: that of each of the places."""
    return [_area_of(places[camera == k]) for k in range(cameras.number)]


def _area_of(places: Float[np.ndarray, "place 2"]) -> MeasuredArea:
    """The area of places, without what is far off most of them: a digit too many."""
    if not len(places):
        return MeasuredArea(np.zeros(2), np.ones(2))
    away = np.abs(places - np.median(places, axis=0))
    usual = np.quantile(away, NEARLY_ALL, axis=0) / NEARLY_ALL
    near = places[np.all(away <= FAR * usual, axis=1)]
    least, most = np.min(near, axis=0), np.max(near, axis=0)
    # no area is a line
    return MeasuredArea((most + least) / 2, np.maximum((most - least) / 2, 1e-9))


def at_places(
    inner: Inner, area: MeasuredArea, places: Float[np.ndarray, "place 2"]
) -> Float[np.ndarray, "place 2 mode"]:
    """The displacements that each coefficient of the field makes at places, if it is
    1; of a camera without a field there are none."""
    if not inner.modes:
        return np.zeros((len(places), 2, 0))
    assert isinstance(inner.field, Field)
    u = with_room((places - area.middle) / area.unit)
    half, principal = area.half_sides / area.unit, -area.middle / area.unit
    found = _columns(u, half, principal, length=inner.field.length, brown=inner.brown)
    return np.asarray(found)[: len(places)]


@compiled(static=("length", "brown"))
def _columns(
    u: Float[Array, "place 2"],
    half_sides: Float[Array, "2"],
    principal: Float[Array, "2"],
    *,
    length: float,
    brown: Brown,
) -> Float[Array, "place 2 mode"]:
    """`camera.field.columns` of places."""
    area = Area(u, jnp.ones(len(u), bool), half_sides, principal)
    return columns(u, area, Field(length, 1.0), brown, MODES)


def of_rays(
    inner: Inner,
    areas: list[MeasuredArea],
    camera: Int[np.ndarray, " ray"],
    places: Float[np.ndarray, "ray 2"],
) -> Float[np.ndarray, "ray 2 mode"]:
    """The same for places of several cameras, each by the field of its own."""
    found = np.zeros((len(places), 2, inner.modes))
    if inner.modes:
        for k, area in enumerate(areas):
            found[camera == k] = at_places(inner, area, places[camera == k])
    return found


class FoundField(NamedTuple):
    """The displacement field of one camera over its measured area: places, what is to
    be taken off them to have those of a camera without a field, and the standard
    deviations of that; in the unit of the photos, y upwards."""

    camera: str
    places: Float[np.ndarray, "place 2"]
    displacements: Float[np.ndarray, "place 2"]
    deviations: Float[np.ndarray, "place 2"]

    @property
    def rms(self) -> float:
        """Root mean square of the displacements of a coordinate."""
        return float(np.sqrt(np.mean(self.displacements**2)))

    @property
    def largest(self) -> float:
        """The largest displacement of a place."""
        return float(np.max(np.hypot(*self.displacements.T)))


def read_fields(
    inner: Inner,
    block: MeasuredBlock,
    places: Float[np.ndarray, "ray 2"],
    found: Float[np.ndarray, "camera parameter"],
    covariances: Float[np.ndarray, "camera parameter parameter"],
) -> list[FoundField]:
    """The fields of all cameras, from their inner parameters and the covariance of
    each; none where these have no field."""
    cameras = cameras_of(block)
    camera = cameras.of_photo[block.photo]
    up, told = np.array([1.0, -1.0]), []
    areas = areas_of(cameras, camera, places) if inner.modes else []
    for k, area in enumerate(areas):
        focal, at = cameras.focal[k], area.grid
        a = at_places(inner, area, at)
        q = covariances[k][-inner.modes :, -inner.modes :]
        variance = np.einsum("pci,ij,pcj->pc", a, q, a)
        told.append(
            FoundField(
                camera=cameras.names[k],
                places=at * focal * up,
                displacements=a @ found[k, -inner.modes :] * focal * up,
                deviations=np.sqrt(np.maximum(variance, 0.0)) * focal,
            )
        )
    return told


def prior_variance(
    inner: Inner, block: MeasuredBlock
) -> Float[np.ndarray, "camera mode"]:
    """The a priori variance of the coefficients of each camera's field: its strength in
    units of the standard deviation of a place."""
    assert isinstance(inner.field, Field)
    deviation = np.asarray(inner.field.strength) * deviations_of(block)
    return np.repeat(deviation[:, None] ** 2, 2 * MODES, axis=1)


def deviations_of(block: MeasuredBlock) -> Float[np.ndarray, " camera"]:
    """The usual standard deviation of a place of each camera, in units of its focal
    length."""
    cameras = cameras_of(block)
    camera = cameras.of_photo[block.photo]
    spread = block.sigma / block.focal[block.photo]
    of = lambda own: np.median(own) if len(own) else np.median(spread)
    return np.array([of(spread[camera == k]) for k in range(cameras.number)])
