"""The adjustment of one image: the term of its measurements, the term of what is known
beforehand, and their solution."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment import JointAdjustment, LevenbergMarquardt, Term, adjust
from ..camera.condition import Camera, Measured, Rays, Station, misfit
from ..xla.passes import count
from .images import Places, Points

FIXED = 1e-6
"""Standard deviation, in units of sigma, of a coefficient that is not an unknown."""

MAX_STEPS = 100
"""Steps of Levenberg-Marquardt; weak images take 60."""


class Observed(eqx.Module):
    """The measurements of one image in the units of its frame: places, object points,
    variances of both, and which of the points are used."""

    places: Places
    points: Points
    variance: Float[Array, " point"]
    point_variance: Points
    mask: Bool[Array, " point"]

    @property
    def sigma(self) -> Float[Array, ""]:
        """The standard deviation of a place, as the mean over the points used."""
        number = jnp.maximum(count(self.mask), 1.0)
        mean = jnp.sum(jnp.where(self.mask, self.variance, 0.0)) / number
        return jnp.sqrt(jnp.where(mean > 0, mean, 1.0))


class Prior(eqx.Module):
    """What is known of the camera beforehand: values, and their variances; those of
    free parameters are infinite."""

    value: Camera
    variance: Camera


def measured_term(
    observed: Observed,
    focal: Float[Array, "point 2 zone"],
    field: Float[Array, "point 2 mode"],
    rays: Rays,
) -> Term:
    """The misfit of every point."""
    first = jnp.zeros((), int)
    variances = Measured(observed.variance, observed.point_variance, None, None)  # pyright: ignore[reportArgumentType]
    return Term(
        partial(misfit, rays),
        Measured(observed.places, observed.points, focal, field),
        variances,
        touches=[("station", first), ("camera", first)],
        mask=observed.mask,
    )


def prior_term(prior: Prior, cameras: int = 1) -> Term:
    """The parameters of each camera as observations of what is known of all of them."""
    value, variance = flat(prior.value), flat(prior.variance)
    known = jnp.isfinite(variance)
    of_each = lambda a: jnp.tile(a, cameras)
    return Term(
        lambda camera, row: flat(camera)[row[0]] - row[1],
        (of_each(jnp.arange(value.size)), of_each(value)),
        (None, of_each(jnp.where(known, variance, 1.0))),
        touches=[("camera", jnp.repeat(jnp.arange(cameras), value.size))],
        mask=of_each(known),
    )


def flat(camera: Camera) -> Float[Array, " parameter"]:
    """All parameters of a camera in a row."""
    return jnp.concatenate([a.reshape(-1) for a in jax.tree.leaves(camera)])


def solve(
    observed: Observed,
    focal: Float[Array, "point 2 zone"],
    field: Float[Array, "point 2 mode"],
    prior: Prior,
    rays: Rays,
    start: tuple[Station, Camera],
    max_steps: int = MAX_STEPS,
) -> JointAdjustment:
    """The adjustment of the families "station" and "camera", one member each. Its first
    residuals are those of the points, its second those of what was known."""
    terms = [measured_term(observed, focal, field, rays), prior_term(prior)]
    station, camera = jax.tree.map(lambda a: a[None], start)
    families = {"station": station, "camera": camera}
    return adjust(terms, families, solver=LevenbergMarquardt(), max_steps=max_steps)
