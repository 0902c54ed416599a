"""How well the distortion of an image is known, apart from what its pose imitates.

The principal place and the focal length are known much less well than the distortion:
a shift of the principal place is nearly a tilt, a change of the focal length nearly one
of the distance. Corrected coordinates share such errors, and do not contradict one
another by them.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adjustment import symmetric
from ..adjustment.guarded import root
from .correct import ideal
from .images import Places
from .result import Calibration


def distortion_deviations(
    found: Calibration, places: Float[Array, "n 2"]
) -> Float[Array, "n 2"]:
    """Standard deviations of `correct`'s places after the best shift, scale, swing and
    two tilts over the measured area have been taken out of their errors; in the unit of
    the image, of first order, from the calibration alone."""
    at, slopes = ideal(found, found.frame.normal_places(places))
    of_grid, slopes_of_grid = ideal(found, found.area.grid)
    pose = _pose_patterns(of_grid).reshape(-1, 6)
    normal = symmetric.inverse(pose.T @ pose).matrix
    rows = slopes_of_grid.reshape(len(pose), -1)
    part = normal @ (pose.T @ rows)
    left = slopes - jnp.einsum("ncp,pk->nck", _pose_patterns(at), part)
    covariance = found.covariance[6:, 6:]
    variances = jnp.einsum("nci,ij,ncj->nc", left, covariance, left)
    return root(jnp.maximum(variances, 0.0)) * found.frame.size


def _pose_patterns(at: Places) -> Float[Array, "n 2 6"]:
    """The displacements by two shifts, scale, swing and two tilts."""
    x, y = at.T
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    along_x = jnp.stack([one, zero, x, -y, x * x, x * y], axis=1)
    along_y = jnp.stack([zero, one, y, x, x * y, y * y], axis=1)
    return jnp.stack([along_x, along_y], axis=1)
