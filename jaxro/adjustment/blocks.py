"""Terms between blocks of parameters: their residuals and derivatives.

A block is a member of a family: one of all cameras, one of all object points. Each
group of a `Term` touches a few blocks. Only the derivatives by these are ever computed.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .parameters import as_given, as_parameters
from .propagation import jacobian
from .terms import Term, close, discrepancy, whiten

Families = Mapping[str, Any]
"""Parameters by the name of their family: `AbstractParameters` or trees of numbers,
members on the first axis."""

Steps = dict[str, Float[Array, "_ _"]]
"""A displacement of every member of every family, (member, d)."""


class Linearised(eqx.Module):
    """A term at given parameters: the m whitened residuals of each group, and their
    derivatives by the local parameters of each block that it touches; zero where the
    group is not used."""

    residuals: Float[Array, "group m"]
    columns: tuple[Float[Array, "group m _"], ...]


def close_blocks(term: Term, families: Families) -> Term:
    """The term with a condition that carries what it closes over."""
    shape = lambda a: jax.ShapeDtypeStruct(jnp.shape(a)[1:], jnp.result_type(a))
    blocks = (jax.tree.map(shape, families[name]) for name, _ in term.touches)
    return close(term, *blocks)


def members(family: Any) -> int:
    """How many blocks a family has."""
    return jax.tree.leaves(family)[0].shape[0]


def dimension(family: Any) -> int:
    """How many local parameters each block of a family has."""
    return as_parameters(jax.tree.map(lambda a: a[0], family)).count


def move(family: Any, steps: Float[Array, "member d"]) -> Any:
    """All members of a family, displaced."""
    return jax.vmap(_move)(family, steps)


def normalise(family: Any) -> Any:
    """All members of a family in their standard form."""
    return jax.vmap(lambda block: as_given(as_parameters(block).normalise()))(family)


def _move(block: Any, step: Float[Array, " d"]) -> Any:
    return as_given(as_parameters(block).move(step))


def residuals(term: Term, families: Families, steps: Steps) -> Float[Array, "group m"]:
    """The whitened residuals of a term for displaced families."""
    return jax.vmap(_of_group(term))(*_parts(term, families, steps))


def linearise(term: Term, families: Families, steps: Steps) -> Linearised:
    """`Linearised` for displaced families."""
    one = _of_group(term)

    def group(observation, cofactor, use, blocks, local):
        of = lambda local: one(observation, cofactor, use, blocks, local)
        return of(local), jacobian(of, local)

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
            _move(block, step) for block, step in zip(blocks, local, strict=True)
        )
        g, d = discrepancy(condition, displaced, observation, cofactor, use)
        return jnp.stack(whiten(g, d, use))

    return one
