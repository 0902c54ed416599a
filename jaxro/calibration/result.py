"""A finished calibration of one image, and what can be read from it."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..adjustment import JointAdjustment, critical_values
from ..adjustment.guarded import root, times
from ..camera.area import Area
from ..camera.brown import POWERS
from ..camera.condition import Camera, Measured, Station, misfit
from ..geometry import rotations as rot
from ..xla.passes import count
from .images import Frame, MeasuredImage
from .models import Model, field_weights, parameter_weights
from .problem import Observed
from .results import RESULTS, is_usable


class Calibration(eqx.Module):
    """The camera of one image with standard deviations.

    Properties are in the units of the image and of the object; standard deviations are
    a posteriori, from sigma0. `station`, `camera` and `adjustment` are in the units of
    the `frame`.
    """

    measured: MeasuredImage
    model: Model
    frame: Frame
    area: Area
    basis: Float[Array, "zone parameter"]
    observed: Observed
    focal_weights: Float[Array, "point 2 parameter"]
    field_weights: Float[Array, "point 2 mode"]
    adjustment: JointAdjustment
    result: RESULTS

    @property
    def station(self) -> Station:
        """Station and rotation, in the units of the frame."""
        return Station(
            self.adjustment.parameters["station"].quaternion[0],
            self.adjustment.parameters["station"].centre[0],
        )

    @property
    def camera(self) -> Camera:
        """The parameters of the camera, in the units of the frame."""
        found = self.adjustment.parameters["camera"]
        return Camera(
            found.principal[0], found.focal[0], found.brown[0], found.field[0]
        )

    @property
    def usable(self):
        """Whether the numbers may be used."""
        return is_usable(self.result)

    def check(self) -> "Calibration":
        """This calibration; RuntimeError with advice where it is not usable."""
        if not bool(self.usable):
            raise RuntimeError(f"calibrate: {RESULTS[self.result]}")
        return self

    # ---------------------------------------------------------------------------------
    # the station

    @property
    def centre(self) -> Float[Array, "3"]:
        """The projection centre X, Y, Z."""
        return self.frame.object_points(self.station.centre)

    @property
    def centre_deviations(self) -> Float[Array, "3"]:
        """Standard deviations of the projection centre."""
        return self._deviations[3:6] * self.frame.length

    @property
    def centre_covariance(self) -> Float[Array, "3 3"]:
        """The covariance of the projection centre."""
        return self.covariance[3:6, 3:6] * self.frame.length**2

    @property
    def rotation(self) -> Float[Array, "3 3"]:
        """The rotation from object to photo axes: x to the right, y up, z towards the
        viewer."""
        turn = rot.from_quaternion(*(self.station.quaternion[k] for k in range(4)))
        return rot.as_array(turn) * jnp.array([1.0, -1.0, -1.0])[:, None]

    @property
    def angles(self) -> Float[Array, "3"]:
        """omega, phi, kappa in radians: R = R3(kappa) R2(phi) R1(omega), object to
        photo."""
        return jnp.stack(rot.omega_phi_kappa(rot.as_matrix(self.rotation)))

    @property
    def turn_deviations(self) -> Float[Array, "3"]:
        """Standard deviations of small turns about the camera's axes, in radians."""
        return self._deviations[:3]

    # ---------------------------------------------------------------------------------
    # the camera

    @property
    def principal(self) -> Float[Array, "2"]:
        """The principal place: the foot of the optical axis in the measuring system."""
        return self.frame.measured_places(self.camera.principal)

    @property
    def principal_deviations(self) -> Float[Array, "2"]:
        """Standard deviations of the principal place."""
        return self._deviations[6:8] * self.frame.size

    @property
    def focal(self) -> Float[Array, " zone"]:
        """The focal lengths of the zones: first those of `model.x`, then those of
        `model.y`."""
        return self.basis @ self.camera.focal * self.frame.size

    @property
    def focal_deviations(self) -> Float[Array, " zone"]:
        """Standard deviations of the focal lengths."""
        end = 8 + self.camera.focal.size
        own = self.basis @ self.covariance[8:end, 8:end] @ self.basis.T
        return root(jnp.diagonal(own)) * self.frame.size

    @property
    def brown(self) -> Float[Array, "7"]:
        """Brown's coefficients k1, k2, k3, p1, p2, b1, b2 of coordinates in the unit of
        the image; zero for those that are not unknowns."""
        if self.model.brown is None:
            return jnp.zeros(7)
        return self.camera.brown * self._brown_units

    @property
    def brown_deviations(self) -> Float[Array, "7"]:
        """Standard deviations of Brown's coefficients; zero for those that are not
        unknowns."""
        if self.model.brown is None:
            return jnp.zeros(7)
        begin = 8 + self.camera.focal.size
        free = np.array(self.model.brown.free, float)
        own = self._deviations[begin : begin + 7]
        return own * jnp.abs(self._brown_units) * free

    @property
    def _brown_units(self) -> Float[Array, "7"]:
        h = self.frame.handedness
        signs = jnp.stack([h * h, h * h, h * h, h * h, h, h * h, h])
        return signs / self.frame.size ** jnp.asarray(POWERS, float)

    # ---------------------------------------------------------------------------------
    # residuals and statistics

    @property
    def covariance(self) -> Float[Array, "p p"]:
        """sigma0² Q of all parameters in the units of the frame: turns, station,
        principal place, focal lengths, Brown's coefficients, field."""
        return times(self.adjustment.cofactor, self.adjustment.sigma0**2)

    @property
    def _deviations(self) -> Float[Array, " p"]:
        return root(jnp.diagonal(self.covariance))

    @property
    def sigma0(self) -> Float[Array, ""]:
        """The standard deviation of a coordinate with sigma 1."""
        return self.adjustment.sigma0

    @property
    def degrees_of_freedom(self) -> Int[Array, ""]:
        """Coordinates, and numbers known beforehand, minus unknowns."""
        return self.adjustment.degrees_of_freedom

    @property
    def effective(self) -> Float[Array, ""]:
        """The number of parameters that the coordinates determine: the trace of the hat
        matrix. The coefficients of a field count in part."""
        redundancy = jnp.sum(self.adjustment.redundancy[0])
        return 2 * count(self.measured.mask) - redundancy

    def misfits(
        self, places: Float[ArrayLike, "n 2"], points: Float[ArrayLike, "n 3"]
    ) -> Float[Array, "n 2"]:
        """What is left between measured places, free of distortion, and the images of
        their object points, in the unit of the image."""
        u = self.frame.normal_places(jnp.asarray(places, float))
        normal = self.frame.normal_points(jnp.asarray(points, float))
        focal = parameter_weights(self.model, u, self.area, self.basis)
        field = field_weights(self.model, u, self.area)
        of_point = partial(misfit, self.model.rays, self.station, self.camera)
        found = jax.vmap(of_point)(Measured(u, normal, focal, field))
        return found * self.frame.axes[None] * self.frame.size

    def interval(self, level: float = 0.95) -> Float[Array, ""]:
        """Half the width of a confidence interval, in standard deviations (Student)."""
        return critical_values.half_width(level, self.degrees_of_freedom)
