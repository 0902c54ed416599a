"""Object points from their places in two or more calibrated images, by weighted least
squares.

Each image k gives two conditions, the misfit g_k(X, β_k, m_k) = 0 of the object point X
with the place m_k and the calibration β_k. Both have errors, the places independent of
one another and the calibrations, too:

    Σ g_kᵀ G_k⁻¹ g_k = min,    G_k = B σ² Bᵀ + A C_k Aᵀ

with the derivatives B and A of the misfit by the place and by all parameters of the
calibration, and the covariance C_k of these. All is of first order.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .. import adjustment
from ..adjustment import critical_values, symmetric
from ..adjustment.guarded import root
from ..camera.condition import Camera, Measured, Rays, Station, corrected, scale
from ..geometry import rotations as rot
from ..xla.passes import count
from ..xla.programs import compiled
from .images import Frame, Points
from .models import field_weights, parameter_weights
from .result import Calibration
from .slopes import inverse_of_two, slopes_of_one

ROUNDS = 10
"""Steps of Gauss-Newton from the linear intersection; three are enough where the rays
nearly meet."""

SETTLED = 1e-3
"""The last step, in standard deviations, below which the steps have converged."""

WEAK = 0.05
"""Standard deviation of a point over its distance from the nearest station above which
it is not determined."""


class RESULTS(adjustment.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How the intersection of the rays of a point ended."""

    too_few_rays = (
        "The point is measured in fewer than two images. Measure it in another image."
    )
    small_angle = (
        "The rays meet at too small an angle: the standard deviation of the point is "
        "more than a twentieth of its distance. Measure it in an image that was taken "
        "from further aside."
    )
    behind = (
        "The rays meet behind one of the cameras. Look for places that belong to "
        "another point, and for images that are mirrored."
    )


class Sight(NamedTuple):
    """What an image contributes to every point: its calibration, and places with the
    weights of the focal lengths and the field there; in the units of its `frame`."""

    frame: Frame
    station: Station
    camera: Camera
    covariance: Float[Array, "p p"]
    measured: Measured
    variance: Float[Array, " point"]
    use: Bool[Array, " point"]


class Triangulated(eqx.Module):
    """Object points, in the units of the object.

    `points` and their `covariances`; NaN where `result` is not successful. `squares`:
    the sum of squares of each point, with `degrees_of_freedom`: two for each image less
    three; `probability`: that it is larger by chance. It is small where a place is
    wrong. `angle`: the largest angle between two of the rays, in radians. `freedom`:
    the degrees of freedom of the variances, those of the calibrations in use together.
    `result`: a value of `RESULTS` for each point.
    """

    points: Points
    covariances: Float[Array, "point 3 3"]
    squares: Float[Array, " point"]
    degrees_of_freedom: Int[Array, " point"]
    probability: Float[Array, " point"]
    angle: Float[Array, " point"]
    freedom: Float[Array, " point"]
    result: RESULTS
    influences: tuple[Float[Array, "point 3 _"], ...]
    calibrations: tuple[Float[Array, "_ _"], ...]

    @property
    def deviations(self) -> Float[Array, "point 3"]:
        """Standard deviations of X, Y, Z."""
        return root(jnp.diagonal(self.covariances, axis1=1, axis2=2))

    @property
    def usable(self) -> Bool[Array, " point"]:
        """Whether the points may be used."""
        return self.result == RESULTS.successful

    def covariance_of(self, first: int, second: int) -> Float[Array, "3 3"]:
        """The covariance of two points, rows of the first and columns of the second:
        they share the errors of the calibrations."""
        if first == second:
            return self.covariances[first]
        parts = [
            influence[first] @ own @ influence[second].T
            for influence, own in zip(self.influences, self.calibrations, strict=True)
        ]
        return jnp.sum(jnp.stack(parts), axis=0)

    def interval(self, level: float = 0.95) -> Float[Array, " point"]:
        """Half the width of a confidence interval, in standard deviations (Student)."""
        return jnp.asarray(critical_values.half_width(level, self.freedom))


