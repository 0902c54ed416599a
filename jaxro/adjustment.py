"""The adjustment of any condition between parameters and measurements.

    g(x, l_i + v_i) = 0  for every observation group i,    Σ v_iᵀ Q_i⁻¹ v_i = min.

Each group is linearised by autodiff, B = dg/dl, and whitened by the Cholesky factor of its cofactor B Q Bᵀ; the sum of
squares of the whitened residuals r_i = L_i⁻¹ g_i is minimised by optimistix and the finished solution is read: normal
matrix, cofactors, redundancy, sigma0. Observation equations l = f(x) are the case g = f(x) - l. Conditions that are not
linear in l are satisfied to first order in v (the second order is |v| over the radius of curvature).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from . import normal_equations as normal
from .elements import AbstractElements
from .losses import AbstractLoss
from .results import RESULTS

Parameters = Any


class Adjustment(eqx.Module):
    """A finished adjustment of p parameters from groups of m conditions each.

    `residuals` are whitened: of the unit of sigma0, and dimensionless where the cofactors are true variances.
    `cofactor` is that of the parameters (for `RelativePose`, of its five local parameters at the solution).
    """

    parameters: Parameters
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
        """sigma0² Q: a posteriori, or a priori with the sigma0 given (1 where the cofactors are variances)."""
        return (self.sigma0 if sigma0 is None else jnp.asarray(sigma0)) ** 2 * self.cofactor


def moved(parameters: Parameters, step: tuple) -> Parameters:
    """The parameters displaced by their local coordinates; plain pytrees by addition."""
    if isinstance(parameters, AbstractElements):
        return parameters.moved(step)
    leaves, structure = jax.tree.flatten(parameters)
    rest, out = list(step), []
    for leaf in leaves:
        size = jnp.size(leaf)
        out.append(leaf + (rest[0] if jnp.ndim(leaf) == 0 else jnp.stack(rest[:size]).reshape(jnp.shape(leaf))))
        rest = rest[size:]
    return jax.tree.unflatten(structure, out)


def dimension(parameters: Parameters) -> int:
    """The number of local parameters."""
    if isinstance(parameters, AbstractElements):
        return len(parameters.names)
    return sum(jnp.size(leaf) for leaf in jax.tree.leaves(parameters))


def whitened(condition: Callable, parameters: Parameters, observation: PyTree, cofactor: PyTree, use) -> list:
    """The m entries of L⁻¹ g of one group, L Lᵀ = B Q Bᵀ; zero where the group is not used.

    Entries of the observation whose cofactor is None are free of error.
    """
    filled = jax.tree.map(lambda q, _: q is not None, cofactor, observation, is_leaf=lambda q: q is None)
    measured, exact = eqx.partition(observation, filled)

    def values(measured):
        g = condition(parameters, eqx.combine(measured, exact))
        return [g] if jnp.ndim(g) == 0 else [g[k] for k in range(g.shape[0])]

    g, pull = jax.vjp(values, measured)
    one, zero = jnp.ones_like(g[0]), jnp.zeros_like(g[0])
    rows = [jax.tree.leaves(pull([one if j == k else zero for j in range(len(g))])[0]) for k in range(len(g))]
    variances = jax.tree.leaves(cofactor)
    weight = [
        [sum(jnp.sum(q * a * b) for q, a, b in zip(variances, rows[i], rows[j], strict=True)) for j in range(i + 1)]
        for i in range(len(g))
    ]
    for i in range(len(g)):  # a masked group must not divide by its own zero
        weight[i][i] = jnp.where(use, weight[i][i], one)
    if len(g) == 1:
        return [jnp.where(use, g[0] * jax.lax.rsqrt(weight[0][0]), zero)]
    factor, _ = normal.cholesky(weight)
    out: list = []
    for i, row in enumerate(factor):
        s = g[i]
        for k in range(i):
            s = s - row[k] * out[k]
        out.append(jnp.where(use, s * row[i], zero))
    return out


class Residuals(eqx.Module):
    """The whitened residuals of all groups as a function of a displacement x of the parameters from `centre`.

    What the groups share is computed once by `prepare(parameters)`; its few numbers θ are what a group's condition
    sees. A column of the Jacobian is then Σ_m (dr/dθ_m) (dθ_m/dx_k): the first factor by reverse mode for each group,
    the second once for all of them.
    """

    prepare: Callable | None
    condition: Callable
    centre: Parameters
    observations: PyTree
    cofactor: PyTree
    mask: Bool[Array, " group"]
    loss: AbstractLoss | None = None

    def around(self, centre: Parameters) -> "Residuals":
        """The same residuals without a loss, around other parameters."""
        return Residuals(self.prepare, self.condition, centre, self.observations, self.cofactor, self.mask)

    def shared(self, *x: Array) -> PyTree:
        """θ(x): what `prepare` makes of the parameters, or x itself."""
        return x if self.prepare is None else jax.tree.map(jnp.asarray, self.prepare(moved(self.centre, x)))

    def group(self, theta: PyTree, observation: PyTree, cofactor: PyTree, use) -> list:
        """The m whitened (and, with a loss, transformed) residuals of one group."""
        prepared = moved(self.centre, theta) if self.prepare is None else theta
        r = whitened(self.condition, prepared, observation, cofactor, use)
        return r if self.loss is None else [self.loss.transformed(entry) for entry in r]

    def __call__(self, x: tuple[Array, ...]) -> Float[Array, " group"] | Float[Array, "group m"]:
        theta = self.shared(*x)
        each = jax.vmap(lambda *one: self.group(theta, *one))
        r = each(self.observations, self.cofactor, self.mask)
        return r[0] if len(r) == 1 else jnp.stack(r, axis=1)

    def columns(self, x: tuple[Array, ...]) -> tuple[list[Array], list[list[Array]]]:
        """The m residual arrays, and for each parameter the m arrays of its column."""
        theta = self.shared(*x)

        def one(*group):
            r, pull = jax.vjp(lambda theta: self.group(theta, *group), theta)
            unit = lambda c: [jnp.ones_like(entry) if k == c else jnp.zeros_like(entry) for k, entry in enumerate(r)]
            return r, [pull(unit(c))[0] for c in range(len(r))]

        r, gradients = jax.vmap(one)(self.observations, self.cofactor, self.mask)
        if self.prepare is None:
            return r, [[gradient[k] for gradient in gradients] for k in range(len(x))]
        jacobian = []
        for k in range(len(x)):  # one parameter at a time: what it does not touch stays a symbolic zero
            along = lambda t, k=k: self.shared(*x[:k], t, *x[k + 1 :])
            _, slope = jax.jvp(along, (x[k],), (jnp.ones_like(x[k]),))
            slope = jax.tree.leaves(slope)
            jacobian.append([sum(d * s for d, s in zip(jax.tree.leaves(g), slope, strict=True)) for g in gradients])
        return r, jacobian


def adjust(
    condition: Callable,
    start: Parameters,
    observations: PyTree,
    cofactor: PyTree,
    mask: Bool[Array, " group"] | None = None,
    *,
    prepare: Callable | None = None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 30,
) -> Adjustment:
    """Adjust parameters to measurements: Σ |L_i⁻¹ g(x, l_i)|² = min, or Σ rho of it with a robust loss.

    `condition(parameters, observation)` of one group returns a number or m of them. `observations`: a pytree whose
    leaves have the groups on the first axis; `cofactor`: the same tree of variances (relative to sigma0²), numbers or
    one per group, None for what is free of error. `mask` selects groups. `start`: elements, or any pytree of numbers.
    `prepare`: what all groups share, computed once; the condition then gets prepare(parameters) for the parameters.
    `solver`: any optimistix least-squares solver; `GaussNewton()` if None.

    With a loss, normal matrix and redundancy carry the final weights rho'(r²), and sigma0² = Σ w r² / (n - p): the
    usual approximation for M-estimators. Derivatives of every field by the observations and cofactors are exact
    (implicit function theorem). Failures are values of `result`, never exceptions.
    """
    groups = jax.tree.leaves(observations)[0].shape[0]
    if mask is None:
        mask = jnp.ones(groups, bool)
    cofactor = jax.tree.map(
        lambda q, l: None if q is None else jnp.broadcast_to(jnp.asarray(q, l.dtype), l.shape),
        cofactor,
        observations,
        is_leaf=lambda q: q is None,
    )
    start = jax.lax.stop_gradient(start)
    residuals = residuals_of(condition, prepare, start, observations, cofactor, mask, loss)
    p = dimension(start)
    origin = tuple(jnp.zeros((), jax.tree.leaves(start)[0].dtype) for _ in range(p))
    solution = optx.least_squares(
        lambda x, residuals: residuals(x),
        normal.GaussNewton() if solver is None else solver,
        origin,
        args=residuals,
        max_steps=max_steps,
        adjoint=optx.ImplicitAdjoint(linear_solver=normal.SmallCholesky()),
        throw=False,
    )
    parameters = moved(start, solution.value)
    if isinstance(parameters, AbstractElements):
        parameters = parameters.normalised()
    converged = solution.result == optx.RESULTS.successful
    at_solution = eqx.tree_at(
        lambda r: (r.centre, r.loss), residuals, (parameters, None), is_leaf=lambda leaf: leaf is None
    )
    return read(at_solution, loss, solution.stats["num_steps"], converged)


def residuals_of(condition, prepare, centre, observations, cofactor, mask, loss=None) -> Residuals:
    """`Residuals` whose functions carry what they close over as arguments, so that it can be differentiated."""
    if prepare is not None:
        prepare = eqx.filter_closure_convert(prepare, centre)
        prepared = jax.eval_shape(prepare, centre)
    else:
        prepared = centre
    first = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), observations)
    condition = eqx.filter_closure_convert(condition, prepared, first)
    return Residuals(prepare, condition, centre, observations, cofactor, mask, loss)


def read(residuals: Residuals, loss: AbstractLoss | None, iterations, converged) -> Adjustment:
    """Everything that follows from the linearisation at the solution, the centre of `residuals`."""
    p = dimension(residuals.centre)
    zero = jnp.zeros((), jax.tree.leaves(residuals.centre)[0].dtype)
    r, jacobian = residuals.columns((zero,) * p)
    weight = None if loss is None else [loss.weight(entry * entry) for entry in r]
    n, _, squares = normal.accumulate(r, jacobian, weight)
    q, pivot = normal.inverse(n)
    redundancy = []
    for c in range(len(r)):
        column = [jacobian[k][c] for k in range(p)]
        taken = sum((1.0 if i == j else 2.0) * q[i][j] * column[i] * column[j] for i in range(p) for j in range(i + 1))
        redundancy.append(jnp.where(residuals.mask, 1 - (taken if weight is None else weight[c] * taken), 0.0))
    together = lambda a: a[0] if len(a) == 1 else jnp.stack(a, axis=1)
    freedom = len(r) * jnp.sum(residuals.mask) - p
    checked = freedom > 0
    variance = squares / jnp.where(checked, freedom, 1).astype(r[0].dtype)
    positive = variance > 0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1.0)), 0.0)
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.diverged)
    result = RESULTS.where(pivot < normal.SINGULAR, RESULTS.rank_deficient, result)
    return Adjustment(
        residuals.centre,
        normal.dense(n),
        normal.dense(q),
        together(r),
        together(redundancy),
        jnp.where(checked, root, jnp.nan),
        pivot,
        freedom,
        iterations,
        result,
    )
