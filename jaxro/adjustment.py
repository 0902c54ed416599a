"""The adjustment of any condition between parameters and measurements.

    g(x, l_i + v_i) = 0  for every observation group i,    Σ v_iᵀ Q_i⁻¹ v_i = min.

Each group is linearised by autodiff, B = dg/dl, and whitened by the Cholesky factor of its cofactor B Q Bᵀ; the sum of
squares of the whitened residuals r_i = L_i⁻¹ g_i is minimised by optimistix and the finished solution is read: normal
matrix, cofactors, redundancy, sigma0. Observation equations l = f(x) are the case g = f(x) - l. Conditions that are not
linear in l are satisfied to first order in v (the second order is |v| over the radius of curvature).
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from . import normal_equations as normal
from .elements import AbstractElements
from .guarded import root, times
from .losses import AbstractLoss
from .programs import part
from .reductions import count
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
        return times(self.cofactor, (self.sigma0 if sigma0 is None else jnp.asarray(sigma0)) ** 2)


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


def discrepancy(condition: Callable, parameters: Parameters, observation: PyTree, cofactor: PyTree, use):
    """The m entries of g of one group, and the lower triangle of B Q Bᵀ (the unit matrix where it is not used).

    A cofactor stands for every entry of its part of the observation; entries whose cofactor is None are free of error.
    """
    known = jax.tree.map(
        lambda q, part: jax.tree.map(lambda _: q is not None, part), cofactor, observation, is_leaf=_none
    )
    measured, exact = eqx.partition(observation, known)

    def values(measured):
        g = condition(parameters, eqx.combine(measured, exact))
        return [g] if jnp.ndim(g) == 0 else [g[k] for k in range(g.shape[0])]

    g, pull = jax.vjp(values, measured)
    one, zero = jnp.ones_like(g[0]), jnp.zeros_like(g[0])
    rows = [pull([one if j == k else zero for j in range(len(g))])[0] for k in range(len(g))]

    def product(a: PyTree, b: PyTree):
        """a Q bᵀ; one product by a variance that several entries share."""
        part = lambda q, x, y: None if q is None else q * _dot(x, y, jnp.shape(q))
        return sum(jnp.sum(t) for t in jax.tree.leaves(jax.tree.map(part, cofactor, a, b, is_leaf=_none)))

    d = [[product(rows[i], rows[j]) for j in range(i + 1)] for i in range(len(g))]
    for i in range(len(g)):  # a masked group must not divide by its own zero
        d[i][i] = jnp.where(use, d[i][i], one)
    return g, d


def _none(leaf) -> bool:
    return leaf is None


def _dot(a: PyTree, b: PyTree, shape: tuple[int, ...]):
    """Sum of the products of two trees of entries, each reduced to the shape of their cofactor."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(x * y if jnp.shape(x) == shape else jnp.sum(x * y) for x, y in pairs)


def whitened(g: list, d: list, use) -> list:
    """The m entries of L⁻¹ g of one group, L Lᵀ = B Q Bᵀ; zero where the group is not used."""
    zero = jnp.zeros_like(g[0])
    if len(g) == 1:
        return [jnp.where(use, g[0] / jnp.sqrt(d[0][0]), zero)]
    factor, _ = normal.cholesky(d)
    out: list = []
    for i, row in enumerate(factor):
        s = g[i]
        for k in range(i):
            s = s - row[k] * out[k]
        out.append(jnp.where(use, s * row[i], zero))
    return out


class Residuals(eqx.Module):
    """The whitened residuals of all groups as a function of a displacement x of the parameters from `centre`.

    What the groups share is computed once by `prepare(parameters)`, of elements `prepare(R, b)`; its few numbers θ are
    what a group's condition sees.
    """

    prepare: Callable | None
    condition: Callable
    centre: Parameters
    observations: PyTree
    cofactor: PyTree
    mask: Bool[Array, " group"]
    loss: AbstractLoss | None = None

    def shared(self, *x: Array) -> PyTree:
        """θ(x): what `prepare` makes of the parameters, or the parameters themselves."""
        parameters = moved(self.centre, x)
        return self._prepared(*(parameters.relative() if self._of_elements else (parameters,)))

    @property
    def _of_elements(self) -> bool:
        return self.prepare is not None and isinstance(self.centre, AbstractElements)

    def _prepared(self, *parameters) -> PyTree:
        return parameters[0] if self.prepare is None else jax.tree.map(jnp.asarray, self.prepare(*parameters))

    def further(self, x: tuple[Array, ...], step: tuple[Array, ...]) -> tuple[Array, ...]:
        """The displacement x followed by a step, which has the directions of `columns`."""
        if self._of_elements:
            return self.centre.further(x, step)
        return tuple(a + b for a, b in zip(x, step, strict=True))

    def groups(self, function: Callable, theta: PyTree) -> Any:
        """function(g, B Q Bᵀ, use) of every group."""
        one = lambda l, q, use: function(*discrepancy(self.condition, theta, l, q, use), use)
        return jax.vmap(one)(self.observations, self.cofactor, self.mask)

    def residuals(self, g: list, d: list, use) -> list:
        """The m whitened (and, with a loss, transformed) residuals of one group."""
        r = whitened(g, d, use)
        return r if self.loss is None else [self.loss.transformed(entry) for entry in r]

    def __call__(self, x: tuple[Array, ...]) -> Float[Array, " group"] | Float[Array, "group m"]:
        return together(self.groups(self.residuals, self.shared(*x)))

    def columns(self, x: tuple[Array, ...]) -> tuple[list[Array], Sequence[Sequence[Any]], list[Array] | None]:
        """The m residual arrays, for each direction at x the m arrays of its column, and the weights of both.

        A single condition stays unwhitened, residual g and weight 1/d, d = B Q Bᵀ: its column is √d times that of
        g/√d, that is ∂g - g ∂d / 2d, and no root is taken; one gradient by θ gives all columns. A loss enters as the
        weight rho'(r²): steps are those of iteratively reweighted least squares, which do not overshoot as those of
        the transformed residual may.
        """
        if self._of_elements:
            theta, along = self.centre.slopes(self._prepared, x)
        else:
            theta, along = normal.slopes(self.shared, x)

        def one(observation, cofactor, use):
            at = lambda theta: discrepancy(self.condition, theta, observation, cofactor, use)
            (g, d), pull = jax.vjp(at, theta)
            if len(g) > 1:
                r, push = jax.linearize(lambda theta: whitened(*at(theta), use), theta)
                full = lambda entry, slope: jnp.zeros_like(entry) if slope is None else slope
                return r, [push(jax.tree.map(full, theta, slope)) for slope in along], None
            weight = jnp.where(use, 1 / d[0][0], 0.0)
            (gradient,) = pull(([jnp.ones_like(weight)], [[-0.5 * g[0] * weight]]))
            return g, [[normal.inner(gradient, slope)] for slope in along], [weight]

        r, columns, weight = jax.vmap(one)(self.observations, self.cofactor, self.mask)
        return r, columns, reweighted(self.loss, r, weight)


