"""Adjust a block, and read photos, points and control from the solution."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import RESULTS
from ..adjustment.sparse import (
    Minimum,
    SparseAdjustment,
    minimise,
    read,
    with_room,
)
from ..camera.condition import Station
from ..camera.field import Field
from ..camera.inner import Inner
from ..xla.programs import compiled
from .bars import Bars, no_bars
from .cameras import InnerParameters, cameras_of, in_photo_units, own_blocks
from .displacements import FoundField, areas_of, of_rays, read_fields
from .given import Given
from .measured_block import Ground, MeasuredBlock
from .network import (
    Frame,
    KnownCoordinates,
    Numbered,
    Start,
    angles_and_centre,
    places_of,
    ray_condition,
    spread_known,
)
from .prepared import Prepared, prepare_block, start_of


@dataclass(frozen=True)
class BlockAdjustment:
    """An adjusted block. Coordinates are those of the ground, residuals have the unit
    of the photo coordinates; standard deviations are a posteriori. NaN stands for what
    is not there: points that nothing determines, coordinates that are not known.
    `bar_rows`: the bars that take part."""

    block: MeasuredBlock
    ground: Ground | None
    frame: Frame
    numbered: Numbered
    known: tuple[KnownCoordinates, ...]
    inner: Inner | None
    bars: Bars | None
    adjustment: SparseAdjustment
    bar_rows: Int[np.ndarray, " used"]

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
        found = _angles(self.stations, cofactors)
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

    def compare(
        self, ground: Ground
    ) -> tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]]:
        """Adjusted minus given coordinates of all that is known, whether it took part or
        not, and the standard deviations of the adjusted ones; NaN where there are
        none."""
        number, station = ground.numbers_in(self.block), ground.station[:, None]
        point = np.where(ground.station, 0, number)
        photo = np.where(ground.station, number, 0)
        of = lambda centres, points: np.where(station, centres[photo], points[point])
        off = of(self.centres, self.coordinates) - ground.coordinates
        spread = of(self.centre_deviations, self.deviations)
        there = (number >= 0)[:, None]
        return np.where(there, off, np.nan), np.where(there, spread, np.nan)

    @property
    def as_start(self) -> Start:
        """Stations and points, to begin another adjustment with."""
        points = np.asarray(self.adjustment.parameters["point"])
        inner = self.adjustment.parameters.get("camera")
        return start_of(self.frame, self.numbered, self.stations, points, inner)

    # ---------------------------------------------------------------------------------
    # cameras

    @cached_property
    def cameras(self) -> InnerParameters:
        """The inner parameters of the cameras. Raises ValueError where none are
        unknown."""
        if self.inner is None:
            raise ValueError("BlockAdjustment: no inner parameters are unknown")
        return in_photo_units(
            self.inner,
            cameras_of(self.block),
            np.asarray(self.adjustment.parameters["camera"]),
            self._of_cameras,
        )

    @cached_property
    def _of_cameras(self) -> Float[np.ndarray, "all all"]:
        """The covariance of the parameters of all cameras together."""
        return self.sigma0**2 * self.adjustment.common_cofactor_of("camera")

    @property
    def field(self) -> Field | None:
        """How smooth and how large the displacement fields of the cameras are, if they
        have one."""
        found = None if self.inner is None else self.inner.field
        return found if isinstance(found, Field) else None

    @cached_property
    def fields(self) -> list[FoundField]:
        """The displacement fields of the cameras, if they have one."""
        if self.inner is None or self.field is None:
            return []
        found = np.asarray(self.adjustment.parameters["camera"])
        own = own_blocks(self._of_cameras, len(found))
        places = places_of(self.block)
        return read_fields(self.inner, self.block, places, found, own)

    # ---------------------------------------------------------------------------------
    # residuals

    @property
    def residuals(self) -> Float[np.ndarray, "ray 2"]:
        """What would have to be added to x and y of each ray, so that they fit."""
        used = self.numbered.rays
        white = np.asarray(self.adjustment.residuals[0])
        sign = np.array([-1.0, 1.0])
        return self._of_rays(white * self.block.sigma[used][:, None] * sign)

    @cached_property
    def misfits(self) -> Float[np.ndarray, "ray 2"]:
        """Place of the adjusted point minus measured place, of all rays: the
        `residuals`, and what they would be of the rays that were left out."""
        block, photo = self.block, self.block.photo
        points = self.frame.inside(np.nan_to_num(self.coordinates))[block.point]
        stations = jax.tree.map(lambda a: np.asarray(a)[photo], self.stations)
        camera = cameras_of(block).of_photo[photo]
        found = self._misfits_at(stations, points, camera, places_of(block))
        off = found * block.focal[photo, None]
        there = self.numbered.number[block.point] >= 0
        return np.where(there[:, None], off * np.array([-1.0, 1.0]), np.nan)

    @property
    def ideal_places(self) -> Float[np.ndarray, "ray 2"]:
        """The places of all rays as a camera without any distortion would show them, in
        units of its focal length, y downwards."""
        camera = cameras_of(self.block).of_photo[self.block.photo]
        return self.ideal(camera, places_of(self.block))

    def ideal(
        self, camera: Int[np.ndarray, " place"], places: Float[np.ndarray, "place 2"]
    ) -> Float[np.ndarray, "place 2"]:
        """The same of any places of the cameras of these numbers."""
        if self.inner is None:
            return places
        number = len(places)
        turned = np.tile([1.0, 0.0, 0.0, 0.0], (number, 1))
        here = Station(*jax.device_put((turned, np.zeros((number, 3)))))
        ahead = np.concatenate([places, np.ones((number, 1))], axis=1)
        scale = 1.0
        if self.inner.focal:
            own = np.asarray(self.adjustment.parameters["camera"])
            scale = 1.0 + own[camera, :1]
        return places + self._misfits_at(here, ahead, camera, places) / scale

    def _misfits_at(
        self,
        stations: Station,
        points: Float[np.ndarray, "place 3"],
        camera: Int[np.ndarray, " place"],
        places: Float[np.ndarray, "place 2"],
    ) -> Float[np.ndarray, "place 2"]:
        """The misfits of places from these stations to these points."""
        own, seen, block = (), places, self.block
        if self.inner is not None:
            of_photos = cameras_of(block)
            of_rows = of_photos.of_photo[block.photo], places_of(block)
            areas = areas_of(of_photos, *of_rows) if self.inner.modes else []
            own = (np.asarray(self.adjustment.parameters["camera"])[camera],)
            seen = places, of_rays(self.inner, areas, camera, places)
        data = with_room((stations, *own, points, seen))
        found = _misfits(*data, condition=ray_condition(self.inner))
        return np.asarray(found)[: len(places)]

    @property
    def redundancy(self) -> Float[np.ndarray, "ray 2"]:
        """The redundancy numbers of x and y of each ray."""
        return self._of_rays(np.asarray(self.adjustment.redundancy[0]))

    @property
    def control_residuals(self) -> Float[np.ndarray, "known 3"]:
        """What would have to be added to the known coordinates."""
        white = self._of_known(self.adjustment.residuals)
        both = zip(white, self.known, strict=True)
        return self._of_control([r * part.sigma for r, part in both])

    @property
    def control_redundancy(self) -> Float[np.ndarray, "known 3"]:
        """The redundancy numbers of the known coordinates."""
        return self._of_control(self._of_known(self.adjustment.redundancy))

    @property
    def bar_residuals(self) -> Float[np.ndarray, " bar"]:
        """What would have to be added to the lengths of the `bars`, NaN for those that
        take no part."""
        return self._of_bars(self.adjustment.residuals) * self.lengths.sigma

    @property
    def bar_redundancy(self) -> Float[np.ndarray, " bar"]:
        """The redundancy numbers of the lengths."""
        return self._of_bars(self.adjustment.redundancy)

    @property
    def lengths(self) -> Bars:
        """The bars, if there are none."""
        return no_bars() if self.bars is None else self.bars

    def _of_bars(self, values: list[np.ndarray]) -> np.ndarray:
        """Those of the last term, one for each bar that was given."""
        out = np.full(len(self.lengths.one), np.nan)
        if len(self.bar_rows):
            out[self.bar_rows] = np.asarray(values[-1])[:, 0]
        return out

    def _of_known(self, values: list[np.ndarray]) -> list[np.ndarray]:
        """Those of the terms of known coordinates, which come after that of the
        rays."""
        return [np.asarray(a)[:, 0] for a in values[1 : 1 + len(self.known)]]

    def _of_rays(self, values: np.ndarray) -> np.ndarray:
        out = np.full((len(self.block.photo), 2), np.nan)
        out[self.numbered.rays] = values
        return out

    def _of_control(self, values: list[np.ndarray]) -> np.ndarray:
        number = 0 if self.ground is None else len(self.ground.points)
        return spread_known(self.known, values, number)


def adjust_block(
    block: MeasuredBlock,
    start: Start,
    ground: Ground | None = None,
    inner: Inner | None = None,
    left_out: Bool[np.ndarray, " ray"] | None = None,
    bars: Bars | None = None,
) -> BlockAdjustment:
    """Adjust a block from approximate stations and points.

    `inner`: the inner parameters of the cameras that are unknown, too; `left_out`: rays
    that take no part, but keep their numbers; `bars`: known distances (a length that is
    NaN takes no part). Without known coordinates the network is free: its datum is that
    of the approximate photos (inner constraints on their places and turns). Points on
    one photo, of which nothing else is known, are left out. Failures are values of
    `adjustment.result`.
    """
    prepared = prepare_block(Given(block, ground, inner, bars), start, left_out)
    return conclude(prepared, minimise(prepared.problem, datum=prepared.datum))


def conclude(prepared: Prepared, found: Minimum) -> BlockAdjustment:
    """The adjustment at the minimum."""
    return BlockAdjustment(
        block=prepared.block,
        ground=prepared.ground,
        frame=prepared.frame,
        numbered=prepared.numbered,
        known=prepared.known,
        inner=prepared.inner,
        bars=prepared.bars,
        adjustment=read(found, prepared.datum),
        bar_rows=prepared.bar_rows,
    )


@compiled
def _misfits(*rays: Any, condition: Callable) -> Float[Array, "ray 2"]:
    """The misfit of each ray."""
    return jax.vmap(condition)(*rays)


@compiled
def _angles(
    stations: Station, cofactors: Float[Array, "photo 6 6"]
) -> tuple[Float[Array, "photo 3"], Float[Array, "photo 6 6"]]:
    """Angles of all photos, and the cofactors of angles and centre."""

    def of_photo(station: Station, q: Array) -> tuple[Array, Array]:
        def values(step: Array) -> Array:
            return angles_and_centre(station.move(step))

        origin = jnp.zeros(6)
        j = jax.jacfwd(values)(origin)
        return values(origin)[:3], j @ q @ j.T

    return jax.vmap(of_photo)(stations, cofactors)


def _deviations(covariances: Float[np.ndarray, "some d d"]) -> np.ndarray:
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
