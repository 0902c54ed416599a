"""The adjustment of several images: approximate values, the terms of places, known
points and cameras, and their solution with the object points eliminated."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adjustment import JointAdjustment, LevenbergMarquardt, Term, adjust
from ..camera.area import Area
from ..camera.condition import Camera, Measured, Rays, Station, misfit
from .first_stations import first_stations
from .images import Frame, frame_of
from .measured_images import MeasuredImages
from .problem import FIXED, MAX_STEPS, Prior, prior_term


class Approximate(eqx.Module):
    """Where the adjustment of several images begins, in the units of the frame: places,
    stations, cameras with one focal length and without a field, and points; and the
    standard deviation of a place."""

    frame: Frame
    places: Float[Array, "place 2"]
    area: Area
    stations: Station
    cameras: Camera
    points: Float[Array, "object_point 3"]
    sigma: Float[Array, ""]


def approximate(measured: MeasuredImages, rays: Rays) -> Approximate:
    """Approximate values of everything from the known points alone."""
    every = jnp.ones(len(measured.places), bool)
    known = jnp.all(jnp.isfinite(measured.point_sigma), axis=1)
    given = frame_of(
        measured.places, every, measured.points, known, measured.handedness
    )
    u = given.normal_places(measured.places)
    begin = first_stations(measured, given, u, rays)
    return Approximate(
        frame=given,
        places=u,
        area=Area(u, every, given.half_sides, jnp.zeros(2)),
        stations=begin.stations,
        cameras=begin.cameras,
        points=begin.points,
        sigma=jnp.sqrt(jnp.mean((measured.sigma / given.size) ** 2)),
    )


def solve_together(
    measured: MeasuredImages,
    begin: Approximate,
    focal: Float[Array, "place 2 zone"],
    field: Float[Array, "place 2 mode"],
    beforehand: Prior,
    rays: Rays,
    families: dict[str, Any],
    free_network: bool = False,
) -> JointAdjustment:
    """The adjustment of the families "station", "camera" and "point"; points are
    eliminated. Its residuals are those of the places, of the known points (but in a
    free network), and of what was known of the cameras."""
    condition = lambda station, camera, point, seen: misfit(
        rays, station, camera, Measured(seen[0], point, seen[1], seen[2])
    )
    of_places = Term(
        condition,
        (begin.places, focal, field),
        ((measured.sigma / begin.frame.size) ** 2, None, None),
        touches=[
            ("station", measured.image),
            ("camera", measured.camera[measured.image]),
            ("point", measured.point),
        ],
    )
    terms = [of_places, prior_term(beforehand, measured.cameras)]
    if not free_network:
        terms.insert(1, _known_points(measured, begin.frame))
    return adjust(
        terms,
        families,
        eliminate="point",
        constraints=_inner_constraints(begin.stations) if free_network else None,
        solver=LevenbergMarquardt(),
        max_steps=MAX_STEPS,
    )


def _known_points(measured: MeasuredImages, given: Frame) -> Term:
    """The object points as observations of what is known of them."""
    least = FIXED * jnp.min(measured.sigma) / given.size
    deviation = jnp.maximum(measured.point_sigma / given.length, least)
    known = jnp.all(jnp.isfinite(deviation), axis=1)
    variance = jnp.where(known[:, None], deviation, 1.0) ** 2
    return Term(
        lambda point, at: point - at,
        given.normal_points(measured.points),
        variance,
        touches=[("point", jnp.arange(len(measured.points)))],
        mask=known,
    )


def _inner_constraints(begin: Station) -> Callable[[dict[str, Any]], Array]:
    """`inner_constraints` of the family "station"."""
    return lambda families: inner_constraints(begin.centre, families["station"].centre)


def inner_constraints(
    begin: Float[Array, "image 3"], centres: Float[Array, "image 3"]
) -> Float[Array, "7"]:
    """Zero where displacements dS do not shift, turn or scale stations as a whole:
    Σ dS, Σ S × dS and Σ S · dS, with S from their centroid (Meissl 1962)."""
    about, moved = begin - jnp.mean(begin, axis=0)[None], centres - begin
    shift = jnp.sum(moved, axis=0)
    turn = jnp.sum(jnp.cross(about, moved), axis=0)
    scale = jnp.sum(about * moved)
    return jnp.concatenate([shift, turn, scale[None]])
