"""What is known of the camera before an image is adjusted."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..camera.condition import Camera
from ..xla.programs import compiled
from .images import Frame
from .models import Model
from .problem import FIXED, Prior


class Known(eqx.Module):
    """What is known of the camera beforehand, in the unit of the image, with standard
    deviations in the unit of sigma0 times sigma (infinite: unknown)."""

    principal: Float[Array | np.ndarray, "2"]
    principal_sigma: Float[Array | np.ndarray, "2"]
    focal: Float[Array | np.ndarray, ""]
    focal_sigma: Float[Array | np.ndarray, ""]

    def free(self, model: Model) -> Float[Array, ""]:
        """How many numbers of the inner orientation are free: of the principal place,
        the focal lengths (along x, along y), affinity and shear. The image of a plane
        tells two."""
        focals = 1.0 if model.y is None else 2.0
        lens = model.brown
        affine = 0.0 if lens is None else float(lens.affinity + lens.shear)
        sigmas = jnp.append(jnp.asarray(self.principal_sigma), self.focal_sigma)
        known = jnp.isfinite(sigmas)
        return affine + jnp.sum(jnp.where(known, 0.0, jnp.array([1.0, 1.0, focals])))


NOTHING = Known(np.zeros(2), np.full(2, np.inf), np.ones(()), np.full((), np.inf))
"""Nothing is known. Arrays of NumPy: those of JAX would start it when this is
imported."""


def known(
    *,
    principal: tuple[float, float] | None = None,
    principal_sigma: ArrayLike = 0.0,
    focal: float | None = None,
    focal_sigma: ArrayLike = 0.0,
) -> Known:
    """A principal place and a focal length with standard deviations."""
    if principal is None:
        principal, principal_sigma = (0.0, 0.0), np.inf
    if focal is None:
        focal, focal_sigma = 1.0, np.inf
    return _as_known(principal, principal_sigma, focal, focal_sigma)


@compiled
def _as_known(*numbers: PyTree) -> Known:
    """A place, its deviation or two of them, a length and its deviation as arrays."""
    at, of_place, focal, of_focal = (jnp.asarray(a, float) for a in numbers)
    return Known(at, jnp.broadcast_to(of_place, (2,)), focal, of_focal)


def prior(
    model: Model,
    camera: Camera,
    known: Known,
    given: Frame,
    sigma: Float[Array, ""],
    basis: Float[Array, "zone parameter"],
) -> Prior:
    """What is known beforehand of the parameters of a model; `sigma`: the standard
    deviation of a place in the units of the frame."""
    at = given.normal_places(jnp.asarray(known.principal))
    focal = jnp.asarray(known.focal) / given.size
    value = Camera(
        principal=at,
        focal=focal * jnp.sum(basis, axis=0),
        brown=jnp.zeros_like(camera.brown),
        field=jnp.zeros_like(camera.field),
    )
    least = (FIXED * sigma) ** 2
    of = lambda deviation: jnp.maximum((deviation / given.size) ** 2, least)
    none = (False,) * camera.brown.size
    free = np.array(none if model.brown is None else model.brown.free)
    strength = 1.0 if model.field is None else model.field.strength
    variance = Camera(
        principal=of(known.principal_sigma),
        focal=jnp.broadcast_to(of(known.focal_sigma), camera.focal.shape),
        brown=jnp.where(free, jnp.inf, least),
        field=jnp.full_like(camera.field, 1.0) * (strength * sigma) ** 2,
    )
    return Prior(value, variance)
