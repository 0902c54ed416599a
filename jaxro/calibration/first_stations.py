"""Approximate stations of several images, and approximate object points, without any
knowledge of the user: resection and intersection in turns (Yurchenko 2002)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.ops import segment_sum
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import solve
from ..geometry import rotations as rot
from .calibrate import first_fit
from .camera import Station, perspective
from .images import Frame, MeasuredImage, Places, Points, frame
from .known import NOTHING
from .measured_images import FEWEST, TURNS, MeasuredImages
from .starts import focal_of, homography, right_angled


class Inner(NamedTuple):
    """Approximate inner orientation of every image."""

    focal: Float[Array, " image"]
    principal: Float[Array, "image 2"]


class Begin(NamedTuple):
    """Approximate values in the units of the frame, and which points have some."""

    stations: Station
    inner: Inner
    points: Points
    there: Bool[Array, " point"]


def first_stations(
    measured: MeasuredImages, given: Frame, u: Float[Array, "place 2"]
) -> Begin:
    """Resection and intersection in turns: stations from the points that are there,
    then points from the rays of at least two images."""
    known = jnp.all(jnp.isfinite(measured.point_sigma), axis=1)
    fixed = jnp.where(known[:, None], given.normal_points(measured.points), 0.0)
    resect = _resect_solid if measured.solid else _resect_plane

    def turn(_, begin: Begin) -> Begin:
        there = begin.there[measured.point]
        seen = segment_sum(
            jnp.where(there, 1.0, 0.0), measured.image, measured.camera.shape[0]
        )
        stations, inner = resect(measured, u, begin)
        p = u - inner.principal[measured.image]
        p = p / inner.focal[measured.image][:, None]
        met, rays = _intersect(measured, stations, p, seen >= FEWEST)
        there = known | (rays >= 2)
        met = jnp.where((there & ~known)[:, None], met, fixed)
        return Begin(stations, inner, met, there)

    number = measured.camera.shape[0]
    nowhere = Station(jnp.zeros((number, 4)), jnp.zeros((number, 3)))
    inner = Inner(jnp.ones(number), jnp.zeros((number, 2)))
    begin = Begin(nowhere, inner, fixed, known)
    return jax.lax.fori_loop(0, TURNS, turn, begin)


def _points_of_images(
    measured: MeasuredImages, u: Float[Array, "place 2"], begin: Begin
) -> tuple[Array, Array, Array]:
    """Places, approximate points, and which of them are there, image by image."""
    rows = measured.rows
    some = jnp.minimum(rows, len(u) - 1)
    point = measured.point[some]
    return u[some], begin.points[point], (rows < len(u)) & begin.there[point]


def _resect_plane(
    measured: MeasuredImages, u: Float[Array, "place 2"], begin: Begin
) -> tuple[Station, Inner]:
    """By homographies, with one focal length from all of them."""
    places, points, use = _points_of_images(measured, u, begin)
    planes = jax.vmap(homography)(places, points, use)
    enough = jnp.sum(use, axis=1) >= FEWEST
    product, square = jax.vmap(right_angled)(planes.h)
    of_all = lambda a: jnp.sum(jnp.where(enough, a, 0.0))
    focal = focal_of(of_all(product), of_all(square))
    stations = jax.vmap(lambda plane: plane.station(focal))(planes)
    return stations, Inner(jnp.full(len(enough), focal), jnp.zeros((len(enough), 2)))


def _resect_solid(
    measured: MeasuredImages, u: Float[Array, "place 2"], begin: Begin
) -> tuple[Station, Inner]:
    """By the calibration of each image with one focal length."""

    def of_image(places: Places, points: Points, use: Array):
        used = lambda a: jnp.where(use[:, None], a, 0.0)
        one = MeasuredImage(
            places=used(places),
            points=used(points),
            sigma=jnp.ones(len(use)),
            point_sigma=jnp.zeros_like(points),
            mask=use,
            handedness=jnp.ones(()),
        )
        own, first = frame(one, jnp.ones(())), first_fit(one, NOTHING, perspective)
        centre = own.object_points(first.station.centre)
        station = Station(first.station.quaternion, centre)
        principal = own.measured_places(first.principal)
        return station, Inner(first.focal * own.size, principal)

    every = _points_of_images(measured, u, begin)
    return jax.lax.map(lambda parts: of_image(*parts), every)


def _intersect(
    measured: MeasuredImages,
    stations: Station,
    p: Float[Array, "place 2"],
    oriented: Bool[Array, " image"],
) -> tuple[Points, Float[Array, " point"]]:
    """The points nearest to their rays, Σ (1 - d dᵀ) (X - S) = 0, and of how many rays
    each is."""
    at = jax.tree.map(lambda a: a[measured.image], stations)
    use = oriented[measured.image]

    def of_ray(station: Station, p: Array, use: Array) -> tuple[Array, Array, Array]:
        turn = rot.from_quaternion(*(station.quaternion[k] for k in range(4)))
        one = jnp.ones_like(p[0])
        d = jnp.stack(rot.unit(rot.apply(rot.transpose(turn), (p[0], p[1], one))))
        across = jnp.eye(3) - d[:, None] * d[None, :]
        weight = jnp.where(use, 1.0, 0.0)
        right = jnp.sum(across * station.centre[None], axis=1)
        used = lambda a: jnp.where(use, a, 0.0)
        return used(across), used(right), weight

    parts = jax.vmap(of_ray)(at, p, use)
    number = len(measured.points)
    n, h, rays = (segment_sum(a, measured.point, number) for a in parts)
    n = n + jnp.where(rays < 2, 1.0, 0.0)[:, None, None] * jnp.eye(3)[None]

    def meet(n: Array, h: Array) -> Array:
        lower = [[n[i, j] for j in range(i + 1)] for i in range(3)]
        return jnp.stack(solve(lower, [h[k] for k in range(3)]))

    return jax.vmap(meet)(n, h), rays
