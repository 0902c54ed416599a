"""What the result of a calibration is called: a table in the order of precedence."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import adjustment
from ..adjustment import JointAdjustment
from .images import MeasuredImage
from .models import Model
from .results import RESULTS, of_adjustment
from .starts import NEARLY_FLAT, thickness

FLAT = 1e-6
"""Thickness of an object over its extent below which it is a plane."""

OF_A_PLANE = 2
"""Numbers of the inner orientation that the image of a plane tells: a homography has
eight, station and rotation take six."""

WEAK = 0.05
"""Standard deviation of a station over its distance above which it is not
determined."""


def verdict(
    measured: MeasuredImage,
    model: Model,
    free: Float[Array, ""],
    focal: Float[Array, "point 2 zone"],
    found: JointAdjustment,
) -> RESULTS:
    """The `RESULTS` of a finished adjustment; `free`: how many numbers of the inner
    orientation are."""
    number = 2 * jnp.sum(measured.mask)
    spare = number - model.unknowns
    thick = thickness(measured.points, measured.mask)
    station = found.parameters["station"]
    deviations = jnp.sqrt(jnp.diagonal(found.covariance("station")[0])[3:])
    distance = jnp.sqrt(jnp.sum(station.centre[0] ** 2))
    weak = ~(jnp.max(deviations) <= WEAK * distance)
    plane = (thick < FLAT) | ((thick < NEARLY_FLAT) & weak)
    flat = plane & (free > OF_A_PLANE)
    settled = found.result == adjustment.RESULTS.successful
    seen = jnp.any(focal != 0, axis=1) & measured.mask[:, None]
    support = jnp.sum(seen, axis=0)
    # the first one that holds
    table = (
        (RESULTS.too_few_points, spare < 0),
        (RESULTS.empty_zone, jnp.any(support == 0)),
        (RESULTS.plane_object, flat),
        (of_adjustment(found.result), ~settled),
        (RESULTS.no_redundancy, spare == 0),
        (RESULTS.weakly_determined, weak),
    )
    result = RESULTS.successful
    for name, holds in reversed(table):
        result = RESULTS.where(holds, name, result)  # pyright: ignore[reportArgumentType]
    return result  # pyright: ignore[reportReturnType]
