"""Propagation of variance through any differentiable function:

    C_y = J C Jᵀ,    J = dy/dx by autodiff.

It is exact for linear functions. For others it is of first order: wrong by the
curvature of the function over the standard deviations of its arguments. Everything
works under jit, vmap and grad.

* `propagate`: from values with a covariance;
* `propagate_each`: a formula for single numbers, applied to arrays element by element,
  errors independent;
* `propagate_adjusted`: from the result of an adjustment.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..xla.passes import total
from ..xla.programs import is_traced
from .guarded import root
from .parameters import as_given, as_parameters

ROUNDING = 1e-9
"""A variance may come out below zero by this part of the sum of its terms."""

ASYMMETRY = 1e-3
"""A covariance may differ from its transpose by this, as a correlation; rounding leaves
less."""


class Propagated(NamedTuple):
    """A value, the standard deviation of each of its numbers (a tree of the same shape)
    and the covariance (m, m) of its numbers laid one behind the other."""

    value: PyTree
    deviations: PyTree
    covariance: Float[Array, "m m"]


@runtime_checkable
class Solution(Protocol):
    """What `propagate_adjusted` reads of a finished adjustment."""

    @property
    def parameters(self) -> PyTree:
        """The adjusted parameters."""

    @property
    def cofactor(self) -> Float[Array, "p p"]:
        """Their cofactors, in the order of their steps."""
        ...

    @property
    def sigma0(self) -> Float[Array, ""]:
        """The estimated standard deviation of unit weight."""
        ...


def jacobian(function: Callable, values: PyTree, *, has_aux: bool = False) -> Any:
    """d function / d values, by forward or reverse mode, whichever is less work: a
    reverse pass costs about two forward passes."""
    out = jax.eval_shape(function, values)
    size = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))
    forward = size(values) < 2 * size(out[0] if has_aux else out)
    derivative = jax.jacfwd if forward else jax.jacrev
    return derivative(function, has_aux=has_aux)(values)


def propagate(function: Callable, values: PyTree, covariance: ArrayLike) -> Propagated:
    """function(values) with its covariance C_y = J C Jᵀ, J = d function / d values.

    `covariance`: (p, p) of the p numbers of `values` laid one behind the other, or (p,)
    its diagonal. A variance that comes out negative beyond rounding, which no valid
    covariance gives, has the deviation NaN. Raises ValueError for another shape and,
    outside of transformations, for a covariance that is not symmetric.
    """
    values = jax.tree.map(_as_float, values)
    flat, unravel = ravel_pytree(values)
    value = function(values)
    y, shaped = ravel_pytree(value)
    c = jnp.asarray(covariance, flat.dtype)
    if c.shape not in ((flat.size,), (flat.size,) * 2):
        raise ValueError(
            f"propagate: {flat.size} values need a covariance of as many rows, got "
            f"shape {c.shape}"
        )
    if c.ndim == 2 and not is_traced(c):
        _check_symmetric(np.asarray(c))
    j = jacobian(lambda x: ravel_pytree(function(unravel(x)))[0], flat)
    spread = _product(j, c)
    variance = jnp.diagonal(spread)
    size = jnp.diagonal(_product(jnp.abs(j), jnp.abs(c)))
    variance = jnp.where(variance < -ROUNDING * size, jnp.nan, variance)
    return Propagated(value, shaped(root(variance).astype(y.dtype)), spread)


def _as_float(value: ArrayLike) -> ArrayLike:
    """Numbers that have no derivative, such as integers, as floating-point numbers."""
    inexact = jnp.issubdtype(jnp.result_type(value), jnp.inexact)
    return value if inexact else jnp.asarray(value, float)


def _product(j: Array, c: Array) -> Array:
    """J C Jᵀ; C may be its diagonal."""
    return (j * c[None, :] if c.ndim == 1 else j @ c) @ j.T


def _check_symmetric(c: np.ndarray) -> None:
    size = np.sqrt(np.abs(np.diagonal(c)))
    wrong = np.abs(c - c.T) > ASYMMETRY * np.outer(size, size)
    i, j = np.unravel_index(np.argmax(wrong), c.shape)
    if i != j:
        raise ValueError(
            f"propagate: a covariance is symmetric, but entry ({i}, {j}) is "
            f"{c[i, j]:g} and ({j}, {i}) is {c[j, i]:g}"
        )


def propagate_each(function: Callable, values: PyTree, deviations: PyTree) -> PyTree:
    """Standard deviations of a formula written for single numbers, applied to arrays of
    any shape element by element:

        s² = Σ_k (d function / d values_k)² s_k²,    errors independent.

    `values` and `deviations` are trees of the same structure; their arrays are
    broadcast together, and every number of the result has that shape.
    """
    numbers, structure = jax.tree.flatten(values)
    leaves = *numbers, *jax.tree.leaves(deviations)
    arrays = jnp.broadcast_arrays(*(jnp.asarray(a, float) for a in leaves))

    def one(*entries):
        numbers, s = entries[: structure.num_leaves], entries[structure.num_leaves :]
        formula = lambda *x: function(jax.tree.unflatten(structure, x))
        push = jax.linearize(formula, *numbers)[1]
        zeros = [jnp.zeros_like(error) for error in s]
        effects = [
            push(*zeros[:k], error, *zeros[k + 1 :]) for k, error in enumerate(s)
        ]
        together = lambda *parts: root(total(jnp.stack(parts, axis=-1) ** 2))
        return jax.tree.map(together, *effects)

    found = jax.vmap(one)(*(a.ravel() for a in arrays))
    return jax.tree.map(lambda a: a.reshape(arrays[0].shape), found)


def propagate_adjusted(
    function: Callable, solved: Solution, sigma0: ArrayLike | None = None
) -> Propagated:
    """`propagate` through a function of adjusted parameters, such as the elements of an
    orientation, with their covariance sigma0² Q: with the estimated sigma0, or the one
    given (1 where the given sigmas are true).

    For functions of the parameters alone. Model points depend on their coordinates as
    well: see `assessment.budget`.
    """
    found = as_parameters(solved.parameters)
    variance = jnp.asarray(solved.sigma0 if sigma0 is None else sigma0) ** 2
    origin = jnp.zeros(solved.cofactor.shape[-1], solved.cofactor.dtype)
    of_step = lambda step: function(as_given(found.move(tuple(step))))
    return propagate(of_step, origin, variance * solved.cofactor)
