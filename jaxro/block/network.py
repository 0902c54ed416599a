"""The rigorous adjustment of a block: all places on photos, known points and known
stations at once, by least squares.

    place - f (Xc, Yc) / Zc = 0,    Xc = R (X - S)

Unknown are six numbers of each photo and three of each point, which are eliminated: with
the orientation elements among the unknowns, the system of conditions of the 1982
fragment on independent models is exactly this one. It is sparse
(`adjustment.sparse`).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import Term
from ..calibration.camera import Camera, Measured, Station, misfit, perspective
from .measured_block import Ground, MeasuredBlock


class Start(NamedTuple):
    """Approximate values on the ground: quaternions of the rotations (w, x, y, z,
    object to camera as in `calibration.camera`), projection centres, and points, NaN
    for those that are not known."""

    quaternions: Float[np.ndarray, "photo 4"]
    centres: Float[np.ndarray, "photo 3"]
    points: Float[np.ndarray, "point 3"]


class Frame(NamedTuple):
    """Units in which all numbers are moderate: ground coordinates are `middle` +
    `length` times those of the frame."""

    middle: Float[np.ndarray, "3"]
    length: float

    def inside(self, at):
        """Ground coordinates in the frame."""
        return (at - self.middle) / self.length

    def outside(self, at):
        """Coordinates of the frame on the ground."""
        return self.middle + self.length * np.asarray(at)


def of_ray(station: Station, point: Float[Array, "3"], place: Float[Array, "2"]):
    """The misfit of one ray of an ideal camera."""
    ideal = Camera(jnp.zeros(2), jnp.ones(1), jnp.zeros(0), jnp.zeros(0))
    seen = Measured(place, point, jnp.ones((2, 1)), jnp.zeros((2, 0)))
    return misfit(perspective, station, ideal, seen)


def of_coordinate(point: Float[Array, "3"], known: tuple[Array, Array]):
    """The misfit of one known coordinate of a point."""
    return point[known[0]] - known[1]


def frame_of(start: Start) -> Frame:
    """The frame of a block: its middle, and the mean height above the points."""
    _, centres, points = start
    middle = np.mean(centres, axis=0)
    there = np.all(np.isfinite(points), axis=1)
    apart = np.linalg.norm(points[there] - np.mean(points[there], axis=0), axis=1)
    away = np.linalg.norm(centres - middle, axis=1)
    return Frame(middle, float(max(np.median(apart), np.median(away), 1e-30)))


class Numbered(NamedTuple):
    """Which rays take part, and the number of each point in the adjustment (-1:
    none)."""

    rays: Bool[np.ndarray, " ray"]
    number: Int[np.ndarray, " point"]

    def spread(self, values: Float[np.ndarray, "some ..."]) -> np.ndarray:
        """Values of the points in the adjustment as those of all points; NaN for the
        others."""
        there = (self.number >= 0).reshape(-1, *(1,) * (values.ndim - 1))
        return np.where(there, values[np.maximum(self.number, 0)], np.nan)


def number_points(
    block: MeasuredBlock,
    known: Int[np.ndarray, " point"],
    use: Bool[np.ndarray, " ray"],
) -> Numbered:
    """Points that something determines: rays in use on two photos, or on one and two
    of the `known` coordinates."""
    seen = np.unique(np.stack([block.point[use], block.photo[use]]), axis=1)[0]
    photos = np.bincount(seen, minlength=len(block.points))
    there = (photos >= 2) | ((photos == 1) & (known >= 2))
    number = np.where(there, np.cumsum(there) - 1, -1)
    return Numbered(use & there[block.point], number)


class KnownCoordinates(NamedTuple):
    """Known coordinates, one by one: of which row of `Ground`, of which point, which
    axis."""

    row: Int[np.ndarray, " coordinate"]
    point: Int[np.ndarray, " coordinate"]
    axis: Int[np.ndarray, " coordinate"]
    value: Float[np.ndarray, " coordinate"]
    sigma: Float[np.ndarray, " coordinate"]


def control_of(block: MeasuredBlock, ground: Ground) -> KnownCoordinates:
    """The coordinates that take part: of points that are on a photo and no check
    points."""
    numbers = {name: k for k, name in enumerate(block.points)}
    point = np.array([numbers.get(name, -1) for name in ground.points], int)
    use = np.isfinite(ground.coordinates) & ((point >= 0) & ~ground.check)[:, None]
    row, axis = np.nonzero(use)
    return KnownCoordinates(
        row, point[row], axis, ground.coordinates[use], ground.sigma[use]
    )


def terms_of(
    block: MeasuredBlock, numbered: Numbered, known: KnownCoordinates, units: Frame
) -> tuple[Term, ...]:
    """The conditions of rays and of known coordinates."""
    used = numbered.rays
    photo, point = block.photo[used], numbered.number[block.point[used]]
    focal = block.focal[photo]
    place = np.stack([block.x[used] / focal, -block.y[used] / focal], axis=1)
    rays = Term(
        of_ray,
        place,
        (block.sigma[used] / focal) ** 2,
        touches=[("photo", photo), ("point", point)],
    )
    there = numbered.number[known.point] >= 0
    if not np.any(there):
        return (rays,)
    axis, sigma = known.axis[there], known.sigma[there]
    middle = units.middle[axis]
    coordinates = Term(
        of_coordinate,
        (axis, (known.value[there] - middle) / units.length),
        (None, (sigma / units.length) ** 2),
        touches=[("point", numbered.number[known.point[there]])],
    )
    return rays, coordinates
