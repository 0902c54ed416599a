"""The calibration of several images at once: stations, cameras that they share or not,
and the object points, which are eliminated.

The points that are known hold the datum, with their standard deviations; all others are
unknowns. With a camera in common, points in a plane are enough, if the images are tilted
in different directions.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import JointAdjustment
from ..camera.area import Area
from ..camera.condition import Camera, Measured, Station, misfit
from ..xla.programs import compiled
from .images import Frame
from .known import NOTHING, Known, prior
from .measured_images import MeasuredImages
from .models import Model, field_weights, focal_weights
from .problem_together import Approximate, approximate, solve_together
from .results import RESULTS, is_usable
from .verdict import verdict_of_several


class Together(eqx.Module):
    """Several images, adjusted together. Properties are in the units of the images and
    of the object, standard deviations a posteriori."""

    measured: MeasuredImages
    model: Model
    frame: Frame
    area: Area
    adjustment: JointAdjustment
    result: RESULTS

    @property
    def usable(self) -> Bool[Array, ""]:
        """Whether the numbers may be used."""
        return is_usable(self.result)

    def check(self) -> "Together":
        """This calibration; RuntimeError with advice where it is not usable."""
        if not bool(self.usable):
            raise RuntimeError(f"calibrate_together: {RESULTS[self.result]}")
        return self

    @property
    def sigma0(self) -> Float[Array, ""]:
        """The standard deviation of a coordinate with sigma 1."""
        return self.adjustment.sigma0

    @property
    def centres(self) -> Float[Array, "image 3"]:
        """The projection centres."""
        return self.frame.object_points(self.adjustment.parameters["station"].centre)

    @property
    def centre_deviations(self) -> Float[Array, "image 3"]:
        """Standard deviations of the projection centres."""
        return self._deviations("station")[:, 3:] * self.frame.length

    @property
    def points(self) -> Float[Array, "point 3"]:
        """The object points."""
        return self.frame.object_points(self.adjustment.parameters["point"])

    @property
    def point_deviations(self) -> Float[Array, "point 3"]:
        """Standard deviations of the object points."""
        return self._deviations("point") * self.frame.length

    @property
    def cameras(self) -> Camera:
        """The cameras, in the units of the frame."""
        return self.adjustment.parameters["camera"]

    @property
    def focal(self) -> Float[Array, "camera zone"]:
        """The focal lengths of each camera."""
        return self.cameras.focal * self.frame.size

    @property
    def focal_deviations(self) -> Float[Array, "camera zone"]:
        """Standard deviations of the focal lengths."""
        number = self.cameras.focal.shape[1]
        return self._deviations("camera")[:, 2 : 2 + number] * self.frame.size

    @property
    def principal(self) -> Float[Array, "camera 2"]:
        """The principal place of each camera."""
        return self.frame.measured_places(self.cameras.principal)

    def _deviations(self, family: str) -> Float[Array, "member d"]:
        covariance = self.adjustment.covariance(family)
        variances = jnp.diagonal(covariance, axis1=1, axis2=2)
        return jnp.sqrt(jnp.maximum(variances, 0.0))

    def residuals(
        self,
        places: Float[ArrayLike, "place 2"],
        image: Int[ArrayLike, " place"],
        point: Int[ArrayLike, " place"],
    ) -> Float[Array, "place 2"]:
        """What would have to be added to places of these images, measured or new, so
        that they fit, in the unit of the image."""
        u = self.frame.normal_places(jnp.asarray(places))
        image, point = jnp.asarray(image), jnp.asarray(point)
        stations = jax.tree.map(
            lambda a: a[image], self.adjustment.parameters["station"]
        )
        number = self.measured.camera[image]
        cameras = jax.tree.map(lambda a: a[number], self.cameras)
        measured = Measured(
            u,
            self.adjustment.parameters["point"][point],
            focal_weights(self.model, u, self.area),
            field_weights(self.model, u, self.area),
        )
        correction = jax.vmap(partial(_correction, self.model.rays))
        found = correction(stations, cameras, measured)
        return found * self.frame.axes[None] * self.frame.size


def calibrate_together(
    measured: MeasuredImages,
    model: Model | None = None,
    known: Known = NOTHING,
    *,
    free_network: bool = False,
) -> Together:
    """Adjust several images together; unknown points are eliminated. `known` is what is
    known of every camera.

    In a free network the known points give approximate values only; the datum is that
    of the stations' approximate values (inner constraints), to which all standard
    deviations refer.

    A field, focal lengths and the lens are those of each camera. Zones of focal lengths
    that change linearly are for single images.
    """
    model = Model() if model is None else model
    if model.imitated:
        raise ValueError(
            "calibrate_together: focal lengths that change linearly imitate tilts; take "
            "a field, or zones of degree 0"
        )
    # where the adjustment begins is a program of its own, which all models share
    begin = compiled(approximate)(measured, rays=model.rays)
    return _adjust(measured, begin, known, model=model, free_network=free_network)


@compiled
def _adjust(
    measured: MeasuredImages,
    begin: Approximate,
    known: Known,
    *,
    model: Model,
    free_network: bool,
) -> Together:
    u, area = begin.places, begin.area
    focal, field = focal_weights(model, u, area), field_weights(model, u, area)
    number, zones = measured.cameras, focal.shape[2]
    free = np.array(() if model.brown is None else model.brown.free, bool)
    cameras = Camera(
        principal=begin.cameras.principal,
        focal=jnp.broadcast_to(begin.cameras.focal, (number, zones)),
        brown=jnp.where(free[None], begin.cameras.brown[:, : free.size], 0.0),
        field=jnp.zeros((number, field.shape[2])),
    )
    one = jax.tree.map(lambda a: a[0], cameras)
    beforehand = prior(model, one, known, begin.frame, begin.sigma, jnp.eye(zones))
    families = {"station": begin.stations, "camera": cameras, "point": begin.points}
    found = solve_together(
        measured, begin, focal, field, beforehand, model.rays, families, free_network
    )
    return Together(
        measured=measured,
        model=model,
        frame=begin.frame,
        area=area,
        adjustment=found,
        result=verdict_of_several(found),
    )


def _correction(rays, station: Station, camera: Camera, measured: Measured) -> Array:
    """The smallest correction of one place with which it fits, -B⁻¹ g."""
    at = lambda place: misfit(rays, station, camera, measured._replace(place=place))
    g, b = at(measured.place), jax.jacfwd(at)(measured.place)
    volume = b[0, 0] * b[1, 1] - b[0, 1] * b[1, 0]
    x = b[1, 1] * g[0] - b[0, 1] * g[1]
    y = b[0, 0] * g[1] - b[1, 0] * g[0]
    return -jnp.stack([x, y]) / volume
