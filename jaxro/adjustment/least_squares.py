"""The adjustment of any condition between parameters and measurements.

    g(x, l_i + v_i) = 0  for every observation group i,    Σ v_iᵀ Q_i⁻¹ v_i = min.

Each group is linearised by autodiff, B = dg/dl, and whitened by the Cholesky factor of
its cofactor B Q Bᵀ; the sum of squares of the whitened residuals r_i = L_i⁻¹ g_i is
minimised by optimistix and the finished solution is read: normal matrix, cofactors,
redundancy, sigma0. Observation equations l = f(x) are the case g = f(x) - l. Conditions
that are not linear in l are satisfied to first order in v (the second order is |v| over
the radius of curvature).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..xla.kernels import kernel_part
from ..xla.passes import pointwise
from ..xla.programs import compiled, is_traced
from . import normal_equations as normal
from .guarded import root, times
from .joint import adjust_jointly, check_families
from .losses import AbstractLoss
from .m_estimates import spread
from .parameters import as_given, as_parameters
from .residuals import Residuals, reweight, together
from .results import RESULTS
from .terms import Term, close


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


def adjust(
    terms: Term | Sequence[Term],
    start: PyTree,
    *,
    eliminate: str | None = None,
    constraints: Callable | None = None,
    held: Mapping[str, ArrayLike] | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> Any:
    """Adjust parameters to measurements: Σ |L_i⁻¹ g(x, l_i)|² = min, or Σ rho of it
    with a robust loss.

    `terms`: one `Term`, or several kinds of conditions. `start`: `AbstractParameters`
    or any tree of numbers; the result then is an `Adjustment`. If the terms touch
    blocks of parameters (cameras, object points), `start` has the families of blocks by
    name, and the result is a `JointAdjustment`.

    `eliminate` names the family with the most blocks, if no condition joins two of
    them; only its Schur complement is then inverted. `constraints(parameters)`: numbers
    of the kept families that are to become zero, as the datum of a free network.
    `held`: what keeps its start, by family: one flag for all, for each member, or for
    each local parameter of each member, (member, d).
    `solver`: any optimistix least-squares solver; `GaussNewton()` if None.

    With a loss, normal matrix and redundancy carry the final weights rho'(r²); sigma0
    is consistent for normal errors, and sigma0² times `cofactor` is the sandwich
    covariance of the M-estimate (`m_estimates`), so that the cofactors are not the
    inverse of the normal matrix. Derivatives of every field by the observations and
    cofactors are exact (implicit function theorem). Failures are values of `result`,
    never exceptions; ValueError for terms that do not go together.
    """
    terms = (terms,) if isinstance(terms, Term) else tuple(terms)
    how = {"loss": loss, "solver": solver, "max_steps": max_steps}
    if terms and all(term.touches for term in terms):
        check_families(terms, start, eliminate, held)
        if held is not None:
            held = {name: np.asarray(flags) for name, flags in held.items()}
        how |= {"eliminate": eliminate, "constraints": constraints, "held": held}
        return _as_program(adjust_jointly)(terms, start, **how)
    if len(terms) != 1 or not (eliminate is constraints is held is None):
        raise ValueError(
            "adjust: several terms, `eliminate`, `constraints` and `held` are for "
            "parameters in blocks; name the blocks of every term in its `touches`"
        )
    return _as_program(_adjust_alone)(terms[0], start, **how)


def _as_program(function: Callable) -> Callable:
    """The function of (terms, start, ...) as a program; within a program as it is, for
    the caller says how that is compiled."""
    program = compiled(function)

    def call(terms: Any, start: PyTree, **how: Any) -> Any:
        part = is_traced((terms, start, how))
        return (function if part else program)(terms, start, **how)

    return call


def _adjust_alone(term: Term, start: PyTree, **how: Any) -> Adjustment:
    """All groups touch all parameters."""
    if as_parameters(start).count > normal.UNROLLED:
        return _adjust_as_block(term, start, **how)
    return _adjust_few(term, start, **how)


def _adjust_few(
    term: Term,
    start: PyTree,
    *,
    loss: AbstractLoss | None,
    solver: optx.AbstractLeastSquaresSolver | None,
    max_steps: int,
) -> Adjustment:
    """A few parameters, whose normal equations are written out."""
    # the optimum does not depend on where it is sought
    start = as_parameters(jax.lax.stop_gradient(start))
    called_with = (as_given(start),) if term.prepare is None else start.arguments()
    residuals = Residuals(close(term, *called_with), start, loss)
    solve = lambda origin, residuals: normal.minimise(
        residuals, origin, solver, max_steps
    )
    solution = kernel_part(solve)(start.origin, residuals)
    solved = start.move(solution.value).normalise()
    converged = solution.result == optx.RESULTS.successful
    at_solution = Residuals(residuals.term, solved)
    return read(at_solution, loss, solution.stats["num_steps"], converged)


def _adjust_as_block(term: Term, start: PyTree, **how) -> Adjustment:
    """Many parameters, all of which every group touches, as one block."""

    def of_block(parameters, observation):
        if term.prepare is None:
            return term.condition(parameters, observation)
        shared = term.prepare(*as_parameters(parameters).arguments())
        return term.condition(shared, observation)

    touching = Term(
        of_block,
        term.observations,
        term.cofactor,
        touches=[("all", np.zeros((), int))],
        mask=term.mask,
    )
    family = jax.tree.map(lambda a: jnp.asarray(a)[None], start)
    found = adjust_jointly((touching,), {"all": family}, **how)
    of_group = lambda a: a[:, 0] if a.shape[1] == 1 else a
    return Adjustment(
        parameters=jax.tree.map(lambda a: a[0], found.parameters["all"]),
        normal_matrix=found.normal_matrix,
        cofactor=found.cofactor,
        residuals=of_group(found.residuals[0]),
        redundancy=of_group(found.redundancy[0]),
        sigma0=found.sigma0,
        pivot=found.pivot,
        degrees_of_freedom=found.degrees_of_freedom,
        iterations=found.iterations,
        result=found.result,
    )


def read(
    residuals: Residuals,
    loss: AbstractLoss | None,
    iterations: Int[Array, ""],
    converged: Bool[Array, ""],
) -> Adjustment:
    """Everything that follows from the linearisation at the solution, the centre of
    `residuals`."""
    p = residuals.centre.count
    mask = residuals.term.mask
    linearise = residuals.linearise(*residuals.slopes())
    dtype = residuals.centre.origin[0].dtype
    r, jacobian, weight = jax.vmap(linearise)(*residuals.of_groups)
    n, _, squares, number = normal.accumulate(
        r, jacobian, reweight(loss, r, weight), mask.astype(dtype)
    )
    q, pivot = normal.inverse(n)

    def of_group(observation, cofactor, use):
        r, jacobian, weight = linearise(observation, cofactor, use)
        white = _times_roots(r, weight)
        redundancy = _redundancies(q, jacobian, reweight(loss, r, weight))
        used = lambda entries: [jnp.where(use, entry, 0.0) for entry in entries]
        return used(white), used(redundancy)

    white, redundancy = pointwise(of_group, *residuals.of_groups)
    freedom = len(r) * number.astype(int) - p
    checked = freedom > 0
    cofactor = normal.dense(q)
    if loss is None:
        divisor = jnp.where(checked, freedom, 1).astype(dtype)
        sigma0 = root(squares / divisor)
    else:
        entries = jnp.concatenate(white)
        use = jnp.tile(mask.astype(entries.dtype), len(white))
        sigma0, factor = spread(loss, entries, use, p)
        unweighted, *_ = normal.accumulate(r, jacobian, weight)
        plain = normal.dense(normal.inverse(unweighted)[0])
        cofactor = jnp.where(checked, factor, 1.0) * plain
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.diverged)
    result = RESULTS.where(pivot < normal.SINGULAR, RESULTS.rank_deficient, result)
    return Adjustment(
        parameters=as_given(residuals.centre),
        normal_matrix=normal.dense(n),
        cofactor=cofactor,
        residuals=together(white),
        redundancy=together(redundancy),
        sigma0=jnp.where(checked, sigma0, jnp.nan),
        pivot=pivot,
        degrees_of_freedom=freedom,
        iterations=iterations,
        result=result,
    )


def _times_roots(r: list, weight: list | None) -> list:
    """Residuals times the roots of their weights."""
    if weight is None:
        return r
    return [entry * jnp.sqrt(w) for entry, w in zip(r, weight, strict=True)]


def _redundancies(q: normal.Lower, jacobian: list, weight: list | None) -> list:
    """1 - w a Q aᵀ of the m conditions of a group."""
    out = []
    for c in range(len(jacobian[0])):
        taken = normal.quadratic(q, [column[c] for column in jacobian])
        out.append(1 - (taken if weight is None else weight[c] * taken))
    return out
