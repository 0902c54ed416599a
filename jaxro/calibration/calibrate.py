"""The calibration of a single image: station, tilts, and distortion by zones, by
Brown's coefficients or by a displacement field, from object points."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..camera.area import Area
from ..camera.condition import Camera, Rays
from ..xla.programs import compiled, is_traced
from ..xla.settings import MOMENT, settings_for
from .images import Frame, MeasuredImage, frame
from .known import NOTHING, Known, prior
from .models import Model, field_weights, imitating, parameter_weights
from .problem import Observed, solve
from .result import Calibration
from .starts import Start, candidates
from .verdict import verdict

FIRST_STEPS = 12
"""Steps by which the candidates of a start are told apart."""


def calibrate(
    measured: MeasuredImage, model: Model | None = None, known: Known = NOTHING
) -> Calibration:
    """Calibrate one image by the points in it.

    Minimises Σ (v/sigma)² over station, rotation, principal place, focal lengths and
    distortion; with a field, plus Σ (a/γ)² of its coefficients, which are observations
    of their a priori value zero. Without `model`: one focal length, no distortion.

    No approximate values are needed. Failures are values of `result`, never exceptions.
    Works under jit, vmap (`MeasuredImage` with one more axis) and grad.
    """
    model = Model() if model is None else model
    if is_traced((measured, known, model)):
        return _fit(
            measured, known, first_fit(measured, known, model.rays), model=model
        )
    first = first_start(measured, known, rays=model.rays)
    return _fit(measured, known, first, model=model)


def by_size(measured: MeasuredImage, *_: Any, **__: Any) -> dict[str, Any]:
    """How to compile for an image of so many points."""
    return settings_for(measured.mask.size, MOMENT)


@compiled(settings=by_size)
def first_start(measured: MeasuredImage, known: Known, *, rays: Rays) -> Start:
    """`first_fit` as a program that all models share."""
    return first_fit(measured, known, rays)


@compiled(settings=by_size)
def _fit(
    measured: MeasuredImage, known: Known, first: Start, *, model: Model
) -> Calibration:
    """The adjustment of a model that begins with the one focal length of `first`."""
    given = frame(measured, first.handedness)
    observed = observe(measured, given)
    area = Area(observed.places, measured.mask, given.half_sides, first.principal)
    basis = imitating(model, area)
    focal = parameter_weights(model, observed.places, area, basis)
    field = field_weights(model, observed.places, area)
    camera = Camera(
        principal=first.principal,
        focal=first.focal * jnp.sum(basis, axis=0),
        brown=jnp.zeros(0 if model.brown is None else 7),
        field=jnp.zeros(field.shape[2]),
    )
    beforehand = prior(model, camera, known, given, observed.sigma, basis)
    start = first.station, camera
    found = solve(observed, focal, field, beforehand, model.rays, start)
    return Calibration(
        measured=measured,
        model=model,
        frame=given,
        area=area,
        basis=basis,
        observed=observed,
        focal_weights=focal,
        field_weights=field,
        adjustment=found,
        result=verdict(measured, known.free(model), focal, found),
    )


def observe(measured: MeasuredImage, given: Frame) -> Observed:
    """The measurements in the units of the frame; masked points are zeros."""
    use = measured.mask[:, None]
    return Observed(
        places=jnp.where(use, given.normal_places(measured.places), 0.0),
        points=jnp.where(use, given.normal_points(measured.points), 0.0),
        variance=(measured.sigma / given.size) ** 2,
        point_variance=(measured.point_sigma / given.length) ** 2,
        mask=measured.mask,
    )


def first_fit(measured: MeasuredImage, known: Known, rays: Rays) -> Start:
    """The best adjustment with one focal length and without distortion, of all that
    `starts.candidates` lead to."""
    as_measured = observe(measured, frame(measured, jnp.ones(())))
    tried = candidates(
        as_measured.places, as_measured.points, measured.mask, measured.handedness
    )
    one = Model(rays=rays)
    basis = jnp.ones((1, 1))
    focal = jnp.ones((len(measured.mask), 2, 1))
    nothing = jnp.zeros((len(measured.mask), 2, 0))

    def fit(start: Start) -> tuple[Start, Array]:
        given = frame(measured, start.handedness)
        observed = observe(measured, given)
        camera = Camera(start.principal, start.focal[None], jnp.zeros(0), jnp.zeros(0))
        beforehand = prior(one, camera, known, given, observed.sigma, basis)
        start_of = start.station, camera
        found = solve(observed, focal, nothing, beforehand, rays, start_of, FIRST_STEPS)
        squares = sum(jnp.sum(r**2) for r in found.residuals)
        solved = jax.tree.map(lambda a: a[0], found.parameters)
        camera = solved["camera"]
        better = Start(
            solved["station"], camera.focal[0], camera.principal, start.handedness
        )
        return better, jnp.where(jnp.isfinite(squares), squares, jnp.inf)

    fitted, squares = jax.vmap(fit)(tried)
    # a plane object fits both handednesses: y points down then
    squares = jnp.where(tried.handedness > 0, squares, 2 * squares)
    best = jnp.argmin(squares)
    return jax.tree.map(lambda a: a[best], fitted)
