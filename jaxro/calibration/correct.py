"""What a calibration makes of new coordinates: those of an ideal camera."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..adjustment.guarded import root
from .camera import Measured, corrected, scale
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
    places = jnp.asarray(places, float)
    u = found.frame.normal_places(places)
    weights = parameter_weights(found.model, u, found.area, found.basis)
    field = field_weights(found.model, u, found.area)
    focal = jnp.mean(found.basis @ found.camera.focal)
    measured = Measured(u, jnp.zeros((len(u), 3)), weights, field)
    ideal = lambda camera, one: focal * corrected(camera, one) / scale(camera, one)
    at = jax.vmap(partial(ideal, found.camera))(measured)
    slopes = jax.vmap(partial(jax.jacfwd(ideal), found.camera))(measured)
    j = jnp.concatenate(jax.tree.leaves(slopes), axis=2)
    own = found.covariance[6:, 6:]
    variances = jnp.einsum("nci,ij,ncj->nc", j, own, j)
    mean = jnp.sqrt(jnp.mean(found.measured.sigma**2, where=found.measured.mask))
    upward = jnp.array([1.0, -1.0])[None] * found.frame.size
    return Corrected(
        places=at * upward,
        deviations=root(variances) * found.frame.size,
        sigma=found.sigma0 * mean,
        inside=_among(found, np.asarray(places)),
        focal=focal * found.frame.size,
    )


def _among(found: Calibration, places: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Whether places lie in the convex hull of those that calibrated the image."""
    from scipy.spatial import Delaunay, QhullError  # slow to import

    mask = np.asarray(found.measured.mask)
    try:
        hull = Delaunay(np.asarray(found.measured.places)[mask])
    except (QhullError, ValueError):  # all on a line, or fewer than three
        return np.zeros(len(places), bool)
    return hull.find_simplex(places) >= 0