def reweighted(loss: AbstractLoss | None, r: list[Array], weight: list[Array] | None) -> list[Array] | None:
    """The weights w (None: 1) of residuals r, times rho'(w r²) of the loss."""
    if loss is None:
        return weight
    if weight is None:
        return [loss.weight(entry**2) for entry in r]
    return [w * loss.weight(w * entry**2) for w, entry in zip(weight, r, strict=True)]


def together(entries: list) -> Float[Array, " group"] | Float[Array, "group m"]:
    """The m arrays of all groups as one."""
    return entries[0] if len(entries) == 1 else jnp.stack(entries, axis=1)


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
    leaves have the groups on the first axis; `cofactor`: its variances (relative to sigma0²), a tree that may end above
    the leaves and then holds for all of them: numbers or one per group, None for what is free of error. `mask` selects
    groups. `start`: elements, or any pytree of numbers.
    `prepare`: what all groups share, computed once; the condition then gets prepare(parameters) for the parameters, and
    with elements prepare(R, b) of their `relative`.
    `solver`: any optimistix least-squares solver; `GaussNewton()` if None.

    With a loss, normal matrix and redundancy carry the final weights rho'(r²), and sigma0² = Σ w r² / (n - p): the
    usual approximation for M-estimators. Derivatives of every field by the observations and cofactors are exact
    (implicit function theorem). Failures are values of `result`, never exceptions.
    """
    groups = jax.tree.leaves(observations)[0].shape[0]
    if mask is None:
        mask = jnp.ones(groups, bool)
    dtype = jax.tree.leaves(start)[0].dtype
    cofactor = jax.tree.map(lambda q: jnp.broadcast_to(jnp.asarray(q, dtype), (groups, *jnp.shape(q)[1:])), cofactor)
    start = jax.lax.stop_gradient(start)  # the optimum does not depend on where it is sought
    residuals = residuals_of(condition, prepare, start, observations, cofactor, mask, loss)
    p = dimension(start)
    origin = tuple(jnp.zeros((), jax.tree.leaves(start)[0].dtype) for _ in range(p))
    solve = lambda origin, residuals: optx.least_squares(
        lambda x, residuals: residuals(x),
        normal.GaussNewton() if solver is None else solver,
        origin,
        args=residuals,
        max_steps=max_steps,
        adjoint=optx.ImplicitAdjoint(linear_solver=normal.SmallCholesky()),
        throw=False,
    )
    solution = part(solve)(origin, residuals)
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
        parameters = centre.relative() if isinstance(centre, AbstractElements) else (centre,)
        prepare = eqx.filter_closure_convert(prepare, *parameters)
        prepared = jax.eval_shape(prepare, *parameters)
    else:
        prepared = centre
    first = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), observations)
    condition = eqx.filter_closure_convert(condition, prepared, first)
    return Residuals(prepare, condition, centre, observations, cofactor, mask, loss)


def read(residuals: Residuals, loss: AbstractLoss | None, iterations, converged) -> Adjustment:
    """Everything that follows from the linearisation at the solution, the centre of `residuals`."""
    p = dimension(residuals.centre)
    zero = jnp.zeros((), jax.tree.leaves(residuals.centre)[0].dtype)
    r, jacobian, weight = residuals.columns((zero,) * p)
    white = r
    if weight is not None:
        white = [jnp.where(residuals.mask, entry * jnp.sqrt(w), 0.0) for entry, w in zip(r, weight, strict=True)]
    weight = reweighted(loss, r, weight)
    n, _, squares = normal.accumulate(r, jacobian, weight)
    q, pivot = normal.inverse(n)
    redundancy = []
    for c in range(len(r)):
        taken = normal.quadratic(q, [jacobian[k][c] for k in range(p)])
        redundancy.append(jnp.where(residuals.mask, 1 - (taken if weight is None else weight[c] * taken), 0.0))
    freedom = len(r) * count(residuals.mask).astype(int) - p
    checked = freedom > 0
    variance = squares / jnp.where(checked, freedom, 1).astype(r[0].dtype)
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.diverged)
    result = RESULTS.where(pivot < normal.SINGULAR, RESULTS.rank_deficient, result)
    return Adjustment(
        residuals.centre,
        normal.dense(n),
        normal.dense(q),
        together(white),
        together(redundancy),
        jnp.where(checked, root(variance), jnp.nan),
        pivot,
        freedom,
        iterations,
        result,
    )
