"""The adjustment of any condition between parameters and measurements.

    g(x, l_i + v_i) = 0  for every observation group i,    Σ v_iᵀ Q_i⁻¹ v_i = min.

Each group is linearised by autodiff, B = dg/dl, and whitened by the Cholesky factor of
its cofactor B Q Bᵀ; the sum of squares of the whitened residuals r_i = L_i⁻¹ g_i is
minimised by optimistix and the finished solution is read: normal matrix, cofactors,
redundancy, sigma0. Observation equations l = f(x) are the case g = f(x) - l. Conditions
that are not linear in l are satisfied to first order in v (the second order is |v| over
the radius of curvature).
"""

from collections.abc import Callable, Sequence
from typing import overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..xla.pointwise import pointwise
from ..xla.programs import part
from . import normal_equations as normal
from .guarded import root, times
from .joint import JointAdjustment, adjust_jointly
from .losses import AbstractLoss
from .m_estimates import spread
from .parameters import as_given, as_parameters
from .residuals import Residuals, residuals_of, reweighted, together
from .results import RESULTS
from .terms import Families, Term


class Adjustment(eqx.Module):
    """A finished adjustment of p parameters from groups of m conditions each.

    `residuals` are whitened: of the unit of sigma0, and dimensionless where the
    cofactors are true variances. `cofactor` is that of the parameters (for
    `RelativePose`, of its five local parameters at the solution).
    """

    parameters: PyTree
    normal_matrix: Float[Array, "p p"]
    cofactor: Float[Array, "p p"]
    residuals: Float[Array, " group"] | Float[Array, "group m"]
    redundancy: Float[Array, " group"] | Float[Array, "group m"]
    sigma0: Float[Array, ""]
    pivot: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    iterations: Int[Array, ""]
    result: RESULTS

    def covariance(self, sigma0: ArrayLike | None = None) -> Float[Array, "p p"]:
        """sigma0² Q: a posteriori, or a priori with the sigma0 given (1 where the
        cofactors are variances)."""
        return times(
            self.cofactor, (self.sigma0 if sigma0 is None else jnp.asarray(sigma0)) ** 2
        )


