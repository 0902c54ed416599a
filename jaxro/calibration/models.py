"""Models of one image's distortion, as data: all of them become the same arrays, so
that one compiled program serves them all."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adjustment.null_space import null_space
from ..camera.area import Area
from ..camera.brown import Brown
from ..camera.condition import Rays, perspective
from ..camera.field import Field, columns
from ..camera.zones import AbstractZones, Whole
from .images import Places


class Model(eqx.Module):
    """What may be wrong with an image, and is estimated with its station.

    `x`: the zones of the focal length; `y`: those of a focal length of its own along y,
    None where one focal length serves both. `brown` and `field` are None where they are
    not part of the model. `rays`: `camera.perspective`, or `camera.stereographic` for
    fields of view beyond some 100°.
    """

    x: AbstractZones = Whole()
    y: AbstractZones | None = None
    brown: Brown | None = None
    field: Field | None = None
    rays: Rays = eqx.field(static=True, default=perspective)

    @property
    def focals(self) -> int:
        """The number of focal lengths."""
        return self.x.count + (0 if self.y is None else self.y.count)

    @property
    def unknowns(self) -> int:
        """The number of unknowns besides the field: six of the station, two of the
        principal place, focal lengths and Brown's coefficients."""
        lens = 0 if self.brown is None else sum(self.brown.free)
        return 8 + self.focals - self.imitated + lens

    @property
    def imitated(self) -> int:
        """How many combinations of focal lengths imitate a tilt: they are left out."""
        own = self.x if self.y is None else self.y
        both = zip(self.x.linear, own.linear, strict=True)
        return sum(a and b for a, b in both)


def focal_weights(model: Model, u: Places, area: Area) -> Float[Array, "point 2 zone"]:
    """The weights of the focal lengths for x and y."""
    of_x = model.x.weights(u, area)
    if model.y is None:
        return jnp.stack([of_x, of_x], axis=1)
    of_y = model.y.weights(u, area)
    along_x = jnp.concatenate([of_x, jnp.zeros_like(of_y)], axis=1)
    along_y = jnp.concatenate([jnp.zeros_like(of_x), of_y], axis=1)
    return jnp.stack([along_x, along_y], axis=1)


def parameter_weights(
    model: Model, u: Places, area: Area, basis: Float[Array, "zone parameter"]
) -> Float[Array, "point 2 parameter"]:
    """The weights of the parameters of which `basis` makes the focal lengths."""
    return jnp.einsum("pcz,zk->pck", focal_weights(model, u, area), basis)


def field_weights(model: Model, u: Places, area: Area) -> Float[Array, "point 2 mode"]:
    """The weights of the coefficients of the field; none without a field."""
    if model.field is None:
        return jnp.zeros((len(u), 2, 0), u.dtype)
    return columns(u, area, model.field, model.brown)


def imitating(model: Model, area: Area) -> Float[Array, "zone parameter"]:
    """The focal lengths of all zones as combinations of parameters, without those
    combinations that imitate a tilt of the image: a focal length that changes linearly
    along x moves the places by (x², xy), a tilt does the same.

    The combinations that are left out are those whose displacements, over the measured
    area, go with (x², xy), or (xy, y²), after the change of scale has been taken out.
    The columns are orthonormal.
    """
    own = model.x if model.y is None else model.y
    tilts = [a and b for a, b in zip(model.x.linear, own.linear, strict=True)]
    if not any(tilts):
        return jnp.eye(model.focals)
    grid = area.grid
    x, y = (grid - area.principal[None]).T
    patterns = [(x * x, x * y), (x * y, y * y)]
    displaced = focal_weights(model, grid, area) * jnp.stack([x, y], axis=1)[:, :, None]
    rows = []
    for is_tilt, (dx, dy) in zip(tilts, patterns, strict=True):
        if is_tilt:
            part = jnp.sum(dx * x + dy * y) / jnp.sum(x * x + y * y)
            pattern = jnp.stack([dx - part * x, dy - part * y], axis=1)
            rows.append(jnp.sum(pattern[:, :, None] * displaced, axis=(0, 1)))
    return null_space(jnp.stack(rows)[:, :, None])[:, :, 0].T
