"""The verdict of procedures that find the pose first, and the wrong points by it."""

import abc

import jax.numpy as jnp
from jaxtyping import ArrayLike

from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair
from ..orientation.orient import Orientation, orient
from ..xla.passes import count
from .agreement import normalised_residuals
from .base import AbstractProcedure, Rejection
from .masked import Use, Values
from .rounds import Round, conclude_round, finished_if, independent_values
from .visibility import seen


class AbstractSearch(AbstractProcedure):
    """A procedure that finds the pose first, and the wrong points by it."""

    @abc.abstractmethod
    def search(self, pair: Pair) -> RelativePose:
        """A pose near the right one, in spite of the wrong points."""


def verdict(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: ArrayLike,
    w: Values | None = None,
) -> Rejection:
    """The result that only the points in `use` are right, with their orientation.

    The evidence is |w| against the limit: the `w` by which the points were chosen, or
    else the one of this orientation. Of five points and fewer none can be tested.
    """
    used = testable(pair, use)
    solved = orient(pair.with_mask(used), start=pose)
    if w is None:
        w = normalised_residuals(linearise(pair, solved.pose), used)
    return verdict_on(pair, solved, used, limit, w)


def testable(pair: Pair, use: Use) -> Use:
    """The points in use; of five points and fewer all."""
    return jnp.where(count(pair.mask) > 5, use, pair.mask)


def verdict_on(
    pair: Pair, solved: Orientation, use: Use, limit: ArrayLike, w: Values
) -> Rejection:
    """The result that only the points in `use`, which have this orientation, are right,
    as |w| says; it is infinite for a point that was rejected as it cannot be seen."""
    enough = count(pair.mask) > 5
    limit = jnp.asarray(limit, w.dtype)
    visible = seen(pair, solved.pose, limit, use)
    unseen = ~use & (w <= limit) & ~visible
    w = jnp.where(unseen, jnp.inf, w)
    only = Round(
        statistic=jnp.where(pair.mask & enough, w, 0.0),
        limit=limit,
        rejected=pair.mask & ~use,
        parallax=solved.parallax,
        elements=independent_values(solved.pose),
    )
    return conclude_round(pair, only, solved, finished_if(enough))
