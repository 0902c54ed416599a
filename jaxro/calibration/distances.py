"""The condition of the paper: distances between points in the image, which know nothing
of the measuring system (Yurchenko 2002, equation (1)).

    d_ij = |W(m_i) f ∘ p_i - W(m_j) f ∘ p_j|

From n points there are n(n-1)/2 distances, of 2n coordinates: only 2n - 3 of them are
independent. With their full cofactor matrix they give what the coordinates give
(`calibrate`), with more work, where one focal length serves both axes. Else they know
less: nothing tells them the direction of the measuring axes, which is one unknown more.
As if they were independent, they give nearly the same station, but standard deviations
that are too small by about √n / 2.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ..adjustment import LevenbergMarquardt, symmetric
from ..camera.condition import Rays, Station
from .calibrate import calibrate
from .images import MeasuredImage, Places
from .models import Model
from .problem import Observed
from .result import Calibration

ROUNDS = 100
"""Steps of Levenberg-Marquardt."""


class DistanceAdjustment(eqx.Module):
    """Station and focal lengths from distances, in the units of the frame of
    `coordinates`, which is the adjustment of the coordinates that it starts from.

    `cofactor`: of the turns about the camera's axes (without the swing, where one focal
    length serves both axes), the station, and the parameters of the focal lengths.
    """

    station: Station
    focal: Float[Array, " zone"]
    cofactor: Float[Array, "p p"]
    sigma0: Float[Array, ""]
    degrees_of_freedom: int = eqx.field(static=True)
    coordinates: Calibration

    @property
    def centre(self) -> Float[Array, "3"]:
        """The projection centre X, Y, Z."""
        return self.coordinates.frame.object_points(self.station.centre)

    @property
    def centre_deviations(self) -> Float[Array, "3"]:
        """Standard deviations of the projection centre."""
        begin = self.cofactor.shape[0] - self.focal.size - 3
        variances = jnp.diagonal(self.cofactor)[begin : begin + 3]
        return self.sigma0 * jnp.sqrt(variances) * self.coordinates.frame.length


def distances(places: Places) -> Float[Array, " pair"]:
    """The distances between all places, point by point."""
    first, second = _pairs(len(places))
    apart = places[first] - places[second]
    return jnp.sqrt(jnp.sum(apart**2, axis=1))


def adjust_distances(
    measured: MeasuredImage, model: Model | None = None, *, independent: bool = False
) -> DistanceAdjustment:
    """The adjustment of all distances between the points of one image.

    With their full cofactor matrix, or as if they were `independent`, as the paper has
    it, which makes the standard deviations far too small. Object points are without
    error. Raises ValueError for models of more than focal lengths, and masked points.
    """
    model = Model() if model is None else model
    if model.brown is not None or model.field is not None:
        raise ValueError("adjust_distances: a model has focal lengths alone")
    if not np.all(measured.mask):
        raise ValueError("adjust_distances: leave out the points that are masked")
    start = calibrate(measured, model)
    observed, weights = start.observed, start.focal_weights
    swing = model.y is not None

    def moved(x: Array) -> tuple[Station, Array]:
        turn = x[:3] if swing else jnp.concatenate([x[:2], jnp.zeros(1)])
        rest = x[3:] if swing else x[2:]
        step = jnp.concatenate([turn, rest[:3]])
        return start.station.move(step), start.camera.focal + rest[3:]

    residual = _independent if independent else _with_full_cofactor(observed.places)

    def residuals(x: Array, _) -> Array:
        station, focal = moved(x)
        scaled = _images(station, focal, weights, observed, model.rays)
        difference = distances(observed.places) - distances(scaled)
        return residual(difference) / observed.sigma

    count = (6 if swing else 5) + start.camera.focal.size
    found = optx.least_squares(
        residuals, LevenbergMarquardt(), jnp.zeros(count), max_steps=ROUNDS
    )
    jacobian = jax.jacfwd(residuals)(found.value, None)
    n = len(observed.places)
    rows = n * (n - 1) // 2 if independent else 2 * n - 3
    squares = jnp.sum(residuals(found.value, None) ** 2)
    station, focal = moved(found.value)
    return DistanceAdjustment(
        station=station.normalise(),
        focal=focal,
        cofactor=symmetric.inverse(jacobian.T @ jacobian).matrix,
        sigma0=jnp.sqrt(squares / (rows - count)),
        degrees_of_freedom=rows - count,
        coordinates=start,
    )


def _images(
    station: Station, focal: Array, weights: Array, observed: Observed, rays: Rays
) -> Places:
    """The images of the object points about the principal place."""

    def image(point, weight):
        ray = jnp.stack(rays(station.to_camera(point)))
        return jnp.sum(weight * focal[None], axis=1) * ray

    return jax.vmap(image)(observed.points, weights)


def _with_full_cofactor(places: Places):
    """A function of differences of distances that gives the smallest corrections of
    coordinates which explain them: (JᵀJ + N Nᵀ)⁻¹ Jᵀ of the differences, J the
    derivatives of the distances by the coordinates and N what no distance sees, two
    shifts and a turn."""
    n = len(places)
    j = jax.jacfwd(distances)(places).reshape(-1, 2 * n)
    x, y = (places - jnp.mean(places, axis=0)[None]).T
    one, zero = jnp.ones(n), jnp.zeros(n)
    unseen = [(one, zero), (zero, one), (-y, x)]
    rows = [jnp.stack(both, axis=1).reshape(-1) for both in unseen]
    rows = jnp.stack([row / jnp.sqrt(jnp.sum(row**2)) for row in rows])
    inverse = symmetric.inverse(j.T @ j + n * rows.T @ rows).matrix
    return lambda difference: inverse @ (j.T @ difference)


def _independent(difference: Array) -> Array:
    return difference


def _pairs(n: int) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]:
    return np.triu_indices(n, 1)