def triangulate(
    calibrations: Sequence[Calibration],
    places: Float[ArrayLike, "image point 2"],
    *,
    sigma: Float[ArrayLike, "..."] | None = None,
) -> Triangulated:
    """Intersect the rays of new points in calibrated images.

    `places`: NaN where a point is not measured in an image. `sigma`: the standard
    deviation of the places, for all, for each image (image, 1) or for each place; if it
    is not given, that of the places of each calibration, with its sigma0.

    The images have been calibrated one by one, with places of other points: the
    covariances hold for calibrations that are independent of one another and of the
    places. Raises RuntimeError for a calibration that cannot be used, and ValueError
    for fewer than two images or places of another shape.
    """
    places = jnp.asarray(places, float)
    number = len(calibrations)
    if number < 2:
        raise ValueError(f"triangulate: at least two images are needed, got {number}")
    if places.ndim != 3 or (places.shape[0], places.shape[2]) != (number, 2):
        raise ValueError(
            f"triangulate: {number} images need places of the shape ({number}, points, "
            f"2), got {places.shape}"
        )
    for found in calibrations:
        found.check()
    deviations = _sigmas(calibrations, places, sigma)
    sights = tuple(map(_sight, calibrations, places, deviations))
    rays = tuple(found.model.rays for found in calibrations)
    freedom = jnp.stack([found.degrees_of_freedom for found in calibrations])
    return _intersect_all(sights, freedom.astype(float), rays=rays)


def _sigmas(
    calibrations: Sequence[Calibration], places: Array, sigma: ArrayLike | None
) -> Float[Array, "image point"]:
    """The standard deviation of every place."""
    if sigma is None:
        each = [
            found.sigma0
            * jnp.sqrt(jnp.mean(found.measured.sigma**2, where=found.measured.mask))
            for found in calibrations
        ]
        sigma = jnp.stack(each)[:, None]
    return jnp.broadcast_to(jnp.asarray(sigma, float), places.shape[:2])


def _sight(found: Calibration, places: Array, sigma: Array) -> Sight:
    use = jnp.all(jnp.isfinite(places), axis=1) & (sigma > 0)
    places = jnp.where(use[:, None], places, found.frame.centre[None])
    u = found.frame.normal_places(places)
    weights = parameter_weights(found.model, u, found.area, found.basis)
    field = field_weights(found.model, u, found.area)
    return Sight(
        frame=found.frame,
        station=found.station,
        camera=found.camera,
        covariance=found.covariance,
        measured=Measured(u, jnp.zeros((len(u), 3)), weights, field),
        variance=(jnp.where(use, sigma, 1.0) / found.frame.size) ** 2,
        use=use,
    )


@compiled
def _intersect_all(
    sights: tuple[Sight, ...],
    freedom: Float[Array, " image"],
    *,
    rays: tuple[Rays, ...],
) -> Triangulated:
    """All points, one by one."""
    per_place = lambda s: (s.measured, s.variance, s.use)

    def of_point(own) -> dict[str, Any]:
        one = tuple(
            sight._replace(measured=m, variance=v, use=u)
            for sight, (m, v, u) in zip(sights, own, strict=True)
        )
        return _intersect(one, rays, freedom)

    found = jax.vmap(of_point)(tuple(map(per_place, sights)))
    return Triangulated(**found, calibrations=tuple(s.covariance for s in sights))


class _Condition(NamedTuple):
    """The misfit of a point in an image, its weights, and its derivatives by X and by
    the parameters of the calibration; zero where it is not measured."""

    misfit: Float[Array, "2"]
    weight: Float[Array, "2 2"]
    by_point: Float[Array, "2 3"]
    by_calibration: Float[Array, "2 p"]


def _intersect(
    sights: tuple[Sight, ...], rays: tuple[Rays, ...], freedom: Float[Array, " image"]
) -> dict[str, Any]:
    """What a `Triangulated` says of one point; every `Sight` is without its axis of
    points."""
    use = jnp.stack([sight.use for sight in sights])
    lines = [_line(s, r) for s, r in zip(sights, rays, strict=True)]
    centres, directions, spread = map(jnp.stack, zip(*lines, strict=True))
    start = _nearest(centres, directions, use)
    ahead = jnp.sum((start[None] - centres) * directions, axis=1) > 0
    angle = _largest_angle(directions, use)

    def solve(x: Array):
        conditions = [_condition(s, r, x) for s, r in zip(sights, rays, strict=True)]
        normal = sum(c.by_point.T @ c.weight @ c.by_point for c in conditions)
        right = sum(c.by_point.T @ c.weight @ c.misfit for c in conditions)
        found = symmetric.inverse(normal)  # pyright: ignore[reportArgumentType]
        return conditions, found, -found.matrix @ right

    def nearer(_, state):
        x, _ = state
        step = solve(x)[2]
        return x + step, step

    x, last = jax.lax.fori_loop(0, ROUNDS, nearer, (start, jnp.zeros(3)))
    conditions, inverse, _ = solve(x)
    squares = [c.misfit @ c.weight @ c.misfit for c in conditions]
    squares = jnp.sum(jnp.stack(squares))
    number = count(use)
    spare = 2 * jnp.sum(use) - 3
    apart = jnp.sum((x[None] - centres) ** 2, axis=1)
    distance = root(jnp.min(jnp.where(use, apart, jnp.inf)))
    variances = jnp.diagonal(inverse.matrix)
    result = _result(
        few=number < 2,
        parallel=angle * WEAK < jnp.max(jnp.where(use, spread, 0.0)),
        behind=jnp.any(~ahead & use),
        settled=jnp.all(last**2 <= SETTLED**2 * variances),
        weak=~(jnp.max(variances) <= (WEAK * distance) ** 2),
    )
    right = result == RESULTS.successful
    kept = lambda a: jnp.where(right, a, jnp.nan)
    return dict(
        points=kept(x),
        covariances=kept(inverse.matrix),
        squares=kept(squares),
        degrees_of_freedom=spare,
        probability=kept(critical_values.chi_squared_p(squares, spare)),
        angle=angle,
        freedom=jnp.sum(jnp.where(use, freedom, 0.0)),
        result=result,
        influences=tuple(
            -inverse.matrix @ c.by_point.T @ c.weight @ c.by_calibration
            for c in conditions
        ),
    )


