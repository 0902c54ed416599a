"""The rigorous adjustment of a block: all places on photos, known points and known
stations at once, by least squares.

    place - f (Xc, Yc) / Zc = 0,    Xc = R (X - S)

Unknown are six numbers of each photo and three of each point, which are eliminated, and
where they are asked for the `inner` parameters of the cameras. With the orientation
elements among the unknowns, the system of conditions of the 1982 fragment on
independent models is exactly this one. It is sparse (`adjustment.sparse`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import Term
from ..camera.condition import Camera, Measured, Station, misfit, perspective
from ..camera.inner import Inner, OfRay
from ..geometry import rotations as rot
from .cameras import cameras_of
from .displacements import areas_of, of_rays, prior_variance
from .measured_block import Ground, MeasuredBlock


class Start(NamedTuple):
    """Approximate values on the ground: quaternions of the rotations (w, x, y, z,
    object to camera as in `camera.condition`), projection centres, and points, NaN
    for those that are not known; `inner`: parameters of each camera, None for zeros."""

    quaternions: Float[np.ndarray, "photo 4"]
    centres: Float[np.ndarray, "photo 3"]
    points: Float[np.ndarray, "point 3"]
    inner: Float[np.ndarray, "camera parameter"] | None = None


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


def of_coordinate(point: Float[Array, " number"], known: tuple[Array, Array]):
    """The misfit of one known coordinate of a point, or of another number."""
    return point[known[0]] - known[1]


def of_station(station: Station, known: tuple[Array, Array]):
    """The misfit of one known coordinate of a projection centre."""
    return of_coordinate(station.centre, known)


def angles_and_centre(station: Station) -> Float[Array, "6"]:
    """omega, phi, kappa and the centre of one photo."""
    turn = rot.omega_phi_kappa(photo_axes(station))
    return jnp.concatenate([jnp.stack(turn), station.centre])


def photo_axes(station: Station) -> rot.Matrix:
    """M of one photo, object to photo (y up, z backward)."""
    quaternion = rot.unit_quaternion(station.quaternion)
    turn = rot.from_quaternion(*(quaternion[k] for k in range(4)))
    return turn[0], rot.scale(turn[1], -1.0), rot.scale(turn[2], -1.0)


def frame_of(start: Start) -> Frame:
    """The frame of a block: its middle, and the mean height above the points."""
    centres, points = start.centres, start.points
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
    """Known coordinates, one by one: of which row of `Ground`, of which point (or photo,
    where they are of a `station`), which axis."""

    row: Int[np.ndarray, " coordinate"]
    number: Int[np.ndarray, " coordinate"]
    axis: Int[np.ndarray, " coordinate"]
    value: Float[np.ndarray, " coordinate"]
    sigma: Float[np.ndarray, " coordinate"]
    station: Bool[np.ndarray, " coordinate"]

    def take(self, some: np.ndarray) -> "KnownCoordinates":
        """Some of them."""
        return KnownCoordinates(*(column[some] for column in self))

    def of_points(self, points: int) -> Int[np.ndarray, " point"]:
        """How many are known of each point."""
        return np.bincount(self.number[~self.station], minlength=points)


def known_of(block: MeasuredBlock, ground: Ground) -> KnownCoordinates:
    """The coordinates that take part: of points and photos of the block, and no check
    points."""
    number = ground.numbers_in(block)
    use = np.isfinite(ground.coordinates) & ((number >= 0) & ~ground.check)[:, None]
    row, axis = np.nonzero(use)
    values = ground.coordinates[use], ground.sigma[use]
    return KnownCoordinates(row, number[row], axis, *values, ground.station[row])


def complete(
    block: MeasuredBlock, start: Start, points: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point 3"]:
    """The points, those with one unknown coordinate (NaN) where one of their rays passes
    by the two others."""
    from scipy.spatial.transform import Rotation

    numbers, rays = np.unique(block.point, return_index=True)
    open_ = np.sum(np.isnan(points[numbers]), axis=1) == 1
    if not np.any(open_):
        return points
    point, ray = numbers[open_], rays[open_]
    photo = block.photo[ray]
    x, y = places_of(block)[ray].T
    turn = Rotation.from_quat(start.quaternions[photo][:, [1, 2, 3, 0]])
    along = turn.inv().apply(np.stack([x, y, np.ones(len(x))], axis=1))
    away = points[point] - start.centres[photo]
    squares = np.sum(np.where(np.isnan(away), 0.0, along**2), axis=1)
    distance = np.nansum(away * along, axis=1) / squares
    found = start.centres[photo] + distance[:, None] * along
    points = points.copy()
    points[point] = np.where(np.isnan(points[point]), found, points[point])
    return points


def in_order(
    known: KnownCoordinates, numbered: Numbered
) -> tuple[KnownCoordinates, ...]:
    """Those of points in the adjustment, and those of stations, as far as there are
    any: in the order of their terms."""
    there = numbered.number[np.where(known.station, 0, known.number)] >= 0
    parts = known.take(~known.station & there), known.take(known.station)
    return tuple(part for part in parts if len(part.row))


def points_of(parts: tuple[KnownCoordinates, ...]) -> KnownCoordinates:
    """The known coordinates of points alone."""
    some = [part for part in parts if not part.station[0]]
    none = np.zeros(0, int), np.zeros(0), np.zeros(0, bool)
    whole, real, truth = none
    empty = KnownCoordinates(whole, whole, whole, real, real, truth)
    return some[0] if some else empty


def spread_known(
    parts: tuple[KnownCoordinates, ...],
    values: Sequence[np.ndarray],
    rows: int,
    otherwise: float | bool = np.nan,
) -> np.ndarray:
    """Values of the coordinates of all parts by the rows of `Ground`, (row, 3);
    `otherwise` for the others."""
    out = np.full((rows, 3), otherwise)
    for part, of_part in zip(parts, values, strict=True):
        out[part.row, part.axis] = of_part
    return out


def terms_of(
    block: MeasuredBlock,
    numbered: Numbered,
    parts: tuple[KnownCoordinates, ...],
    units: Frame,
    inner: Inner | None = None,
) -> tuple[Term, ...]:
    """The conditions of rays, those of each part of the known coordinates, and what is
    known beforehand of displacement fields."""
    used = numbered.rays
    photo, point = block.photo[used], numbered.number[block.point[used]]
    touches = [("photo", photo), ("point", point)]
    variance = (block.sigma[used] / block.focal[photo]) ** 2
    places, fields = places_of(block), ()
    seen = places[used]
    if inner is not None:
        cameras = cameras_of(block)
        camera = cameras.of_photo[block.photo]
        touches.insert(1, ("camera", camera[used]))
        areas = areas_of(cameras, camera, places) if inner.modes else []
        seen = seen, of_rays(inner, areas, camera[used], seen)
        variance = variance, None
        if inner.modes:
            fields = (_of_fields(inner, block),)
    rays = Term(ray_condition(inner), seen, variance, touches=touches)
    return rays, *(_of_known(part, numbered, units) for part in parts), *fields


def _of_fields(inner: Inner, block: MeasuredBlock) -> Term:
    """What is known beforehand of the fields of all cameras: each coefficient is zero
    but for their strength."""
    variance = prior_variance(inner, block)
    camera, mode = np.indices(variance.shape).reshape(2, -1)
    return Term(
        of_coordinate,
        (len(inner.free) + mode, np.zeros(len(mode))),
        (None, variance.ravel()),
        touches=[("camera", camera)],
    )


def ray_condition(inner: Inner | None) -> Callable:
    """The condition of one ray."""
    return of_ray if inner is None else OfRay(inner.free)


def places_of(block: MeasuredBlock) -> Float[np.ndarray, "ray 2"]:
    """The places in units of the focal length, y downwards."""
    return np.stack([block.x, -block.y], axis=1) / block.focal[block.photo][:, None]


def _of_known(part: KnownCoordinates, numbered: Numbered, units: Frame) -> Term:
    """The conditions of known coordinates, of points or of stations."""
    of_stations = bool(part.station[0])
    member = part.number if of_stations else numbered.number[part.number]
    values = (part.value - units.middle[part.axis]) / units.length
    return Term(
        of_station if of_stations else of_coordinate,
        (part.axis, values),
        (None, (part.sigma / units.length) ** 2),
        touches=[("photo" if of_stations else "point", member)],
    )
