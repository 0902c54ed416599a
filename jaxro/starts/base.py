"""What every start returns."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .. import coplanarity
from ..adjustment import Residuals
from ..elements import AbstractElements, RelativePose
from ..normal_equations import steps
from ..pairs import Pair


class Begin(NamedTuple):
    """A pose to begin with, whether another one fits the points as well, and whether a rotation alone explains them."""

    pose: AbstractElements
    ambiguous: Bool[Array, ""]
    pure_rotation: Bool[Array, ""]


class AbstractStart(eqx.Module):
    """A way to begin the adjustment of one pair of finite coordinates, whatever its masked points hold."""

    @abc.abstractmethod
    def __call__(self, pair: Pair) -> Begin:
        """The pose to begin with."""


def distances(pair: Pair, pose: RelativePose) -> Residuals:
    """Distances of the points from the condition, in the unit of the coordinates, around the pose."""
    prepare, condition, observations, _ = coplanarity.rigorous(pair)
    unit = jnp.ones_like(pair.sigma)
    return Residuals(prepare, condition, pose, observations, unit, pair.mask)


def approached(pair: Pair, pose: RelativePose, count: int) -> RelativePose:
    """The pose after some Gauss-Newton steps in single precision, which are half the work and, far from the solution,
    as good; unchanged where they fail."""
    if count == 0:
        return pose
    single, points = _with_dtype(jnp.float32, pose), _with_dtype(jnp.float32, pair)
    zero = jnp.zeros_like(points.focal_left)
    step = steps(distances(points, single), (zero,) * 5, count, 0.5)
    fine = jnp.isfinite(sum(step))
    there = _with_dtype(pair.focal_left.dtype, single.moved(step)).normalised()
    return jax.tree.map(lambda new, old: jnp.where(fine, new, old), there, pose)


def _with_dtype(dtype, tree: PyTree) -> PyTree:
    """The tree with its floating-point numbers in another precision."""
    return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)
