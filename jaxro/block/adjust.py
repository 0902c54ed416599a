"""Adjust a block, and read photos, points and control from the solution."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..adjustment import RESULTS
from ..adjustment.sparse import (
    DatumOf,
    Minimum,
    Problem,
    SparseAdjustment,
    minimise,
    prepare,
    read,
)
from ..calibration.camera import Station
from ..geometry import rotations as rot
from ..xla.programs import Program
from ..xla.settings import COMPILE_FAST
from .datum import free_datum
from .measured_block import Ground, MeasuredBlock
from .network import (
    Frame,
    KnownCoordinates,
    Numbered,
    Start,
    control_of,
    frame_of,
    number_points,
    terms_of,
)


@dataclass(frozen=True)
class BlockAdjustment:
    """An adjusted block. Coordinates are those of the ground, residuals have the unit
    of the photo coordinates; standard deviations are a posteriori. NaN stands for what
    is not there: points that nothing determines, coordinates that are not known."""

    block: MeasuredBlock
    ground: Ground | None
    frame: Frame
    numbered: Numbered
    known: KnownCoordinates
    adjustment: SparseAdjustment

    @property
    def result(self) -> RESULTS:
        """How the adjustment ended."""
        return self.adjustment.result

    def check(self) -> "BlockAdjustment":
        """This adjustment; RuntimeError with advice where it is not usable."""
        if self.result != RESULTS.successful:
            raise RuntimeError(f"adjust_block: {RESULTS[self.result]}")
        return self

    @property
    def sigma0(self) -> float:
        """The standard deviation of a coordinate with sigma 1."""
        return self.adjustment.sigma0

    @property
    def degrees_of_freedom(self) -> int:
        """Coordinates measured and known, minus unknowns."""
        return self.adjustment.degrees_of_freedom

    # ---------------------------------------------------------------------------------
    # photos

    @property
    def stations(self) -> Station:
        """Projection centres in the frame, and rotations."""
        return self.adjustment.parameters["photo"]

    @property
    def centres(self) -> Float[np.ndarray, "photo 3"]:
        """The projection centres."""
        return self.frame.outside(self.stations.centre)

    @cached_property
    def _of_photos(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles, and the covariance of angles and centre of each photo."""
        cofactors = self.adjustment.cofactors["photo"]
        found = Program(_angles, {}, COMPILE_FAST)((self.stations, cofactors))
        angles, covariance = (np.array(a) for a in found)
        units = np.array([1.0] * 3 + [self.frame.length] * 3)
        return angles, self.sigma0**2 * covariance * np.outer(units, units)

    @property
    def angles(self) -> Float[np.ndarray, "photo 3"]:
        """omega, phi, kappa in radians, M = R3(kappa) R2(phi) R1(omega)."""
        return self._of_photos[0]

    @property
    def photo_covariances(self) -> Float[np.ndarray, "photo 6 6"]:
        """Of omega, phi, kappa, X, Y, Z of each photo."""
        return self._of_photos[1]

    @property
    def angle_deviations(self) -> Float[np.ndarray, "photo 3"]:
        """Standard deviations of the angles, in radians."""
        return _deviations(self.photo_covariances)[:, :3]

    @property
    def centre_deviations(self) -> Float[np.ndarray, "photo 3"]:
        """Standard deviations of the projection centres."""
        return _deviations(self.photo_covariances)[:, 3:]

    # ---------------------------------------------------------------------------------
    # points

    @property
    def coordinates(self) -> Float[np.ndarray, "point 3"]:
        """The points on the ground."""
        points = self.adjustment.parameters["point"]
        return self.numbered.spread(self.frame.outside(points))

    @property
    def point_covariances(self) -> Float[np.ndarray, "point 3 3"]:
        """The covariance of each point."""
        q = np.asarray(self.adjustment.cofactors["point"])
        return self.numbered.spread((self.sigma0 * self.frame.length) ** 2 * q)

    @property
    def deviations(self) -> Float[np.ndarray, "point 3"]:
        """Standard deviations of the points."""
        return _deviations(self.point_covariances)

    @property
    def as_start(self) -> Start:
        """Stations and points, to begin another adjustment with."""
        points = np.asarray(self.adjustment.parameters["point"])
        return _start(self.frame, self.numbered, self.stations, points)

    # ---------------------------------------------------------------------------------
    # residuals

    @property
    def residuals(self) -> Float[np.ndarray, "ray 2"]:
        """What would have to be added to x and y of each ray, so that they fit."""
        used = self.numbered.rays
        white = np.asarray(self.adjustment.residuals[0])
        sign = np.array([-1.0, 1.0])
        return self._of_rays(white * self.block.sigma[used][:, None] * sign)

    @property
    def misfits(self) -> Float[np.ndarray, "ray 2"]:
        """Place of the adjusted point minus measured place, of all rays: the
        `residuals`, and what they would be of the rays that were left out."""
        from scipy.spatial.transform import Rotation

        block, photo = self.block, self.block.photo
        w, x, y, z = np.asarray(self.stations.quaternion).T
        turn = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
        away = self.coordinates[block.point] - self.centres[photo]
        at = np.einsum("rij,rj->ri", turn[photo], away)
        plane = at[:, :2] / at[:, 2:] * block.focal[photo, None] * np.array([1, -1])
        return plane - np.stack([block.x, block.y], axis=1)

    @property
    def redundancy(self) -> Float[np.ndarray, "ray 2"]:
        """The redundancy numbers of x and y of each ray."""
        return self._of_rays(np.asarray(self.adjustment.redundancy[0]))

    @property
    def control_residuals(self) -> Float[np.ndarray, "known 3"]:
        """What would have to be added to the known coordinates."""
        if len(self.adjustment.residuals) < 2:
            return self._of_control(np.zeros(0))
        white = np.asarray(self.adjustment.residuals[1])[:, 0]
        return self._of_control(-white * self.known.sigma[self._there])

    @property
    def control_redundancy(self) -> Float[np.ndarray, "known 3"]:
        """The redundancy numbers of the known coordinates."""
        if len(self.adjustment.redundancy) < 2:
            return self._of_control(np.zeros(0))
        return self._of_control(np.asarray(self.adjustment.redundancy[1])[:, 0])

    @property
    def _there(self) -> np.ndarray:
        """The known coordinates of points in the adjustment."""
        return self.numbered.number[self.known.point] >= 0

    def _of_rays(self, values: np.ndarray) -> np.ndarray:
        out = np.full((len(self.block.photo), 2), np.nan)
        out[self.numbered.rays] = values
        return out

    def _of_control(self, values: np.ndarray) -> np.ndarray:
        number = 0 if self.ground is None else len(self.ground.points)
        out = np.full((number, 3), np.nan)
        there = self._there
        out[self.known.row[there], self.known.axis[there]] = values
        return out