def _condition(sight: Sight, rays: Rays, x: Float[Array, "3"]) -> _Condition:
    """What an image says of a point at x, in the units of the object."""
    measured = sight.measured._replace(point=sight.frame.normal_points(x))
    at = slopes_of_one(rays, sight.station, sight.camera, measured)
    of_place = sight.variance * (at.place @ at.place.T)
    of_calibration = at.parameters @ sight.covariance @ at.parameters.T
    cofactor = jnp.where(sight.use, of_place + of_calibration, jnp.eye(2))
    used = lambda a: jnp.where(sight.use, a, 0.0)
    return _Condition(
        misfit=used(at.misfit),
        weight=used(inverse_of_two(cofactor)),
        by_point=used(at.point / sight.frame.length),
        by_calibration=used(at.parameters),
    )


class _Line(NamedTuple):
    """The station and the direction of a ray, in the system of the object, and the
    standard deviation of the direction by that of the place, in radians."""

    centre: Float[Array, "3"]
    direction: Float[Array, "3"]
    spread: Float[Array, ""]


def _line(sight: Sight, rays: Rays) -> _Line:
    focal = scale(sight.camera, sight.measured)
    p = corrected(sight.camera, sight.measured) / focal
    turn = rot.from_quaternion(*(sight.station.quaternion[k] for k in range(4)))
    direction = rot.unit(rot.apply(rot.transpose(turn), rays.direction(p)))
    return _Line(
        centre=sight.frame.object_points(sight.station.centre),
        direction=jnp.stack(direction),
        spread=jnp.sqrt(sight.variance) / jnp.min(focal),
    )


def _nearest(
    centres: Float[Array, "image 3"],
    directions: Float[Array, "image 3"],
    use: Bool[Array, " image"],
) -> Float[Array, "3"]:
    """The point nearest to all rays, Σ (1 - d dᵀ)(X - S) = 0; about the mean station,
    so that large coordinates lose no digits."""
    weight = jnp.where(use, 1.0, 0.0)
    middle = jnp.sum(weight[:, None] * centres, axis=0) / jnp.maximum(count(use), 1.0)
    across = jnp.eye(3)[None] - directions[:, :, None] * directions[:, None, :]
    across = across * weight[:, None, None]
    right = jnp.einsum("kij,kj->i", across, centres - middle[None])
    return middle + symmetric.inverse(jnp.sum(across, axis=0)).matrix @ right


def _largest_angle(
    directions: Float[Array, "image 3"], use: Bool[Array, " image"]
) -> Float[Array, ""]:
    """The largest angle between two rays, at most a right angle."""
    first, second = np.triu_indices(len(directions), 1)
    normal = jnp.cross(directions[first], directions[second])
    both = use[first] & use[second]
    sine = root(jnp.max(jnp.where(both, jnp.sum(normal**2, axis=1), 0.0)))
    return jnp.arcsin(jnp.minimum(sine, 1.0))


def _result(
    *, few: Array, parallel: Array, behind: Array, weak: Array, settled: Array
) -> RESULTS:
    """The first of these that holds. Rays that are nearly parallel meet anywhere, also
    behind the cameras."""
    table = (
        (RESULTS.too_few_rays, few),
        (RESULTS.small_angle, parallel),
        (RESULTS.behind, behind),
        (RESULTS.small_angle, weak),
        (RESULTS.diverged, ~settled),
    )
    result = RESULTS.successful
    for name, holds in reversed(table):
        result = RESULTS.where(holds, name, result)  # pyright: ignore[reportArgumentType]
    return result  # pyright: ignore[reportReturnType]
