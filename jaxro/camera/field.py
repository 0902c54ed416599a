"""The displacement field: corrections dx, dy of the measured places that change
smoothly over the area, in any way.

dx and dy are two independent random functions with the covariance

    γ² exp(-|u - u'|² / 2 l²)

as a priori knowledge, and are estimated with all other unknowns. They are sums of the
`MODES` strongest functions of this covariance over the square |ux|, |uy| <= 1 (Karhunen
and Loève): coefficients with the variance γ² each.

A shift, a turn, a change of scale and two tilts of the image are what rotations and the
inner orientation of the camera do as well. The field is made orthogonal to them over
the measured area, and to the corrections of Brown where these are unknowns: otherwise
neither would mean anything.
"""

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..adjustment import symmetric
from .area import Area, Places
from .brown import Brown, patterns

MODES = 24
"""Functions for each of dx and dy of a single image. Those beyond them have .07 of the
strength at the length .5, and less at larger ones."""

NODES = 15
"""Nodes along each side of the square over which the functions are calculated."""


class Field(eqx.Module):
    """A displacement field: its correlation `length` (l, in units of half the longer
    side of the measured area) and its `strength` (γ, in units of sigma)."""

    length: float = eqx.field(static=True)
    strength: Float[Array, ""] | float


@lru_cache
def _functions(length: float, modes: int) -> np.ndarray:
    """(node, mode): what the covariances of a place with all nodes are multiplied with
    to give the functions there."""
    nodes = _nodes()
    apart = nodes[:, None] - nodes[None]
    covariance = np.exp(-0.5 * np.sum(apart**2, axis=2) / length**2)
    values, vectors = np.linalg.eigh(covariance)
    strongest = np.argsort(values)[::-1][:modes]
    values = np.maximum(values[strongest], 1e-9 * values.max())
    return vectors[:, strongest] / np.sqrt(values)


def _nodes() -> np.ndarray:
    axis = np.linspace(-1.0, 1.0, NODES)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def functions(
    u: Places, length: float, modes: int = MODES
) -> Float[Array, "point mode"]:
    """The strongest functions of the covariance at any places, each with the
    variance 1."""
    apart = u[:, None] - jnp.asarray(_nodes())[None]
    covariance = jnp.exp(-0.5 * jnp.sum(apart**2, axis=2) / length**2)
    return covariance @ jnp.asarray(_functions(length, modes))


def columns(
    u: Places, area: Area, field: Field, brown: Brown | None, modes: int = MODES
) -> Float[Array, "point 2 mode"]:
    """dx and dy at any places for each coefficient of the field: first those of dx,
    then those of dy."""
    grid = area.grid
    of_grid = _both(functions(grid, field.length, modes)).reshape(-1, 2 * modes)
    imitated = jax.vmap(lambda place: _imitated(place, area, brown))
    of_area = imitated(grid).reshape(of_grid.shape[0], -1)
    normal = symmetric.inverse(of_area.T @ of_area).matrix
    part = normal @ (of_area.T @ of_grid)
    return _both(functions(u, field.length, modes)) - jnp.einsum(
        "pci,ij->pcj", imitated(u), part
    )


def _both(one: Float[Array, "point mode"]) -> Float[Array, "point 2 two_modes"]:
    zero = jnp.zeros_like(one)
    along_x = jnp.concatenate([one, zero], axis=1)
    return jnp.stack([along_x, jnp.concatenate([zero, one], axis=1)], axis=1)


def _imitated(place, area: Area, brown: Brown | None) -> Float[Array, "2 pattern"]:
    """The displacements that pose and inner orientation make: two shifts, scale, swing
    and two tilts; and those of Brown's coefficients."""
    about = place - area.principal
    x, y = about[0], about[1]
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    pose = jnp.stack(
        [
            jnp.stack([one, zero, x, -y, x * x, x * y]),
            jnp.stack([zero, one, y, x, x * y, y * y]),
        ]
    )
    if brown is None:
        return pose
    free = np.flatnonzero(brown.free)
    return jnp.concatenate([pose, patterns(about)[:, free]], axis=1)
