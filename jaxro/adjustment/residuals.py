"""The whitened residuals of any condition between parameters and measurements, and
their derivatives.

Each group of conditions g(x, l) = 0 is linearised by autodiff, B = dg/dl, and whitened
by the Cholesky factor of its cofactor B Q Bᵀ.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from . import normal_equations as normal
from .losses import AbstractLoss
from .parameters import AbstractParameters, as_given


def discrepancy(
    condition: Callable, parameters: PyTree, observation: PyTree, cofactor: PyTree, use
):
    """The m entries of g of one group, and the lower triangle of B Q Bᵀ (the unit
    matrix where it is not used).

    A cofactor stands for every entry of its part of the observation; entries whose
    cofactor is None are free of error.
    """
    known = jax.tree.map(
        lambda q, part: jax.tree.map(lambda _: q is not None, part),
        cofactor,
        observation,
        is_leaf=_none,
    )
    measured, exact = eqx.partition(observation, known)

    def values(measured):
        g = condition(parameters, eqx.combine(measured, exact))
        return [g] if jnp.ndim(g) == 0 else [g[k] for k in range(g.shape[0])]

    g, pull = jax.vjp(values, measured)
    one, zero = jnp.ones_like(g[0]), jnp.zeros_like(g[0])
    rows = [
        pull([one if j == k else zero for j in range(len(g))])[0] for k in range(len(g))
    ]

    def product(a: PyTree, b: PyTree):
        """a Q bᵀ; one product by a variance that several entries share."""
        part = lambda q, x, y: None if q is None else q * _dot(x, y, jnp.shape(q))
        return sum(
            jnp.sum(t)
            for t in jax.tree.leaves(jax.tree.map(part, cofactor, a, b, is_leaf=_none))
        )

    d = [[product(rows[i], rows[j]) for j in range(i + 1)] for i in range(len(g))]
    for i in range(len(g)):  # a masked group must not divide by its own zero
        d[i][i] = jnp.where(use, d[i][i], one)
    return g, d


def _none(leaf) -> bool:
    return leaf is None


def _dot(a: PyTree, b: PyTree, shape: tuple[int, ...]):
    """Sum of the products of two trees of entries, each reduced to the shape of their
    cofactor."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(x * y if jnp.shape(x) == shape else jnp.sum(x * y) for x, y in pairs)