@overload
def adjust(
    condition: Callable,
    start: PyTree,
    observations: PyTree,
    cofactor: PyTree,
    mask: Bool[Array, " group"] | None = None,
    *,
    prepare: Callable | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> Adjustment: ...


@overload
def adjust(
    condition: Term | Sequence[Term],
    start: Families,
    *,
    eliminate: str | None = None,
    constraints: Callable | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> JointAdjustment: ...


def adjust(
    condition,
    start,
    observations=None,
    cofactor=None,
    mask=None,
    *,
    prepare: Callable | None = None,
    eliminate: str | None = None,
    constraints: Callable | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> Adjustment | JointAdjustment:
    """Adjust parameters to measurements: Σ |L_i⁻¹ g(x, l_i)|² = min, or Σ rho of it
    with a robust loss.

    `condition(parameters, observation)` of one group returns a number or m of them.
    `observations`: a pytree whose leaves have the groups on the first axis; `cofactor`:
    its variances (relative to sigma0²), a tree that may end above the leaves and then
    holds for all of them: numbers or one per group, None for what is free of error.
    `mask` selects groups. `start`: `AbstractParameters`, or any pytree of numbers.
    `prepare`: what all groups share, computed once; the condition then gets
    prepare(*arguments) for the parameters, of their `arguments`. `solver`: any
    optimistix least-squares solver; `GaussNewton()` if None.

    With a loss, normal matrix and redundancy carry the final weights rho'(r²); sigma0
    is consistent for normal errors, and sigma0² times `cofactor` is the sandwich
    covariance of the M-estimate (`m_estimates`), so that the cofactors are not the
    inverse of the normal matrix. Derivatives of every field by the observations and
    cofactors are exact (implicit function theorem). Failures are values of `result`,
    never exceptions.

    Several kinds of conditions between many blocks of parameters (cameras, object
    points): `adjust(terms, start)` with a list of `Term` in place of the condition, and
    with the families of blocks by name as `start`. `eliminate` names the family with
    the most blocks, if no condition joins two of them; only its Schur complement is
    then inverted. `constraints(parameters)`: numbers of the kept families that are to
    become zero, as the datum of a free network.
    """
    if isinstance(condition, Term | Sequence):
        if any(given is not None for given in (observations, cofactor, mask, prepare)):
            raise ValueError(
                "adjust: observations, cofactors and masks are part of each `Term`; "
                "there is no `prepare`"
            )
        terms = (condition,) if isinstance(condition, Term) else tuple(condition)
        return adjust_jointly(
            terms,
            start,
            eliminate=eliminate,
            constraints=constraints,
            loss=loss,
            solver=solver,
            max_steps=max_steps,
        )
    if eliminate is not None or constraints is not None:
        raise ValueError(
            "adjust: `eliminate` and `constraints` are for terms; give `Term`s in "
            "place of the condition"
        )
    if as_parameters(start).count > normal.UNROLLED:
        measured = condition, prepare, observations, cofactor, mask
        return _of_one_block(
            *measured, start, loss=loss, solver=solver, max_steps=max_steps
        )
    groups = jax.tree.leaves(observations)[0].shape[0]
    if mask is None:
        mask = jnp.ones(groups, bool)
    dtype = jax.tree.leaves(start)[0].dtype
    cofactor = jax.tree.map(
        lambda q: jnp.broadcast_to(jnp.asarray(q, dtype), (groups, *jnp.shape(q)[1:])),
        cofactor,
    )
    start = as_parameters(
        jax.lax.stop_gradient(start)
    )  # the optimum does not depend on where it is sought
    residuals = residuals_of(
        condition, prepare, start, observations, cofactor, mask, loss
    )
    origin = (jnp.zeros((), dtype),) * start.count
    solve = lambda origin, residuals: normal.minimise(
        residuals, origin, solver, max_steps
    )
    solution = part(solve)(origin, residuals)
    parameters = start.moved(solution.value).normalised()
    converged = solution.result == optx.RESULTS.successful
    at_solution = eqx.tree_at(
        lambda r: (r.centre, r.loss),
        residuals,
        (parameters, None),
        is_leaf=lambda leaf: leaf is None,
    )
    return read(at_solution, loss, solution.stats["num_steps"], converged)


def _of_one_block(
    condition, prepare, observations, cofactor, mask, start, **options
) -> Adjustment:
    """Many parameters, all of which every group touches, as one block."""

    def of_block(parameters, observation):
        arguments = as_parameters(parameters).arguments()
        return condition(
            parameters if prepare is None else prepare(*arguments), observation
        )

    term = Term(of_block, observations, cofactor, [("all", np.zeros((), int))], mask)
    found = adjust_jointly(
        (term,), {"all": jax.tree.map(lambda a: jnp.asarray(a)[None], start)}, **options
    )
    one = lambda a: a[:, 0] if a.shape[1] == 1 else a
    return Adjustment(
        parameters=jax.tree.map(lambda a: a[0], found.parameters["all"]),
        normal_matrix=found.normal_matrix,
        cofactor=found.cofactor,
        residuals=one(found.residuals[0]),
        redundancy=one(found.redundancy[0]),
        sigma0=found.sigma0,
        pivot=found.pivot,
        degrees_of_freedom=found.degrees_of_freedom,
        iterations=found.iterations,
        result=found.result,
    )


def read(
    residuals: Residuals, loss: AbstractLoss | None, iterations, converged
) -> Adjustment:
    """Everything that follows from the linearisation at the solution, the centre of
    `residuals`."""
    p = residuals.centre.count
    origin = (jnp.zeros((), jax.tree.leaves(residuals.centre)[0].dtype),) * p
    linearised = residuals.linearised(origin)
    groups = residuals.observations, residuals.cofactor, residuals.mask
    r, jacobian, weight = jax.vmap(linearised)(*groups)
    n, _, squares, number = normal.accumulate(
        r, jacobian, reweighted(loss, r, weight), residuals.mask.astype(origin[0].dtype)
    )
    q, pivot = normal.inverse(n)

    def of_group(observation, cofactor, use):
        r, jacobian, weight = linearised(observation, cofactor, use)
        white = (
            r
            if weight is None
            else [e * jnp.sqrt(w) for e, w in zip(r, weight, strict=True)]
        )
        weight = reweighted(loss, r, weight)
        taken = [
            normal.quadratic(q, [column[c] for column in jacobian])
            for c in range(len(r))
        ]
        redundancy = [
            1 - (t if weight is None else weight[c] * t) for c, t in enumerate(taken)
        ]
        return [
            [jnp.where(use, entry, 0.0) for entry in entries]
            for entries in (white, redundancy)
        ]

    white, redundancy = pointwise(of_group, *groups)
    freedom = len(r) * number.astype(int) - p
    checked = freedom > 0
    cofactor = normal.dense(q)
    if loss is None:
        sigma0 = root(squares / jnp.where(checked, freedom, 1).astype(origin[0].dtype))
    else:
        entries = jnp.concatenate(white)
        use = jnp.tile(residuals.mask.astype(entries.dtype), len(white))
        sigma0, factor = spread(loss, entries, use, p)
        plain, *_ = normal.accumulate(r, jacobian, weight)
        cofactor = jnp.where(checked, factor, 1.0) * normal.dense(
            normal.inverse(plain)[0]
        )
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.diverged)
    result = RESULTS.where(pivot < normal.SINGULAR, RESULTS.rank_deficient, result)
    return Adjustment(
        as_given(residuals.centre),
        normal.dense(n),
        cofactor,
        together(white),
        together(redundancy),
        jnp.where(checked, sigma0, jnp.nan),
        pivot,
        freedom,
        iterations,
        result,
    )