class Prepared(NamedTuple):
    """What is to be adjusted: the problem of the engine, and where its numbers come
    from."""

    block: MeasuredBlock
    ground: Ground | None
    frame: Frame
    numbered: Numbered
    known: KnownCoordinates
    problem: Problem
    datum: DatumOf | None

    def start_at(self, found: Minimum) -> Start:
        """The stations and points of a minimum, to begin another adjustment with."""
        families = found.problem.data.families
        photos, points = len(self.block.photos), int(np.max(self.numbered.number)) + 1
        station = jax.tree.map(lambda a: np.asarray(a)[:photos], families["photo"])
        return _start(
            self.frame, self.numbered, station, np.asarray(families["point"])[:points]
        )


def _start(
    units: Frame, numbered: Numbered, station: Station, points: np.ndarray
) -> Start:
    return Start(
        quaternions=np.asarray(station.quaternion),
        centres=units.outside(station.centre),
        points=numbered.spread(units.outside(points)),
    )


def adjust_block(
    block: MeasuredBlock, start: Start, ground: Ground | None = None
) -> BlockAdjustment:
    """Adjust a block from approximate stations and points.

    Without known points the network is free: its datum is that of the approximate
    stations (inner constraints). Points on one photo, of which nothing else is known,
    are left out. Failures are values of `adjustment.result`.
    """
    prepared = prepare_block(block, start, ground)
    datum = prepared.datum
    return conclude(prepared, minimise(prepared.problem, datum=datum))


def prepare_block(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None = None,
    left_out: Bool[np.ndarray, " ray"] | None = None,
) -> Prepared:
    """The problem of a block at its approximate values, some rays left out."""
    units = frame_of(start)
    none = Ground((), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    known = control_of(block, none if ground is None else ground)
    of_points = np.bincount(known.point, minlength=len(block.points))
    use = np.ones(len(block.photo), bool) if left_out is None else ~left_out
    # a known point on one photo begins where it is known to be
    points, at = start.points.copy(), (known.point, known.axis)
    points[at] = np.where(np.isnan(points[at]), known.value, points[at])
    there = np.all(np.isfinite(points), axis=1)
    numbered = number_points(block, of_points, use & there[block.point])
    terms = terms_of(block, numbered, known, units)
    inside = jnp.asarray(units.inside(start.centres))
    stations = Station(jnp.asarray(start.quaternions), inside)
    points = units.inside(points[numbered.number >= 0])
    families = {"photo": stations, "point": points}
    problem = prepare(terms, families, eliminate="point", linked="photo")
    datum = free_datum(stations) if len(terms) == 1 else None
    return Prepared(
        block=block,
        ground=ground,
        frame=units,
        numbered=numbered,
        known=known,
        problem=problem,
        datum=datum,
    )


def conclude(prepared: Prepared, found: Minimum) -> BlockAdjustment:
    """The adjustment at the minimum."""
    block, ground, units, numbered, known, _, datum = prepared
    adjustment = read(found, datum)
    return BlockAdjustment(block, ground, units, numbered, known, adjustment)


def _angles(
    data: tuple[Station, Float[Array, "photo 6 6"]],
) -> tuple[Float[Array, "photo 3"], Float[Array, "photo 6 6"]]:
    """Angles of all photos, and the cofactors of angles and centre."""

    def of_photo(station: Station, q: Array) -> tuple[Array, Array]:
        def values(step: Array) -> Array:
            moved = station.move(step).normalise()
            turn = rot.from_quaternion(*(moved.quaternion[k] for k in range(4)))
            # from y down and z forward to y up and z backward
            m = turn[0], rot.scale(turn[1], -1.0), rot.scale(turn[2], -1.0)
            return jnp.concatenate([jnp.stack(rot.omega_phi_kappa(m)), moved.centre])

        origin = jnp.zeros(6)
        j = jax.jacfwd(values)(origin)
        return values(origin)[:3], j @ q @ j.T

    return jax.vmap(of_photo)(*data)


def _deviations(covariances: Float[np.ndarray, "some d d"]) -> np.ndarray:
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
