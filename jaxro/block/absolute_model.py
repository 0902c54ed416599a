"""A model and what is known of it on the ground: what an absolute orientation is made
of."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..geometry.elements import RelativePose
from ..geometry.intersection import model_point
from ..geometry.pairs import Pair
from ..orientation.result import Orientation
from ..xla.programs import is_traced
from .similarity import Frame, Points, frame

NOTHING = 1e-12
"""Part of the largest variance below which an error in common is left out."""


class Units(NamedTuple):
    """The units of an adjustment: the frame of the coordinates, and a standard
    deviation in it, so that residuals are rounded where all adjustments end."""

    frame: Frame
    sigma: Float[Array, ""]


class MeasuredModel(eqx.Module):
    """Model points, and the ground coordinates of some of them.

    `ground`: zero where it is not `known`; a point may be known in plan, in height, in
    all three coordinates or in none. `variance`: of the ground coordinates. The errors
    of the model are standard normal numbers times `own` (of each point) and `common`
    (of all points together):

        C_ij = common_i common_jᵀ + (own_i own_iᵀ where i = j).

    `common` has no columns where points have errors of their own only, or none.
    """

    points: Points
    ground: Points
    known: Bool[Array, "point 3"]
    variance: Points
    own: Float[Array, "point 3 3"]
    common: Float[Array, "point 3 common"]

    def rows(self, which: Int[np.ndarray, " some"]) -> "MeasuredModel":
        """These points of the model."""
        return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[which]), self)

    def pad(self, room: int) -> "MeasuredModel":
        """The same with further points, of which nothing is known."""
        missing = room - len(self.points)
        more = lambda a: [(0, missing)] + [(0, 0)] * (a.ndim - 1)
        longer = lambda a: jnp.asarray(np.pad(np.asarray(a), more(a)))
        return jax.tree.map(longer, self)

    def within(self, units: Units) -> "MeasuredModel":
        """The same in other units."""
        frame, sigma = units
        ground_sigma, model_sigma = sigma * frame.ground_size, sigma * frame.model_size
        apart = self.ground - frame.ground_centre[None]
        return MeasuredModel(
            points=(self.points - frame.model_centre[None]) / frame.model_size,
            ground=jnp.where(self.known, apart / frame.ground_size, 0.0),
            known=self.known,
            variance=self.variance / ground_sigma**2,
            own=self.own / model_sigma,
            common=self.common / model_sigma,
        )


def units_of(measured: MeasuredModel) -> Units:
    """The units in which a model is adjusted."""
    known = measured.known
    found = frame(measured.points, measured.ground, known)
    of_model = jnp.sum(measured.own**2, axis=2) + jnp.sum(measured.common**2, axis=2)
    # as if the model were not turned
    size = found.ground_size**2, found.model_size**2
    variance = measured.variance / size[0] + of_model / size[1]
    total = jnp.sum(jnp.where(known, variance, 0.0))
    mean = total / jnp.maximum(jnp.sum(known.astype(total.dtype)), 1.0)
    return Units(found, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)))


def model(
    points: Float[ArrayLike, "..."],
    ground: Float[ArrayLike, "..."],
    *,
    ground_sigma: Float[ArrayLike, "..."] = 1.0,
    sigma: Float[ArrayLike, "..."] | None = None,
    covariance: Float[np.ndarray, "..."] | None = None,
    factors: tuple[np.ndarray, np.ndarray] | None = None,
) -> MeasuredModel:
    """A `MeasuredModel`.

    `ground`: X, Y, Z of the points, NaN where they are not known. `ground_sigma`: their
    standard deviations, a number or any array that broadcasts to (point, 3): 1 for unit
    weights, 0 without error. Of the model: `sigma`, standard deviations of the same
    shapes, or `covariance`, (point, 3, 3) of each point or (3 point, 3 point) of all of
    them together, or `factors`, its `own` (point, 3, 3) and its `common` (point, 3, any)
    ones; without all of them it is free of error. Points with a model coordinate that
    is not finite have no control. Raises ValueError for shapes that differ, and for
    what is no covariance.
    """
    # by NumPy, which compiles nothing, where it can
    xp: Any = jnp if is_traced((points, ground, ground_sigma, sigma)) else np
    x, given = xp.asarray(points, float), xp.asarray(ground, float)
    if x.ndim != 2 or x.shape[1] != 3 or given.shape != x.shape:
        raise ValueError(
            "absolute.model: model points and ground coordinates are arrays of shape "
            f"(point, 3) of the same points, got {x.shape} and {given.shape}"
        )
    if sum(given is not None for given in (sigma, covariance, factors)) > 1:
        raise ValueError("absolute.model: one of sigma, covariance and factors")
    deviation = xp.broadcast_to(xp.asarray(ground_sigma, float), x.shape)
    there = xp.all(xp.isfinite(x), axis=1)[:, None]
    known = xp.isfinite(given) & xp.isfinite(deviation) & (deviation >= 0) & there
    number = len(x)
    own, common = np.zeros((number, 3, 3)), np.zeros((number, 3, 0))
    if sigma is not None:
        spread = xp.broadcast_to(xp.asarray(sigma, float), x.shape)
        own = spread[:, :, None] * np.eye(3)[None]
    if factors is not None:
        own, common = factors
    if covariance is not None:
        own, common = _parts(np.asarray(covariance, float), number)
    return MeasuredModel(
        points=jnp.asarray(xp.where(there, x, 0.0)),
        ground=jnp.asarray(xp.where(known, given, 0.0)),
        known=jnp.asarray(known),
        variance=jnp.asarray(xp.where(known, deviation**2, 1.0)),
        own=jnp.asarray(own),
        common=jnp.asarray(common),
    )


def _parts(covariance: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Roots of the part of a covariance that each point has for itself, and of the part
    that all points share. Raises ValueError."""
    if covariance.shape == (number, 3, 3):
        return _roots(covariance), np.zeros((number, 3, 0))
    if covariance.shape != (3 * number, 3 * number):
        raise ValueError(
            f"absolute.model: the covariance of {number} points has the shape "
            f"({number}, 3, 3) or ({3 * number}, {3 * number}), got {covariance.shape}"
        )
    blocks = covariance.reshape(number, 3, number, 3)
    roots = _roots(np.stack([blocks[k, :, k] for k in range(number)]))
    inverses = np.linalg.inv(roots)
    # each block of it is the unit matrix, so that its least eigenvalue is the part of
    # every block that all points can have for themselves
    white = np.einsum("iab,ibjc,jdc->iajd", inverses, blocks, inverses)
    values, vectors = np.linalg.eigh(white.reshape(covariance.shape))
    least = values[0]
    if least < -1e-9 * values[-1]:
        raise ValueError(
            "absolute.model: the covariance is not positive: an eigenvalue over the "
            f"largest is {least / values[-1]:.1g}"
        )
    own = np.sqrt(max(least, 0.0)) * roots
    shared = values - max(least, 0.0)
    kept = shared > NOTHING * values[-1]
    factor = (vectors[:, kept] * np.sqrt(shared[kept])).reshape(number, 3, -1)
    return own, np.einsum("iab,ibk->iak", roots, factor)


