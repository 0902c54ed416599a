"""What the result of a calibration is called: a table in the order of precedence."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import adjustment
from ..adjustment import JointAdjustment
from .images import MeasuredImage
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
    free: Float[Array, ""],
    focal: Float[Array, "point 2 zone"],
    found: JointAdjustment,
) -> RESULTS:
    """The `RESULTS` of a finished adjustment; `free`: how many numbers of the inner
    orientation are."""
    spare = found.degrees_of_freedom
    thick = thickness(measured.points, measured.mask)
    weak = _is_weak(found)
    plane = (thick < FLAT) | ((thick < NEARLY_FLAT) & weak)
    flat = plane & (free > OF_A_PLANE)
    seen = jnp.any(focal != 0, axis=1) & measured.mask[:, None]
    support = jnp.sum(seen, axis=0)
    return _first(
        (RESULTS.non_finite_input, measured.bad_input),
        (RESULTS.too_few_points, spare < 0),
        (RESULTS.empty_zone, jnp.any(support == 0)),
        (RESULTS.plane_object, flat),
        *_of_all(found, weak),
    )


def verdict_of_several(found: JointAdjustment) -> RESULTS:
    """The `RESULTS` of an adjustment of several images."""
    few = RESULTS.too_few_points, found.degrees_of_freedom < 0
    return _first(few, *_of_all(found, _is_weak(found)))


Row = tuple[RESULTS, Bool[Array, ""]]


def _of_all(found: JointAdjustment, weak: Bool[Array, ""]) -> tuple[Row, Row, Row]:
    """What may be wrong with one image as with several."""
    settled = found.result == adjustment.RESULTS.successful
    return (
        (of_adjustment(found.result), ~settled),
        (RESULTS.no_redundancy, found.degrees_of_freedom == 0),
        (RESULTS.weakly_determined, weak),
    )


def _is_weak(found: JointAdjustment) -> Bool[Array, ""]:
    """Whether the deviation of a station is too large for its distance from the
    object, which lies about zero."""
    variances = jnp.diagonal(found.covariance("station"), axis1=1, axis2=2)[:, 3:]
    centres = found.parameters["station"].centre
    least = WEAK**2 * jnp.sum(centres**2, axis=1)
    return ~jnp.all(jnp.max(variances, axis=1) <= least)


def _first(*table: Row) -> RESULTS:
    """The first result of a table that holds."""
    result = RESULTS.successful
    for name, holds in reversed(table):
        result = RESULTS.where(holds, name, result)  # pyright: ignore[reportArgumentType]
    return result  # pyright: ignore[reportReturnType]
