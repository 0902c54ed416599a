"""What an adjustment seeks: parameters that small steps displace."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
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
    def move(self, step: Step | Float[Array, " count"]) -> "AbstractParameters":
        """The parameters after a small step."""

    def normalise(self) -> "AbstractParameters":
        """The same parameters in their standard form."""
        return self

    def arguments(self) -> tuple:
        """What `prepare` is called with."""
        return (self,)

    @property
    def origin(self) -> Step:
        """The step that moves nothing."""
        dtype = jax.tree.leaves(self)[0].dtype
        return (jnp.zeros((), dtype),) * self.count

    def at(self, x: Step) -> "AbstractParameters":
        """The parameters at the displacement x, as they are if x is empty."""
        return self.move(x) if x else self

    def slopes(
        self, function: Callable, x: Step = (), *, bilinear: bool = False
    ) -> tuple[Any, list[Any]]:
        """function(*arguments) of the parameters moved by x (not moved if x is empty),
        and its derivatives along `count` directions there. `bilinear`: the function is
        linear in each of two arguments, so that it is its own derivative."""
        del bilinear
        return slopes(lambda *x: function(*self.move(x).arguments()), x or self.origin)

    def further(self, x: Step, step: Step) -> Step:
        """The displacement x followed by a step along the directions of `slopes`."""
        return tuple(a + b for a, b in zip(x, step, strict=True))


class Numbers(AbstractParameters):
    """Any tree of numbers and arrays, which steps are added to."""

    values: PyTree

    @property
    def count(self) -> int:
        return sum(jnp.size(leaf) for leaf in jax.tree.leaves(self.values))

    def move(self, step: Step | Float[Array, " count"]) -> "Numbers":
        flat, unravel = ravel_pytree(self.values)
        return Numbers(unravel(flat + jnp.asarray(step)))

    def arguments(self) -> tuple:
        return (self.values,)


def as_parameters(start: Any) -> AbstractParameters:
    """The start of an adjustment, which may be any tree of numbers, as parameters."""
    if isinstance(start, AbstractParameters):
        return start
    return Numbers(jax.tree.map(lambda number: jnp.asarray(number, float), start))


def as_given(parameters: AbstractParameters) -> Any:
    """The parameters in the form they were given: a tree of numbers as that tree."""
    return parameters.values if isinstance(parameters, Numbers) else parameters
