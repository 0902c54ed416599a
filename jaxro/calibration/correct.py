"""What a calibration makes of new coordinates: those of an ideal camera."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..adjustment.guarded import root
from ..camera.condition import Camera, Measured, corrected, scale
from ..xla.programs import compiled
from .images import Places
from .models import field_weights, parameter_weights
from .result import Calibration


class Corrected(NamedTuple):
    """Coordinates of an ideal camera with the one focal length `focal`: x to the right,
    y up, from the principal place, in the unit of the image.

    `deviations`: their standard deviations from those of the calibration alone, and
    `sigma`, which is to be squared and added to them, that of a measured coordinate.
    `inside`: whether a place lies among those that calibrated the image; elsewhere the
    correction is extrapolated.
    """

    places: Float[Array, "n 2"]
    deviations: Float[Array, "n 2"]
    sigma: Float[Array, ""]
    inside: Bool[np.ndarray, " n"]
    focal: Float[Array, ""]


def correct(found: Calibration, places: Float[ArrayLike, "n 2"]) -> Corrected:
    """Correct new coordinates of the image that was calibrated.

    They can be given to `jaxro.pair`, with `focal`, like those of a metric camera.
    Deviations are of first order.
    """
    places = np.asarray(places, float)
    at, deviations, sigma, focal = _correct(found, places)
    return Corrected(
        places=at,
        deviations=deviations,
        sigma=sigma,
        inside=_among(found, places),
        focal=focal,
    )


@compiled
def _correct(found: Calibration, places: Float[Array, "n 2"]) -> tuple[Array, ...]:
    """Places, deviations, sigma and focal length of `Corrected`."""
    at, slopes = ideal(found, found.frame.normal_places(places))
    own = found.covariance[6:, 6:]
    variances = jnp.einsum("nci,ij,ncj->nc", slopes, own, slopes)
    mean = jnp.sqrt(jnp.mean(found.measured.sigma**2, where=found.measured.mask))
    upward = jnp.array([1.0, -1.0])[None] * found.frame.size
    focal = jnp.mean(found.basis @ found.camera.focal)
    return (
        at * upward,
        root(variances) * found.frame.size,
        found.sigma0 * mean,
        focal * found.frame.size,
    )


def ideal(
    found: Calibration, u: Places
) -> tuple[Float[Array, "point 2"], Float[Array, "point 2 p"]]:
    """Places of an ideal camera from places u of the frame, and their derivatives by
    all parameters of the camera, in the units of the frame."""
    weights = parameter_weights(found.model, u, found.area, found.basis)
    field = field_weights(found.model, u, found.area)
    measured = Measured(u, jnp.zeros((len(u), 3)), weights, field)
    focal = jnp.mean(found.basis @ found.camera.focal)

    def place(camera: Camera, one: Measured) -> Array:
        return focal * corrected(camera, one) / scale(camera, one)

    at = jax.vmap(partial(place, found.camera))(measured)
    slopes = jax.vmap(partial(jax.jacfwd(place), found.camera))(measured)
    return at, jnp.concatenate(jax.tree.leaves(slopes), axis=2)


def _among(found: Calibration, places: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Whether places lie in the convex hull of those that calibrated the image."""
    from scipy.spatial import Delaunay, QhullError  # slow to import

    mask = np.asarray(found.measured.mask)
    try:
        hull = Delaunay(np.asarray(found.measured.places)[mask])
    except (QhullError, ValueError):  # all on a line, or fewer than three
        return np.zeros(len(places), bool)
    return hull.find_simplex(places) >= 0
