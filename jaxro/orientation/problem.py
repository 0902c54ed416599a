"""What is asked of the orientation of a pair: the options of `orient` as one value."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, ScalarLike

from ..adjustment.losses import AbstractLoss
from ..adjustment.terms import Term
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, DependentElements, RelativePose
from ..geometry.pairs import Pair
from .starts import AbstractStart, Auto

TOLERANCE = 1e-12

FOR_CALLERS = 1e-10
"""The tolerance of `orient` as a part of a caller's program, for whom time is worth
more than a last step."""


class Problem(NamedTuple):
    """`elements`: the system of the result. `base`: its given length, if any.
    `residual`: what is minimised, a `Term` of the pair. `loss`: a robust loss in place
    of the sum of squares. `start`: where to begin, a start or known elements. `solver`:
    that of the engine, if None. `max_steps`: 60 if None, 300 with a loss, whose
    reweighted steps converge linearly. `tolerance`: steps (rad) below it end the
    adjustment; with TOLERANCE a pair alone and in a batch, begun here or there, ends at
    the same numbers.
    """

    elements: type[AbstractElements] = RelativePose
    base: Array | None = None
    residual: Callable[[Pair], Term] = coplanarity.rigorous
    loss: AbstractLoss | None = None
    start: AbstractStart | AbstractElements = Auto()
    solver: optx.AbstractLeastSquaresSolver | None = None
    max_steps: int | None = None
    tolerance: ScalarLike = TOLERANCE

    @property
    def most_steps(self) -> int:
        """Steps that are allowed."""
        if self.max_steps is not None:
            return self.max_steps
        return 60 if self.loss is None else 300

    @property
    def length(self) -> Array | None:
        """The base as given, or bx of known dependent elements."""
        known = self.start
        if self.base is not None or not isinstance(known, DependentElements):
            return self.base
        if self.elements is not DependentElements:
            return None
        # a choice of scale, not a measurement: nothing is differentiated by it
        return lax.stop_gradient(jnp.asarray(known.bx, float))

    def starting(self, start: AbstractStart, max_steps: int | None = None) -> "Problem":
        """The same problem from another start, with other steps if given."""
        steps = self.max_steps if max_steps is None else max_steps
        return self._replace(start=start, max_steps=steps)


def problem_of(options: dict[str, Any]) -> Problem:
    """The problem of these options. Raises TypeError for what is none."""
    for name in options:
        if name not in Problem._fields:
            raise TypeError(
                f"there is no option {name!r}: orient takes {', '.join(Problem._fields)}"
            )
    given: dict[str, Any] = options | {"base": as_array(options.get("base"))}
    return Problem(**given)


def as_array(base: ArrayLike | None) -> Array | None:
    """A given base as an array: an argument of a compiled program, not part of it."""
    return None if base is None else jnp.asarray(base, float)
