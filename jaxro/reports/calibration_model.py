"""Finished calibrations as names and NumPy values: what reports, files and pictures
read."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..adjustment import critical_values as critical
from ..calibration import Calibration, Comparison, Model, Rectangles, Rings, Whole
from ..calibration.distortion import distortion_deviations
from ..calibration.models import focal_weights
from ..calibration.results import RESULTS
from ..camera.brown import NAMES as BROWN
from ..camera.condition import Station
from ..camera.zones import AbstractZones
from ..plots import CorrectionMap
from ..tables.images import NamedImages
from ..xla.programs import compiled
from .calibration_tests import Compared, TestedZones

RESULT_NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}
"""Names of the results by their number."""

LEVEL = 0.05
"""Probability with which residuals without an error exceed their limit."""

DEGREES = ("constant", "linear", "quadratic", "cubic")


class Figures(NamedTuple):
    """What one program reads from a calibration. Angles are in radians.

    Of each measured point: `residuals`, what has to be added to its place so that it
    fits; `redundancy` of x and y; `w`, the residuals over their standard deviations;
    `ahead`: whether it lies in front of the camera. `area`: left, top, right and bottom
    of the measured area. `in_field`: how many parameters the coordinates determine of
    those of a field. `in_zones`: on how many points each focal length depends.
    """

    centre: Float[np.ndarray, "3"]
    centre_deviations: Float[np.ndarray, "3"]
    angles: Float[np.ndarray, "3"]
    angle_deviations: Float[np.ndarray, "3"]
    principal: Float[np.ndarray, "2"]
    principal_deviations: Float[np.ndarray, "2"]
    focal: Float[np.ndarray, " zone"]
    focal_deviations: Float[np.ndarray, " zone"]
    brown: Float[np.ndarray, "7"]
    brown_deviations: Float[np.ndarray, "7"]
    sigma0: Float[np.ndarray, ""]
    degrees_of_freedom: np.ndarray
    in_field: Float[np.ndarray, ""]
    in_zones: np.ndarray
    area: Float[np.ndarray, "4"]
    y_down: np.ndarray
    residuals: Float[np.ndarray, "point 2"]
    redundancy: Float[np.ndarray, "point 2"]
    w: Float[np.ndarray, "point 2"]
    ahead: np.ndarray


def read(found: Calibration) -> Figures:
    """The figures of a calibration, as NumPy values."""
    found_by_name = _read(found)
    return Figures(**jax.tree.map(np.asarray, found_by_name))


@compiled
def _read(found: Calibration) -> dict[str, Array]:
    """The fields of `Figures`."""
    measured, adjustment = found.measured, found.adjustment
    redundancy = adjustment.redundancy[0]
    testable = redundancy > critical.UNTESTABLE
    root = jnp.sqrt(jnp.where(testable, redundancy, 1.0))
    half = found.frame.half_sides * found.frame.size
    depth = jax.vmap(lambda point: found.station.to_camera(point)[2])
    used = focal_weights(found.model, found.observed.places, found.area) != 0
    seen = jnp.any(used, axis=1) & measured.mask[:, None]
    return dict(
        centre=found.centre,
        centre_deviations=found.centre_deviations,
        angles=found.angles,
        angle_deviations=_angle_deviations(found),
        principal=found.principal,
        principal_deviations=found.principal_deviations,
        focal=found.focal,
        focal_deviations=found.focal_deviations,
        brown=found.brown,
        brown_deviations=found.brown_deviations,
        sigma0=found.sigma0,
        degrees_of_freedom=found.degrees_of_freedom,
        in_field=_in_field(found),
        in_zones=jnp.sum(seen, axis=0),
        area=jnp.concatenate([found.frame.centre - half, found.frame.centre + half]),
        y_down=found.frame.handedness > 0,
        residuals=-found.misfits(measured.places, measured.points),
        redundancy=redundancy,
        w=jnp.where(testable, adjustment.residuals[0] / root, 0.0),
        ahead=depth(found.observed.points) > 0,
    )


def _angle_deviations(found: Calibration) -> Float[Array, "3"]:
    """Standard deviations of omega, phi, kappa."""

    def angles(turn: Array) -> Array:
        moved = found.station.move(jnp.concatenate([turn, jnp.zeros(3)]))
        stations = Station(moved.quaternion[None], moved.centre[None])
        where = lambda c: c.adjustment.parameters["station"]
        return eqx.tree_at(where, found, stations).angles

    slopes = jax.jacfwd(angles)(jnp.zeros(3))
    variances = jnp.diagonal(slopes @ found.covariance[:3, :3] @ slopes.T)
    return jnp.sqrt(jnp.maximum(variances, 0.0))


def _in_field(found: Calibration) -> Float[Array, ""]:
    """The number of a field's coefficients that are determined: each counts as the part
    of its a priori variance that the coordinates take away."""
    modes = found.camera.field.size
    if found.model.field is None or modes == 0:
        return jnp.zeros(())
    variances = jnp.diagonal(found.adjustment.cofactor)[-modes:]
    before = (found.model.field.strength * found.observed.sigma) ** 2
    return jnp.sum(1 - variances / before)


class Variant(NamedTuple):
    """A model that was compared with others; `left_out` in the unit of the image."""

    model: Model
    unknowns: float
    sigma0: float
    left_out: float
    behind: float
    """Its score minus that of the best."""


class Distances(NamedTuple):
    """Station and focal lengths by distances."""

    centre: np.ndarray
    centre_deviations: np.ndarray
    focal: np.ndarray
    focal_deviations: np.ndarray
    sigma0: float
    degrees_of_freedom: int


@dataclass(frozen=True)
class Photo:
    """A calibrated image: of its points names, places, and the rows of them in
    `figures`."""

    name: str
    camera: str
    found: Calibration
    figures: Figures
    names: list[str]
    places: np.ndarray
    residuals: np.ndarray
    redundancy: np.ndarray
    w: np.ndarray
    ahead: np.ndarray

    @property
    def result(self) -> str:
        """The name of its result."""
        return RESULT_NAMES[int(self.found.result._value)]

    @property
    def usable(self) -> bool:
        """Whether its numbers may be used."""
        return bool(self.found.usable)

    @property
    def expected_error(self) -> float:
        """The standard deviation with which the adjustment predicts a coordinate that
        it does not know, sigma0 sigma √((1 - r)/r): its median over the points, in the
        unit of the image."""
        r = np.clip(self.redundancy, 1e-3, 1.0)
        measured = self.found.measured
        own = np.asarray(measured.sigma)[np.asarray(measured.mask)]
        sigma = np.sqrt(np.mean(own**2))
        median = np.sqrt(np.median((1 - r) / r))
        return float(median * sigma * self.figures.sigma0)


def photo(
    name: str,
    camera: str,
    found: Calibration,
    names: list[str],
    rows: np.ndarray,
) -> Photo:
    """The `Photo` of these rows of the places that were adjusted."""
    figures = read(found)
    return Photo(
        name=name,
        camera=camera,
        found=found,
        figures=figures,
        names=names,
        places=np.asarray(found.measured.places)[rows],
        residuals=figures.residuals[rows],
        redundancy=figures.redundancy[rows],
        w=figures.w[rows],
        ahead=figures.ahead[rows],
    )


@dataclass(frozen=True)
class ObjectPoints:
    """Object points from several images."""

    names: list[str]
    coordinates: np.ndarray
    deviations: np.ndarray
    known: np.ndarray
    rays: np.ndarray


@dataclass(frozen=True)
class Done:
    """All that a call of `jaxro calibrate` found. `variants`: of each image that was
    calibrated alone, or of all images together. `chosen`: whether the evidence chose
    the model. `zones`: the tests of images with zones. `differences`: pairs of images
    whose distortions were compared. `known_has_deviations`: whether a principal place
    or focal length was given with a standard deviation. `few`: images with too few
    points for a choice, which got the simplest model."""

    title: str
    unit: str
    sigma_known: bool
    named: NamedImages
    photos: list[Photo]
    variants: dict[str, list[Variant]]
    together: bool
    chosen: bool
    maps: dict[str, CorrectionMap] = field(default_factory=dict)
    points: ObjectPoints | None = None
    distances: Distances | None = None
    known_has_deviations: bool = False
    zones: dict[str, TestedZones] = field(default_factory=dict)
    differences: list[Compared] = field(default_factory=list)
    few: tuple[str, ...] = ()

    @property
    def cameras(self) -> list[Photo]:
        """One usable image of each camera."""
        first: dict[str, Photo] = {}
        for one in self.photos:
            if one.usable:
                first.setdefault(one.camera, one)
        return list(first.values())

    @property
    def usable(self) -> bool:
        """Whether every image has usable numbers."""
        return all(one.usable for one in self.photos)

    def w(self, one: Photo) -> np.ndarray:
        """The residuals of an image over their standard deviations: with sigma a
        priori, where this was given, else with sigma0 (tau)."""
        sigma0 = float(one.figures.sigma0)
        return one.w if self.sigma_known else one.w / (sigma0 if sigma0 > 0 else 1.0)

    def limit(self, one: Photo) -> float:
        """What the largest |w| of an image exceeds with the probability LEVEL if no
        coordinate is wrong."""
        count, freedom = one.w.size, int(one.figures.degrees_of_freedom)
        return limit_of_w(count, freedom, sigma_known=self.sigma_known)


def limit_of_w(count: int, freedom: int, *, sigma_known: bool) -> float:
    """What |w| of the worst of `count` coordinates without an error exceeds with the
    probability LEVEL; infinite where sigma0 does not exist."""
    level = critical.sidak(LEVEL, max(count, 1))
    if sigma_known:
        return float(critical.normal(level))
    return float(critical.tau(level, freedom)) if freedom > 1 else np.inf


def variants(compared: Comparison, sigma: float) -> list[Variant]:
    """The models of a comparison, the best one first; `sigma`: of a coordinate."""
    figures = jax.tree.map(np.asarray, compared.figures)
    best = np.min(figures.score)
    behind = figures.score - (best if np.isfinite(best) else 0.0)
    return [
        Variant(
            model=compared.models[k],
            unknowns=float(figures.effective[k]),
            sigma0=float(figures.sigma0[k]),
            left_out=float(figures.left_out[k]) * sigma,
            behind=float(behind[k]),
        )
        for k in np.argsort(figures.score, kind="stable")
    ]


def distortion(found: Calibration, places: np.ndarray) -> np.ndarray:
    """`distortion_deviations` as NumPy values, by a program for 16, 32, ... places."""
    room = 1 << max(4, (len(places) - 1).bit_length())
    longer = np.pad(places, ((0, room - len(places)), (0, 0)), mode="edge")
    return np.asarray(compiled(distortion_deviations)(found, longer))[: len(places)]


# -------------------------------------------------------------------------------------
# models in words


def describe(model: Model) -> str:
    """A model in words."""
    parts = [_focals(model)]
    if model.brown is not None:
        parts.append(f"Brown {' '.join(lens_names(model))}")
    if model.field is not None:
        strength = float(model.field.strength)
        parts.append(f"field {model.field.length:g}, {strength:.3g} sigma")
    return " + ".join(parts)


def _focals(model: Model) -> str:
    plain = isinstance(model.x, Whole)
    if model.y is None:
        return "f" if plain else f"f in {describe_zones(model.x)}"
    if plain and isinstance(model.y, Whole):
        return "fx, fy"
    return f"fx in {describe_zones(model.x)}, fy in {describe_zones(model.y)}"


def describe_zones(zones: AbstractZones) -> str:
    """Zones in words."""
    number = lambda pieces: len(pieces.borders) - 1
    if isinstance(zones, Rectangles):
        columns, rows = number(zones.x), number(zones.y)
        degree = DEGREES[max(zones.x.degree, zones.y.degree)]
        if rows == 1:
            return f"{columns} strips along x, {degree}"
        if columns == 1:
            return f"{rows} strips along y, {degree}"
        return f"{columns} x {rows} rectangles, {degree}"
    if isinstance(zones, Rings):
        return f"{number(zones.r)} rings, {DEGREES[zones.r.degree]}"
    return f"{zones.count} zone{'s' * (zones.count > 1)}"


def lens_names(model: Model) -> list[str]:
    """The coefficients of Brown that are unknowns."""
    free: Sequence[bool] = () if model.brown is None else model.brown.free
    return [name for name, is_free in zip(BROWN, free, strict=False) if is_free]


def zone_names(model: Model) -> list[tuple[str, int]]:
    """The axis ("f", "fx", "fy") and the number in it, from 1, of every focal
    length."""
    first = "f" if model.y is None else "fx"
    found = [(first, k + 1) for k in range(model.x.count)]
    if model.y is not None:
        found += [("fy", k + 1) for k in range(model.y.count)]
    return found
