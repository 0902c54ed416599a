"""How photos and points of an adjusted block depend on every measurement.

The sum of squares f(x, l) of all whitened residuals is least at x where its gradient
is zero. Its derivative along l is zero, too (implicit function theorem):

    dx/dl = -H⁻¹ ∂²f/∂x∂l,    H = ∂²f/∂x² = N + Σ r ∂²r/∂x²

H has the second-order term of the residuals, so that these are the derivatives of the
finished adjustment, exact for residuals of any size; with N in the place of H and in
∂²f/∂x∂l without the residuals they would be the influences of first order, -N⁻¹AᵀP.
For a number eᵀx that is asked for, one vector z = H⁻¹ e gives the derivatives by all
measurements, those of -∂f/∂x · z. It is found by z + N⁻¹ (e - H z), which comes nearer
by the ratio of the second-order term and N each time; no factor but that of N is needed.
In a free network N⁻¹ is the cofactor matrix of the datum.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..adjustment.blocks import Steps
from ..adjustment.sparse import SparseAdjustment
from ..adjustment.sparse_normals import Data, all_residuals, origin
from ..adjustment.terms import Term
from ..xla.programs import compiled
from .adjust import BlockAdjustment
from .covariance import ask

ENOUGH = 1e-12
"""The part of a vector z below which its next correction is none."""

MOST = 50
"""Corrections, at most: where these do not end, the minimum is none."""


class Derivatives(NamedTuple):
    """Derivatives of numbers (in the order of `covariance.joint_covariance`, radians and
    units of the ground) by x and y of each ray, in the unit of the photo coordinates,
    and by each known coordinate; 0 for what takes no part."""

    rays: Float[np.ndarray, "number ray 2"]
    control: Float[np.ndarray, "number known 3"]


def differentiate(
    adjusted: BlockAdjustment,
    photos: Sequence[str] = (),
    points: Sequence[str] = (),
) -> Derivatives:
    """The derivatives of all photos and points that are named by all measurements. A
    displacement field is that of the measured place, as in the adjustment itself. Raises
    ValueError for a name that is not in the adjustment."""
    asked = ask(adjusted, photos, points)
    block, used = adjusted.block, adjusted.numbered.rays
    unit = np.zeros((adjusted.adjustment.all_cofactors.number, len(asked.rows)))
    unit[asked.rows, np.arange(len(asked.rows))] = 1.0
    found = by_observations(adjusted.adjustment, unit @ asked.slope.T)
    number = len(asked.rows)
    rays = np.zeros((number, len(block.photo), 2))
    # a place is (x, -y) over the focal length
    turned = np.array([1.0, -1.0]) / block.focal[block.photo[used], None]
    # with unknown inner parameters what is observed of a ray is a place and its field
    of_place = (lambda seen: seen) if adjusted.inner is None else (lambda seen: seen[0])
    rays[:, used] = np.stack([of_place(own[0]) for own in found]) * turned
    points_known = 0 if adjusted.ground is None else len(adjusted.ground.points)
    control = np.zeros((number, points_known, 3))
    for k, part in enumerate(adjusted.known, start=1):
        values = np.stack([own[k][1] for own in found]) / adjusted.frame.length
        control[:, part.row, part.axis] = values
    return Derivatives(rays, control)


def by_observations(
    adjustment: SparseAdjustment, right: Float[np.ndarray, "row number"]
) -> list[list[PyTree]]:
    """For each column e of `right`, (of all local parameters, number): the derivatives
    of eᵀx by the observations of each term, trees like these; None for what is no real
    number."""
    problem, cofactors = adjustment.problem, adjustment.all_cofactors
    data, z = problem.data, cofactors.times(right)
    for _ in range(MOST):
        rest = right - np.stack([_bend(adjustment, own) for own in z.T], axis=1)
        more = cofactors.times(rest)
        z = z + more
        if np.all(np.linalg.norm(more, axis=0) <= ENOUGH * np.linalg.norm(z, axis=0)):
            break
    else:
        raise RuntimeError(
            "the sum of squares has no minimum where it is differentiated"
        )
    return [
        [
            jax.tree.map(lambda a, n=n: np.asarray(a)[:n], part)
            for part, n in zip(
                _by_observations(_steps(adjustment, own), data),
                problem.groups,
                strict=True,
            )
        ]
        for own in z.T
    ]


def _steps(adjustment: SparseAdjustment, z: Float[np.ndarray, " row"]) -> Steps:
    """A vector of all local parameters by families."""
    problem, steps = adjustment.problem, {}
    for name, own in origin(problem.data, problem.roles).items():
        begin = problem.roles.place(name)[0]
        steps[name] = jnp.asarray(z[begin : begin + own.size].reshape(own.shape))
    return steps


def _bend(
    adjustment: SparseAdjustment, z: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """H z."""
    roles, data = adjustment.problem.roles, adjustment.problem.data
    found = _times_hessian(_steps(adjustment, z), data)
    out = np.zeros_like(z)
    for name, own in found.items():
        begin = roles.place(name)[0]
        out[begin : begin + own.size] = np.asarray(own).ravel()
    return out


def _half_squares(steps: Steps, data: Data) -> Float[Array, ""]:
    """f."""
    return sum((jnp.sum(r**2) for r in all_residuals(steps, data)), jnp.zeros(())) / 2


@compiled
def _times_hessian(z: Steps, data: Data) -> Steps:
    """The derivative of the gradient along z."""
    none = jax.tree.map(jnp.zeros_like, z)
    gradient = lambda steps: jax.grad(_half_squares)(steps, data)
    return jax.jvp(gradient, (none,), (z,))[1]


@compiled
def _by_observations(z: Steps, data: Data) -> list[PyTree]:
    """The derivatives of -∂f/∂x · z by the observations of all terms."""
    none = jax.tree.map(jnp.zeros_like, z)
    every = [term.observations for term in data.terms]
    real, other = eqx.partition(every, eqx.is_inexact_array)

    def along(real: PyTree) -> Float[Array, ""]:
        terms = map(_observing, data.terms, eqx.combine(real, other))
        of = lambda steps: _half_squares(steps, data._replace(terms=tuple(terms)))
        return -jax.jvp(of, (none,), (z,))[1]

    return jax.grad(along)(real)


def _observing(term: Term, observations: PyTree) -> Term:
    """The term with other observations."""
    return eqx.tree_at(lambda t: t.observations, term, observations)