def whitened(g: list, d: list, use) -> list:
    """The m entries of L⁻¹ g of one group, L Lᵀ = B Q Bᵀ; zero where the group is not
    used."""
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
    """The whitened residuals of all groups as a function of a displacement x of the
    parameters from `centre`.

    What the groups share is computed once by `prepare` of the `arguments` of the
    parameters; its few numbers θ are what a group's condition sees. Without it that
    sees the parameters.
    """

    prepare: Callable | None
    condition: Callable
    centre: AbstractParameters
    observations: PyTree
    cofactor: PyTree
    mask: Bool[Array, " group"]
    loss: AbstractLoss | None = None

    def shared(self, *x: Array) -> PyTree:
        """θ(x): what `prepare` makes of the parameters, or the parameters
        themselves."""
        parameters = self.centre.moved(x)
        return (
            as_given(parameters)
            if self.prepare is None
            else self.prepared(*parameters.arguments())
        )

    def prepared(self, *arguments) -> PyTree:
        return jax.tree.map(jnp.asarray, self.prepare(*arguments))  # pyright: ignore[reportOptionalCall]

    def correction(self, x: tuple[Array, ...]) -> tuple[Array, ...]:
        """What Gauss-Newton subtracts from the displacement."""
        return normal.correction(self.columns(x))

    def further(
        self, x: tuple[Array, ...], step: tuple[Array, ...]
    ) -> tuple[Array, ...]:
        """The displacement x followed by a step, which has the directions of
        `columns`."""
        if self.prepare is None:
            return tuple(a + b for a, b in zip(x, step, strict=True))
        return self.centre.further(x, step)

    def groups(self, function: Callable, theta: PyTree) -> Any:
        """function(g, B Q Bᵀ, use) of every group."""
        one = lambda l, q, use: function(
            *discrepancy(self.condition, theta, l, q, use), use
        )
        return jax.vmap(one)(self.observations, self.cofactor, self.mask)

    def residuals(self, g: list, d: list, use) -> list:
        """The m whitened (and, with a loss, transformed) residuals of one group."""
        r = whitened(g, d, use)
        return r if self.loss is None else [self.loss.transformed(entry) for entry in r]

    def __call__(
        self, x: tuple[Array, ...]
    ) -> Float[Array, " group"] | Float[Array, "group m"]:
        return together(self.groups(self.residuals, self.shared(*x)))

    def columns(
        self, x: tuple[Array, ...]
    ) -> tuple[list[Array], Sequence[Sequence[Any]], list[Array] | None]:
        """The m residual arrays, for each direction at x the m arrays of its column,
        and the weights of both."""
        r, columns, weight = jax.vmap(self.linearised(x))(
            self.observations, self.cofactor, self.mask
        )
        return r, columns, reweighted(self.loss, r, weight)

    def linearised(self, x: tuple[Array, ...]) -> Callable:
        """A function of a group's observation, its cofactors and whether it is used:
        the m residuals at x, for each direction the m entries of its column, and the
        weights of both but for a loss.

        A single condition stays unwhitened, residual g and weight 1/d, d = B Q Bᵀ: its
        column is √d times that of g/√d, that is ∂g - g ∂d / 2d, and no root is taken;
        one gradient by θ gives all columns. A loss enters as the weight rho'(r²): steps
        are those of iteratively reweighted least squares, which do not overshoot as
        those of the transformed residual may.
        """
        if self.prepare is None:
            theta, along = normal.slopes(self.shared, x)
        else:
            theta, along = self.centre.slopes(self.prepared, x)

        def one(observation, cofactor, use):
            at = lambda theta: discrepancy(
                self.condition, theta, observation, cofactor, use
            )
            (g, d), pull = jax.vjp(at, theta)
            if len(g) > 1:
                r, push = jax.linearize(lambda theta: whitened(*at(theta), use), theta)
                full = lambda entry, slope: (
                    jnp.zeros_like(entry) if slope is None else slope
                )
                return (
                    r,
                    [push(jax.tree.map(full, theta, slope)) for slope in along],
                    None,
                )
            weight = jnp.where(use, 1 / d[0][0], 0.0)
            (gradient,) = pull(([jnp.ones_like(weight)], [[-0.5 * g[0] * weight]]))
            return g, [[normal.inner(gradient, slope)] for slope in along], [weight]

        return one


def reweighted(
    loss: AbstractLoss | None, r: list[Array], weight: list[Array] | None
) -> list[Array] | None:
    """The weights w (None: 1) of residuals r, times rho'(w r²) of the loss."""
    if loss is None:
        return weight
    if weight is None:
        return [loss.weight(entry**2) for entry in r]
    return [w * loss.weight(w * entry**2) for w, entry in zip(weight, r, strict=True)]


def together(entries: list) -> Float[Array, " group"] | Float[Array, "group m"]:
    """The m arrays of all groups as one."""
    return entries[0] if len(entries) == 1 else jnp.stack(entries, axis=1)


def residuals_of(
    condition, prepare, centre, observations, cofactor, mask, loss=None
) -> Residuals:
    """`Residuals` whose functions carry what they close over as arguments, so that it
    can be differentiated."""
    if prepare is not None:
        prepare = eqx.filter_closure_convert(prepare, *centre.arguments())
        prepared = jax.eval_shape(prepare, *centre.arguments())
    else:
        prepared = as_given(centre)
    first = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), observations
    )
    condition = eqx.filter_closure_convert(condition, prepared, first)
    return Residuals(prepare, condition, centre, observations, cofactor, mask, loss)
