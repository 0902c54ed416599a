"""What an adjustment seeks: parameters that small steps displace."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .normal_equations import slopes

Step = tuple[Float[Array, "..."], ...]
"""As many numbers as there are local parameters."""


class AbstractParameters(eqx.Module):
    """Unknowns with a way of their own to move: a rotation, say, which is no sum.

    A step has `count` numbers, the local parameters at the present place. A condition
    sees the parameters themselves; where the adjustment is given `prepare`, that sees
    their `arguments`.
    """

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """The number of local parameters."""

    @abc.abstractmethod
    def moved(self, step: Step) -> "AbstractParameters":
        """The parameters after a small step."""

    def normalised(self) -> "AbstractParameters":
        """The same parameters in their standard form."""
        return self

    def arguments(self) -> tuple:
        """What `prepare` is called with."""
        return (self,)

    def slopes(self, function: Callable, x: Step) -> tuple[Any, list[Any]]:
        """function(*arguments) of the parameters moved by x, and its derivatives along
        `count` directions there."""
        return slopes(lambda *x: function(*self.moved(x).arguments()), x)

    def further(self, x: Step, step: Step) -> Step:
        """The displacement x followed by a step along the directions of `slopes`."""
        return tuple(a + b for a, b in zip(x, step, strict=True))


class Numbers(AbstractParameters):
    """Any tree of numbers and arrays, which steps are added to."""

    values: PyTree

    @property
    def count(self) -> int:
        return sum(jnp.size(leaf) for leaf in jax.tree.leaves(self.values))

    def moved(self, step: Step) -> "Numbers":
        leaves, structure = jax.tree.flatten(self.values)
        rest, out = list(step), []
        for leaf in leaves:
            size = jnp.size(leaf)
            out.append(
                leaf
                + (
                    rest[0]
                    if jnp.ndim(leaf) == 0
                    else jnp.stack(rest[:size]).reshape(jnp.shape(leaf))
                )
            )
            rest = rest[size:]
        return Numbers(jax.tree.unflatten(structure, out))

    def arguments(self) -> tuple:
        return (self.values,)


def as_parameters(start: Any) -> AbstractParameters:
    """The start of an adjustment, which may be any tree of numbers, as parameters."""
    return start if isinstance(start, AbstractParameters) else Numbers(start)


def as_given(parameters: AbstractParameters) -> Any:
    """The parameters in the form they were given: a tree of numbers as that tree."""
    return parameters.values if isinstance(parameters, Numbers) else parameters
