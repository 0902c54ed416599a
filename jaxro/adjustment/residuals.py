"""The whitened residuals of a term as a function of all parameters, and their
derivatives."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from . import normal_equations as normal
from .levenberg_marquardt import DampedStep, promised
from .losses import AbstractLoss
from .parameters import AbstractParameters, as_given
from .terms import Term, discrepancy, whiten


class Residuals(eqx.Module):
    """The whitened residuals of a term as a function of a displacement x of all
    parameters from `centre`; at the centre itself if x is empty.

    θ is what the condition of a group is called with: what `term.prepare` makes of the
    `arguments` of the parameters, or the parameters themselves.
    """

    term: Term
    centre: AbstractParameters
    loss: AbstractLoss | None = None

    def shared(self, *x: Array) -> PyTree:
        """θ(x): what `prepare` makes of the parameters, or the parameters
        themselves."""
        parameters = self.centre.at(x)
        if self.term.prepare is None:
            return as_given(parameters)
        return self._prepare(*parameters.arguments())

    def _prepare(self, *arguments) -> PyTree:
        return jax.tree.map(jnp.asarray, self.term.prepare(*arguments))  # pyright: ignore[reportOptionalCall]

    def correction(self, x: tuple[Array, ...]) -> tuple[Array, ...]:
        """What Gauss-Newton subtracts from the displacement."""
        return normal.correction(self.columns(x))

    def damped(self, x: tuple[Array, ...], damping: Float[Array, ""]) -> DampedStep:
        """What Levenberg-Marquardt subtracts from the displacement."""
        n, h, _ = normal.accumulate(*self.columns(x))
        diagonal = [row[-1] for row in n]
        larger = [[*row[:-1], row[-1] * (1 + damping)] for row in n]
        step = tuple(normal.solve(larger, h))
        of_all, moved = jnp.stack(list(h)), jnp.stack(list(step))
        decrement = jnp.sum(of_all * moved)
        spread = jnp.sum(jnp.stack(diagonal) * moved**2)
        return promised(step, decrement, damping, spread)

    def further(
        self, x: tuple[Array, ...], step: tuple[Array, ...]
    ) -> tuple[Array, ...]:
        """The displacement x followed by a step, which has the directions of
        `columns`."""
        if self.term.prepare is None:
            return tuple(a + b for a, b in zip(x, step, strict=True))
        return self.centre.further(x, step)

    @property
    def of_groups(self) -> tuple[PyTree, PyTree, Bool[Array, " group"]]:
        """Observations, cofactors and mask, group by group."""
        return self.term.observations, self.term.cofactor, self.term.mask

    def groups(self, function: Callable, theta: PyTree) -> Any:
        """function(g, B Q Bᵀ, use) of every group."""
        one = lambda l, q, use: function(
            *discrepancy(self.term.condition, theta, l, q, use), use
        )
        return jax.vmap(one)(*self.of_groups)

    def residuals(self, g: list, d: list, use) -> list:
        """The m whitened (and, with a loss, transformed) residuals of one group."""
        r = whiten(g, d, use)
        return r if self.loss is None else [self.loss.transform(entry) for entry in r]

    def __call__(
        self, x: tuple[Array, ...] = ()
    ) -> Float[Array, " group"] | Float[Array, "group m"]:
        return together(self.groups(self.residuals, self.shared(*x)))

    def columns(
        self, x: tuple[Array, ...] = ()
    ) -> tuple[list[Array], Sequence[Sequence[Any]], list[Array] | None]:
        """The m residual arrays, for each direction at x the m arrays of its column,
        and the weights of both."""
        r, columns, weight = jax.vmap(self.linearise(*self.slopes(x)))(*self.of_groups)
        return r, columns, reweight(self.loss, r, weight)

    def slopes(self, x: tuple[Array, ...] = ()) -> tuple[PyTree, list[PyTree]]:
        """θ(x) and its derivatives along all directions."""
        if self.term.prepare is None:
            return normal.slopes(self.shared, x or self.centre.origin)
        return self.centre.slopes(self._prepare, x, bilinear=self.term.bilinear)

    def linearise(self, theta: PyTree, along: list[PyTree]) -> Callable:
        """A function of a group's observation, its cofactors and whether it is used:
        the m residuals for θ, for each direction the m entries of its column, and the
        weights of both but for a loss. `along`: the derivatives of θ.

        A single condition stays unwhitened, residual g and weight 1/d, d = B Q Bᵀ: its
        column is √d times that of g/√d, that is ∂g - g ∂d / 2d, and no root is taken;
        one gradient by θ gives all columns. A loss enters as the weight rho'(r²): steps
        are those of iteratively reweighted least squares, which do not overshoot as
        those of the transformed residual may.
        """

        def one(observation, cofactor, use):
            at = lambda theta: discrepancy(
                self.term.condition, theta, observation, cofactor, use
            )
            (g, d), pull = jax.vjp(at, theta)
            if len(g) > 1:
                r, push = jax.linearize(lambda theta: whiten(*at(theta), use), theta)
                return r, [push(slope) for slope in along], None
            weight = jnp.where(use, 1 / d[0][0], 0.0)
            (gradient,) = pull(([jnp.ones_like(weight)], [[-0.5 * g[0] * weight]]))
            return g, [[normal.inner(gradient, slope)] for slope in along], [weight]

        return one


def reweight(
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
