"""The misfit of places at a calibration, and its derivatives by everything that enters
it: what first-order propagation is made of."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..camera.condition import Camera, Measured, Rays, Station, misfit


class Slopes(NamedTuple):
    """The misfits of places, and their derivatives by all parameters of a calibration
    (in the order of its `covariance`), by the places and by the object points. In the
    units of the frame."""

    misfit: Float[Array, "place 2"]
    parameters: Float[Array, "place 2 p"]
    place: Float[Array, "place 2 2"]
    point: Float[Array, "place 2 3"]


def slopes(rays: Rays, station: Station, camera: Camera, measured: Measured) -> Slopes:
    """The misfits of many places of one image, and their derivatives."""
    return jax.vmap(partial(slopes_of_one, rays, station, camera))(measured)


def slopes_of_one(
    rays: Rays, station: Station, camera: Camera, measured: Measured
) -> Slopes:
    """The misfit of one place, and its derivatives: `Slopes` without the first axis."""
    values, camera_of = ravel_pytree(camera)

    def at(step: Array, place: Array, point: Array) -> Array:
        moved = station.move(step[:6]), camera_of(values + step[6:])
        return misfit(rays, *moved, measured._replace(place=place, point=point))

    where = jnp.zeros(6 + values.size), measured.place, measured.point
    return Slopes(at(*where), *jax.jacfwd(at, argnums=(0, 1, 2))(*where))


def inverse_of_two(m: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """The inverse of a matrix of two rows."""
    volume = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    first = jnp.stack([m[1, 1], -m[0, 1]])
    second = jnp.stack([-m[1, 0], m[0, 0]])
    return jnp.stack([first, second]) / volume
