"""Propagation of variance through any differentiable function: C_y = J C Jᵀ, J = dy/dx
by autodiff.

To first order: exact for linear functions; otherwise wrong by the curvature of the
function over its standard deviation. Everything works under jit, vmap and grad.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..adjustment.guarded import root
from ..adjustment.least_squares import Adjustment
from ..adjustment.parameters import as_given, as_parameters
from ..orientation.result import Orientation
from ..xla.passes import total
from ..xla.programs import is_traced

ROUNDING = 1e-9
"""Of the sum of all parts of a variance: as much below zero as it may come out by
rounding."""

ASYMMETRY = 1e-3
"""Difference of two covariances that are to be one, as a correlation: more than
rounding leaves."""


def jacobian(function: Callable, values: PyTree, *, has_aux: bool = False) -> Any:
    """d function / d values, forward or reverse, whichever is less work: a reverse pass
    costs some two forward ones."""
    out = jax.eval_shape(function, values)
    size = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))
    forward = size(values) < 2 * size(out[0] if has_aux else out)
    return (jax.jacfwd if forward else jax.jacrev)(function, has_aux=has_aux)(values)


class Propagated(NamedTuple):
    """A value, the standard deviation of each of its numbers (a tree of the same shape)
    and the covariance (m, m) of its numbers laid one behind the other."""

    value: PyTree
    deviations: PyTree
    covariance: Float[Array, "m m"]


def propagate(function: Callable, values: PyTree, covariance: ArrayLike) -> Propagated:
    """Propagation of variance through any differentiable function: C_y = J C Jᵀ, J = d
    function / d values.

    `covariance`: (p, p) of the p numbers of `values` laid one behind the other, or (p,)
    its diagonal. To first order: exact for linear functions. Works under jit, vmap and
    grad. A variance that comes out negative, beyond rounding, which no covariance
    gives, has the deviation NaN. Raises ValueError for another shape and, outside of
    transformations, for a covariance that is not symmetric.
    """
    exact = lambda a: not jnp.issubdtype(jnp.result_type(a), jnp.inexact)
    values = jax.tree.map(lambda a: jnp.asarray(a, float) if exact(a) else a, values)
    flat, unravel = ravel_pytree(values)
    value = function(values)
    y, shaped = ravel_pytree(value)
    j = jacobian(lambda x: ravel_pytree(function(unravel(x)))[0], flat)
    c = jnp.asarray(covariance, flat.dtype)
    if c.shape not in ((flat.size,), (flat.size,) * 2):
        raise ValueError(
            f"propagate: {flat.size} values need a covariance of as many rows, got "
            f"shape {c.shape}"
        )
    if c.ndim == 2 and not is_traced(c):
        _check_symmetric(np.asarray(c))
    of = lambda j, c: (j * c[None, :] if c.ndim == 1 else j @ c) @ j.T
    spread = of(j, c)
    variance, size = jnp.diagonal(spread), jnp.diagonal(of(jnp.abs(j), jnp.abs(c)))
    deviations = root(jnp.where(variance < -ROUNDING * size, jnp.nan, variance))
    return Propagated(value, shaped(deviations.astype(y.dtype)), spread)


def _check_symmetric(c: np.ndarray) -> None:
    size = np.sqrt(np.abs(np.diagonal(c)))
    i, j = np.unravel_index(
        np.argmax(np.abs(c - c.T) > ASYMMETRY * np.outer(size, size)), c.shape
    )
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
    arrays = jnp.broadcast_arrays(
        *(jnp.asarray(a, float) for a in (*numbers, *jax.tree.leaves(deviations)))
    )
    flat = [a.ravel() for a in arrays]

    def one(*entries):
        numbers, s = entries[: structure.num_leaves], entries[structure.num_leaves :]
        push = jax.linearize(
            lambda *x: function(jax.tree.unflatten(structure, x)), *numbers
        )[1]
        moved_by = [
            push(*(e if i == k else jnp.zeros_like(e) for i, e in enumerate(s)))
            for k in range(len(s))
        ]
        return jax.tree.map(
            lambda *d: root(total(jnp.stack(d, axis=-1) ** 2)), *moved_by
        )

    return jax.tree.map(lambda a: a.reshape(arrays[0].shape), jax.vmap(one)(*flat))


def propagate_adjusted(
    function: Callable,
    solved: Adjustment | Orientation,
    sigma0: ArrayLike | None = None,
) -> Propagated:
    """`propagate` through a function of the adjusted parameters, or elements, with
    their covariance sigma0² Q: a posteriori, or with the sigma0 given (1 where the
    given sigmas are true).

    For what depends on the elements alone; model points depend on their coordinates as
    well: see `error_budget`.
    """
    found = as_parameters(
        solved.parameters if isinstance(solved, Adjustment) else solved.elements
    )
    variance = jnp.asarray(solved.sigma0 if sigma0 is None else sigma0) ** 2
    origin = jnp.zeros(solved.cofactor.shape[-1], solved.cofactor.dtype)
    return propagate(
        lambda step: function(as_given(found.move(tuple(step)))),
        origin,
        variance * solved.cofactor,
    )
