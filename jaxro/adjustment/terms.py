"""Conditions of several kinds between blocks of parameters and measurements.

A block is a member of a family: one of all cameras, one of all object points. A `Term`
is one kind of condition and what is measured for it; each of its groups touches a few
blocks. Only the derivatives by these are ever computed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from .parameters import AbstractParameters, as_parameters
from .residuals import discrepancy, whitened

Families = Mapping[str, Any]
"""Parameters by the name of their family: `AbstractParameters` or trees of numbers,
members on the first axis."""

Steps = dict[str, Float[Array, "member d"]]
"""A displacement of every member of every family."""


class Term(eqx.Module):
    """One kind of condition: g(blocks, l + v) = 0 for each of its groups.

    `condition(*blocks, observation)` of one group returns a number or m of them.
    `touches`: for each block that it is called with, the family and the member of every
    group, (group,). `observations`, `cofactor`, `mask`: as in `adjust`.
    """

    condition: Callable
    observations: PyTree
    cofactor: PyTree
    touches: tuple[tuple[str, Int[Array, " group"]], ...]
    mask: Bool[Array, " group"]

    def __init__(
        self,
        condition: Callable,
        observations: PyTree,
        cofactor: PyTree,
        touches: Sequence[tuple[str, Int[ArrayLike, "..."]]],
        mask: ArrayLike | None = None,
    ):
        self.condition = condition
        self.observations = jax.tree.map(jnp.asarray, observations)
        groups = jax.tree.leaves(self.observations)[0].shape[0]
        self.touches = tuple(
            (name, jnp.broadcast_to(jnp.asarray(member), (groups,)))
            for name, member in touches
        )
        self.mask = jnp.ones(groups, bool) if mask is None else jnp.asarray(mask)
        every = lambda q: jnp.broadcast_to(
            jnp.asarray(q, float), (groups, *jnp.shape(q)[1:])
        )
        self.cofactor = jax.tree.map(every, cofactor)


class Linearised(eqx.Module):
    """A term at given parameters: the m whitened residuals of each group, and their
    derivatives by the local parameters of each block that it touches; zero where the
    group is not used."""

    residuals: Float[Array, "group m"]
    columns: tuple[Float[Array, "group m _"], ...]


def closed(term: Term, families: Families) -> Term:
    """The term with a condition that carries what it closes over, so that it can be
    differentiated by that, too."""
    shape = lambda a: jax.ShapeDtypeStruct(jnp.shape(a)[1:], jnp.result_type(a))
    blocks = (jax.tree.map(shape, families[name]) for name, _ in term.touches)
    condition = eqx.filter_closure_convert(
        term.condition, *blocks, jax.tree.map(shape, term.observations)
    )
    return eqx.tree_at(lambda t: t.condition, term, condition)


def members(family: Any) -> int:
    """How many blocks a family has."""
    return jax.tree.leaves(family)[0].shape[0]


def dimension(family: Any) -> int:
    """How many local parameters each block of a family has."""
    return as_parameters(jax.tree.map(lambda a: a[0], family)).count


def moved(family: Any, steps: Float[Array, "member d"]) -> Any:
    """All members of a family, displaced."""
    return jax.vmap(_moved)(family, steps)


def standard(family: Any) -> Any:
    """All members of a family in their standard form."""
    return (
        jax.vmap(lambda block: block.normalised())(family)
        if isinstance(family, AbstractParameters)
        else family
    )


def _moved(block: Any, step: Float[Array, " d"]) -> Any:
    if isinstance(block, AbstractParameters):
        return block.moved(tuple(step[k] for k in range(step.shape[0])))
    flat, unravel = ravel_pytree(block)
    return unravel(flat + step)


def residuals(term: Term, families: Families, steps: Steps) -> Float[Array, "group m"]:
    """The whitened residuals of a term for displaced families."""
    return jax.vmap(_of_group(term))(*_parts(term, families, steps))


def linearised(term: Term, families: Families, steps: Steps) -> Linearised:
    """`Linearised` for displaced families."""
    one = _of_group(term)

    def group(observation, cofactor, use, blocks, local):
        of = lambda local: one(observation, cofactor, use, blocks, local)
        return of(local), jax.jacfwd(of)(local)

    return Linearised(*jax.vmap(group)(*_parts(term, families, steps)))


def _parts(term: Term, families: Families, steps: Steps) -> tuple:
    """What each group consists of: observation, cofactor, use, and its blocks with
    their displacements."""
    take = lambda tree, member: jax.tree.map(lambda a: a[member], tree)
    blocks = tuple(take(families[name], member) for name, member in term.touches)
    local = tuple(steps[name][member] for name, member in term.touches)
    return term.observations, term.cofactor, term.mask, blocks, local


def _of_group(term: Term) -> Callable:
    """The whitened residuals of one group, as a function of its parts."""
    condition = lambda blocks, observation: term.condition(*blocks, observation)

    def one(observation, cofactor, use, blocks, local):
        displaced = tuple(
            _moved(block, step) for block, step in zip(blocks, local, strict=True)
        )
        g, d = discrepancy(condition, displaced, observation, cofactor, use)
        return jnp.stack(whitened(g, d, use))

    return one
