"""Approximate stations of several images, their cameras and object points, without any
knowledge of the user.

Images of known points are resected, by homographies with one focal length in common or
each by itself, and adjusted together with a simple lens; the better of both counts.
Then intersection and resection in turns (Yurchenko 2002) reach the other points and
images.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.ops import segment_sum
from jaxtyping import Array, Bool, Float

from ..adjustment import LevenbergMarquardt, Term, adjust
from ..adjustment.normal_equations import solve
from ..camera.brown import COEFFICIENTS
from ..camera.condition import Camera, Measured, Rays, Station, corrected, misfit, scale
from ..geometry import rotations as rot
from .calibrate import first_fit
from .images import Frame, MeasuredImage, Pair, Points, frame
from .known import Known
from .measured_images import FEWEST, TURNS, MeasuredImages
from .problem import Prior, prior_term
from .starts import focal_of, homography, right_angled

ROUGH = 0.01
"""Standard deviation of a place for a simple lens, in half sides of the area."""

CENTRED = 0.15
"""Standard deviation of the principal place from the middle of the area."""

MOST = 64
"""Points by which an image is resected."""

BENT = 0.3
"""Standard deviation of the radial coefficients k1 and k2."""

FIT_STEPS = 60
"""Steps of the adjustment of stations and simple lens."""


class Begin(NamedTuple):
    """Approximate values in the units of the frame; cameras have one focal length and
    no field."""

    stations: Station
    cameras: Camera
    points: Points


class _Seen(NamedTuple):
    """Places, points, and which of these are there; image by image, or of one."""

    places: Float[Array, "*image most 2"]
    points: Float[Array, "*image most 3"]
    use: Bool[Array, "*image most"]


class Lens(NamedTuple):
    """Deviations of the principal place from the middle, and of the focal length from
    1."""

    principal: float
    focal: float


UNKNOWN = Lens(CENTRED, float("inf"))
IDEAL = Lens(1e-3, 1e-3)
"""Of places that are free of distortion."""


def first_stations(
    measured: MeasuredImages, given: Frame, u: Float[Array, "place 2"], rays: Rays
) -> Begin:
    """The `Begin` of places u in the units of the frame."""
    known = jnp.all(jnp.isfinite(measured.point_sigma), axis=1)
    points = jnp.where(known[:, None], given.normal_points(measured.points), 0.0)
    oriented = _seen(measured, known) >= FEWEST
    seen = _images(measured, u, points, known)
    seen = seen._replace(use=seen.use & oriented[:, None])
    starts = [_by_planes(seen)]
    if measured.solid:
        alone, focals = jax.lax.map(lambda one: _resect(one, rays, UNKNOWN), seen)
        of_all = jnp.nanmedian(jnp.where(oriented, focals, jnp.nan))
        starts.append((alone, of_all))
    every = jax.tree.map(lambda *a: jnp.stack(a), *starts)
    every = jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, 0.0), every)
    fit = lambda start: _fit(measured, seen, rays, start)
    fits, squares = jax.lax.map(fit, every)
    stations, cameras = jax.tree.map(lambda a: a[jnp.argmin(squares)], fits)

    def resect_ideal(seen: _Seen, _: Station) -> Station:
        if measured.solid:
            return _resect(seen, rays, IDEAL)[0]
        return homography(*seen).station(jnp.ones(()))

    of_place = jax.tree.map(lambda a: a[measured.camera[measured.image]], cameras)
    p = jax.vmap(_ideal)(of_place, u)

    def turn(_, state):
        stations, points, oriented = state
        met, rays_of = _intersect(measured, stations, rays, p, oriented)
        there = known | (rays_of >= 2)
        points = jnp.where((there & ~known)[:, None], met, points)
        new = (_seen(measured, there) >= FEWEST) & ~oriented
        seen = _images(measured, p, points, there)
        stations = jax.lax.map(
            lambda of: jax.lax.cond(of[0], resect_ideal, lambda _, own: own, *of[1:]),
            (new, seen, stations),
        )
        return stations, points, oriented | new

    state = stations, points, oriented
    stations, points, oriented = jax.lax.fori_loop(0, TURNS, turn, state)
    met, _ = _intersect(measured, stations, rays, p, oriented)
    return Begin(stations, cameras, jnp.where(known[:, None], points, met))


def _seen(
    measured: MeasuredImages, there: Bool[Array, " point"]
) -> Float[Array, " image"]:
    """How many points that are there each image shows."""
    weight = jnp.where(there[measured.point], 1.0, 0.0)
    return segment_sum(weight, measured.image, measured.camera.shape[0])


def _images(
    measured: MeasuredImages,
    places: Float[Array, "place 2"],
    points: Points,
    there: Bool[Array, " point"],
) -> _Seen:
    """What each image shows of the points that are there, at most `MOST` of them."""
    rows = measured.rows
    some = jnp.minimum(rows, len(places) - 1)
    use = (rows < len(places)) & there[measured.point[some]]
    first = jnp.argsort(jnp.where(use, 0, 1), axis=1, stable=True)[:, :MOST]
    some = jnp.take_along_axis(some, first, axis=1)
    return _Seen(
        places=places[some],
        points=points[measured.point[some]],
        use=jnp.take_along_axis(use, first, axis=1),
    )


# -------------------------------------------------------------------------------------
# resection


def _by_planes(seen: _Seen) -> tuple[Station, Array]:
    """Stations by homographies, with one focal length from all of them."""
    planes = jax.vmap(homography)(*seen)
    enough = jnp.sum(seen.use, axis=1) >= FEWEST
    product, square = jax.vmap(right_angled)(planes.h)
    of_all = lambda a: jnp.sum(jnp.where(enough, a, 0.0))
    focal = focal_of(of_all(product), of_all(square))
    return jax.vmap(lambda plane: plane.station(focal))(planes), focal


def _resect(seen: _Seen, rays: Rays, lens: Lens) -> tuple[Station, Float[Array, ""]]:
    """One image by itself: its station and focal length."""
    used = lambda a: jnp.where(seen.use[:, None], a, 0.0)
    number = len(seen.use)
    one = MeasuredImage(
        places=used(seen.places),
        points=used(seen.points),
        sigma=jnp.full(number, ROUGH),
        point_sigma=jnp.zeros((number, 3)),
        mask=seen.use,
        handedness=jnp.ones(()),
        bad_input=jnp.zeros((), bool),
    )
    known = Known(
        principal=jnp.zeros(2),
        principal_sigma=jnp.full(2, lens.principal),
        focal=jnp.ones(()),
        focal_sigma=jnp.full((), lens.focal),
    )
    own, first = frame(one, jnp.ones(())), first_fit(one, known, rays)
    centre = own.object_points(first.station.centre)
    return Station(first.station.quaternion, centre), first.focal * own.size


def _fit(
    measured: MeasuredImages,
    seen: _Seen,
    rays: Rays,
    start: tuple[Station, Float[Array, ""]],
) -> tuple[tuple[Station, Camera], Float[Array, ""]]:
    """Stations and simple cameras adjusted together by the known points, and the sum of
    squares."""
    stations, focal = start
    cameras = measured.cameras
    flat = Camera(
        principal=jnp.zeros((cameras, 2)),
        focal=jnp.full((cameras, 1), focal),
        brown=jnp.zeros((cameras, COEFFICIENTS)),
        field=jnp.zeros((cameras, 0)),
    )
    fixed = (1e-3 * ROUGH) ** 2
    radial = jnp.array([BENT, BENT, 0.0, 0.0, 0.0, 0.0, 0.0])
    variance = Camera(
        principal=jnp.full(2, CENTRED**2),
        focal=jnp.full(1, jnp.inf),
        brown=jnp.maximum(radial**2, fixed),
        field=jnp.zeros(0),
    )
    one = jax.tree.map(lambda a: a[0], flat)
    beforehand = Prior(jax.tree.map(jnp.zeros_like, one), variance)
    ones, nothing = jnp.ones((2, 1)), jnp.zeros((2, 0))
    condition = lambda station, camera, seen: misfit(
        rays, station, camera, Measured(seen[0], seen[1], ones, nothing)
    )
    images, most = seen.use.shape
    image = jnp.repeat(jnp.arange(images), most)
    places, points = (a.reshape(images * most, -1) for a in (seen.places, seen.points))
    of_places = Term(
        condition,
        (places, points),
        (jnp.full(images * most, ROUGH**2), None),
        touches=[("station", image), ("camera", measured.camera[image])],
        mask=seen.use.reshape(-1),
    )
    found = adjust(
        [of_places, prior_term(beforehand, cameras)],
        {"station": stations, "camera": flat},
        solver=LevenbergMarquardt(),
        max_steps=FIT_STEPS,
    )
    squares = jnp.sum(found.residuals[0] ** 2)
    solved = found.parameters["station"], found.parameters["camera"]
    return solved, jnp.where(jnp.isfinite(squares), squares, jnp.inf)


# -------------------------------------------------------------------------------------
# intersection


def _ideal(camera: Camera, u: Pair) -> Pair:
    """A place free of distortion, with the focal length 1."""
    seen = Measured(u, jnp.zeros(3), jnp.ones((2, 1)), jnp.zeros((2, 0)))
    return corrected(camera, seen) / scale(camera, seen)


def _intersect(
    measured: MeasuredImages,
    stations: Station,
    rays: Rays,
    p: Float[Array, "place 2"],
    oriented: Bool[Array, " image"],
) -> tuple[Points, Float[Array, " point"]]:
    """The points nearest to their rays, Σ (1 - d dᵀ) (X - S) = 0, and of how many rays
    each is."""
    at = jax.tree.map(lambda a: a[measured.image], stations)
    use = oriented[measured.image]

    def of_ray(station: Station, p: Pair, use: Array) -> tuple[Array, Array, Array]:
        turn = rot.from_quaternion(*(station.quaternion[k] for k in range(4)))
        d = rot.unit(rot.apply(rot.transpose(turn), rays.direction(p)))
        d = jnp.stack(d)
        across = jnp.eye(3) - d[:, None] * d[None, :]
        weight = jnp.where(use, 1.0, 0.0)
        right = jnp.sum(across * station.centre[None], axis=1)
        used = lambda a: jnp.where(use, a, 0.0)
        return used(across), used(right), weight

    parts = jax.vmap(of_ray)(at, p, use)
    number = len(measured.points)
    n, h, met = (segment_sum(a, measured.point, number) for a in parts)
    n = n + jnp.where(met < 2, 1.0, 0.0)[:, None, None] * jnp.eye(3)[None]

    def meet(n: Array, h: Array) -> Array:
        lower = [[n[i, j] for j in range(i + 1)] for i in range(3)]
        return jnp.stack(solve(lower, [h[k] for k in range(3)]))

    return jax.vmap(meet)(n, h), met