def _roots(blocks: np.ndarray) -> np.ndarray:
    """The Cholesky factor of each block. Raises ValueError."""
    try:
        return np.linalg.cholesky(blocks)
    except np.linalg.LinAlgError:
        raise ValueError(
            "absolute.model: the covariance of a point is to be positive definite"
        ) from None


def model_of_pair(
    pair: Pair,
    orientation: Orientation,
    ground: Float[ArrayLike, "point 3"],
    *,
    ground_sigma: Float[ArrayLike, "..."] = 1.0,
) -> MeasuredModel:
    """The `MeasuredModel` of an oriented pair, with the exact covariance of its model
    points: of the image coordinates of each point, and of the five elements that all
    points share.

    The adjustment of this model is that of the bundles of the two photos to first
    order. `pair.sigma` and `ground_sigma` are to be standard deviations (up to one
    factor for both). The model is that of the left photo and the base 1. Raises
    ValueError for an orientation by other elements than `RelativePose`.
    """
    if not isinstance(orientation.elements, RelativePose):
        raise ValueError(
            "absolute.model_of_pair: orient the pair with RelativePose (the default), "
            f"got {type(orientation.elements).__name__}"
        )
    pose, use = orientation.pose, pair.mask
    one = jnp.ones(())

    def place(step, point, used, roots):
        moved = pose.move(tuple(step[k] for k in range(5)))
        of_point = model_point(pair, moved, moved, one, jnp.zeros(()))
        at = tuple(point[k] for k in range(4))
        return jnp.stack(of_point(at, one, used, roots)[0])

    def of_point(point, sigma, used, roots):
        by_pose, by_point = jax.jacfwd(place, argnums=(0, 1))(
            jnp.zeros(5), jnp.stack(point), used, roots
        )
        if roots is not None:
            by_point = jnp.stack(roots.pull(tuple(by_point.T)), axis=1)
        return place(jnp.zeros(5), point, used, roots), by_point * sigma, by_pose

    measured = pair.coordinates, pair.sigma, use, pair.roots
    points, own, by_pose = jax.vmap(of_point)(*measured)
    # what is made of zeros is no point: it is masked, or infinitely far
    points = jnp.where(jnp.any(points != 0, axis=1)[:, None], points, jnp.nan)
    made = model(points, ground, ground_sigma=ground_sigma)
    own = _roots(np.asarray(own @ jnp.swapaxes(own, 1, 2)))
    of_pose = np.linalg.cholesky(np.asarray(orientation.cofactor))
    parts = jnp.asarray(own), by_pose @ jnp.asarray(of_pose)
    return eqx.tree_at(lambda m: (m.own, m.common), made, parts)
