"""One kind of condition, and what is measured for it.

    g(parameters, l + v) = 0  for every group of observations l

Each group is linearised by autodiff, B = dg/dl, and whitened by the Cholesky factor of
its cofactor B Q Bᵀ.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from . import normal_equations as normal


class Term(eqx.Module):
    """One kind of condition: g(parameters, l + v) = 0 for each of its groups.

    `condition(*parameters, observation)` of one group returns a number or m of them.
    `observations`: a tree whose leaves have the groups on the first axis. `cofactor`:
    its variances (relative to sigma0²), a tree that may end above the leaves and then
    holds for all of them: numbers or one per group, None for what is free of error.
    `mask` selects groups (all, if None).

    `touches` names the blocks of parameters that the condition is called with: for
    each of them the family and the member of every group, (group,). Without it the
    condition is called with all parameters. `prepare`: what all groups share, computed
    once from the `arguments` of the parameters; the condition is then called with its
    result. `bilinear`: `prepare` is linear in each of its two arguments.
    """

    condition: Callable
    observations: PyTree
    cofactor: PyTree
    touches: tuple[tuple[str, Int[Array, " group"]], ...]
    mask: Bool[Array, " group"]
    prepare: Callable | None
    bilinear: bool = eqx.field(static=True)

    def __init__(
        self,
        condition: Callable,
        observations: PyTree,
        cofactor: PyTree,
        *,
        touches: Sequence[tuple[str, Int[ArrayLike, "..."]]] = (),
        mask: ArrayLike | None = None,
        prepare: Callable | None = None,
        bilinear: bool = False,
    ):
        if touches and prepare is not None:
            raise ValueError("Term: what blocks share cannot be prepared")
        self.condition = condition
        self.prepare = prepare
        self.bilinear = bilinear
        self.observations = jax.tree.map(_as_array, observations)
        groups = jax.tree.leaves(self.observations)[0].shape[0]
        self.touches = tuple(
            (name, _for_each(member, groups)) for name, member in touches
        )
        use = np.ones(groups, bool) if mask is None else mask
        self.mask = _as_array(use)
        each = lambda q: _for_each(q, groups, float)
        self.cofactor = jax.tree.map(each, cofactor)


def _as_array(a: ArrayLike) -> Array:
    """An array of JAX; of one of NumPy without a program for its shape."""
    return a if isinstance(a, jax.Array) else jax.device_put(np.asarray(a))


def _for_each(a: ArrayLike, groups: int, kind: type | None = None) -> Array:
    """Something for every group, from one for all or one for each; of `kind`, unless
    its numbers are real."""
    xp = jnp if isinstance(a, jax.Array) else np
    a = xp.asarray(a)
    if kind is not None and not xp.issubdtype(a.dtype, xp.floating):
        a = a.astype(kind)
    return _as_array(xp.broadcast_to(a, (groups, *a.shape[1:])))


def close(term: Term, *parameters: PyTree) -> Term:
    """The term with functions that carry what they close over as arrays of their own,
    so that an adjustment can be differentiated by these, too.

    `parameters`: what `prepare`, or else the condition, is called with (shapes are
    enough).
    """
    prepare = term.prepare
    if prepare is not None:
        prepare = eqx.filter_closure_convert(prepare, *parameters)
        parameters = (jax.eval_shape(prepare, *parameters),)
    first = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), term.observations
    )
    condition = eqx.filter_closure_convert(term.condition, *parameters, first)
    functions = lambda t: (t.condition, t.prepare)
    none = lambda leaf: leaf is None
    return eqx.tree_at(functions, term, (condition, prepare), is_leaf=none)


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
        if isinstance(g, tuple | list):
            raise ValueError(
                f"Term: the condition returned a {type(g).__name__}; several conditions "
                "of one observation are an array, jnp.stack([...])"
            )
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


def whiten(g: list, d: list, use) -> list:
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
