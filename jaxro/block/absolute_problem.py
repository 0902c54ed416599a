"""The adjustment of one model by its control: the condition of a point, the terms, and
the linearisation of a point at the solution."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..adjustment import (
    JointAdjustment,
    LevenbergMarquardt,
    Term,
    adjust,
    normal_equations,
)
from ..geometry import rotations as rot
from .absolute_model import MeasuredModel
from .similarity import Similarity, Vector

STEPS = 100
"""Steps of Levenberg-Marquardt."""

Matrix = Float[Array, "3 3"]


class Seen(NamedTuple):
    """One point: the errors of its own in the model (of unit variance), and its ground
    coordinates; where these are not known, an observation that tells nothing."""

    errors: Float[Array, "*point 3"]
    ground: Float[Array, "*point 3"]
    point: Float[Array, "*point 3"]
    known: Bool[Array, "*point 3"]
    own: Float[Array, "*point 3 3"]
    common: Float[Array, "*point 3 common"]


def misfit(
    similarity: Similarity, common: Float[Array, " common"], seen: Seen
) -> Float[Array, "3"]:
    """The ground coordinates of a point minus the place of its model point; `common`:
    the errors that all points share."""
    point = seen.point + seen.own @ seen.errors + seen.common @ common
    return seen.ground - jnp.where(seen.known, similarity.to_ground(point), 0.0)


@jax.jit
def solve(measured: MeasuredModel, start: Similarity) -> JointAdjustment:
    """The adjustment of the families "model" and "common", one member each. The errors
    in common are observations of zero with unit variance.

    It is compiled for itself so that it is traced once for all starts.
    """
    shared = measured.common.shape[2]
    errors = jnp.zeros_like(measured.points)
    seen = Seen(
        errors=errors,
        ground=measured.ground,
        point=measured.points,
        known=measured.known,
        own=measured.own,
        common=measured.common,
    )
    variance = jnp.where(measured.known, measured.variance, 1.0)
    variances = Seen(jnp.ones_like(errors), variance, None, None, None, None)  # pyright: ignore[reportArgumentType]
    first = jnp.zeros((), int)
    families: dict = {"model": jax.tree.map(lambda a: a[None], start)}
    touches = [("model", first)]
    terms = []
    if shared:
        families["common"] = jnp.zeros((1, shared))
        touches.append(("common", first))
        of_errors = Term(
            lambda common, row: common[row[0]] - row[1],
            (jnp.arange(shared), jnp.zeros(shared)),
            (None, jnp.ones(shared)),
            touches=[("common", first)],
        )
        terms.append(of_errors)
    condition = misfit if shared else _without_common
    terms.insert(0, Term(condition, seen, variances, touches=touches))
    return adjust(terms, families, solver=LevenbergMarquardt(), max_steps=STEPS)


def _without_common(similarity: Similarity, seen: Seen) -> Float[Array, "3"]:
    return misfit(similarity, jnp.zeros(0), seen)


def sum_squares(found: JointAdjustment) -> Float[Array, ""]:
    """The sum of squares that was minimised."""
    total = sum(jnp.sum(r**2) for r in found.residuals)
    return jnp.where(jnp.isfinite(total), total, jnp.inf)


class Linear(NamedTuple):
    """One point at the solution: its `place` on the ground, the derivatives of this by
    the local parameters and by the errors in common, the covariance that its own errors
    have there; the `misclosure` of its ground coordinates (zero where they are not
    known) and the weights of this, the inverse of its covariance."""

    place: Vector
    slopes: Float[Array, "3 p"]
    own: Matrix
    misclosure: Vector
    weights: Matrix


def linearise(
    similarity: Similarity, common: Float[Array, " common"], one: MeasuredModel
) -> Linear:
    """`Linear` of one point, the arrays of which have no axis of points."""
    point = one.points + one.common @ common
    place = similarity.to_ground(point)
    by_step = jax.jacfwd(lambda step: similarity.move(step).to_ground(point))
    turn = similarity.scale * rot.as_array(similarity.rotation)
    slopes = jnp.concatenate([by_step(jnp.zeros(7)), turn @ one.common], axis=1)
    root = turn @ one.own
    own = root @ root.T
    both = one.known[:, None] & one.known[None, :]
    whole = own + jnp.diag(one.variance)
    d = jnp.where(both, whole, jnp.eye(3))
    rows = [[d[i, j] for j in range(i + 1)] for i in range(3)]
    inverse = normal_equations.dense(normal_equations.inverse(rows)[0])
    return Linear(
        place=place,
        slopes=slopes,
        own=own,
        misclosure=jnp.where(one.known, one.ground - place, 0.0),
        weights=jnp.where(both, inverse, 0.0),
    )
