"""What the stages of `recommended` share: a decision, the points that agree with a
pose, and whether they fit."""

import abc
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..geometry.elements import RelativePose, vertical
from ..geometry.pairs import Pair
from ..orientation import planes
from ..xla.passes import count, total
from . import evidence
from .hypotheses import squares
from .robust import agreeing, improved, one_by_one, seen

Use = Bool[Array, "point"]

ROUNDS = 10
"""Turns of least squares and judgement of every point."""

FEW = 7
"""Points out up to which they are also judged one by one, beginning with all of
them."""

NEARLY_ALL = 0.75
"""Share of the points from which on those that are out are the exceptions, of whatever
size their errors are."""

FLAT = 0.6
"""Share of the points kept from which on their plane alone may have chosen between its
two poses."""

DEVIATIONS = 3.0
"""The level of the global test, as multiple of a standard deviation of a normal
number."""


class Decision(NamedTuple):
    """The pose, the points that agree with it, whether that is believed, and by how
    many times the standard deviations that the pair states it was decided."""

    pose: RelativePose
    use: Use
    believed: Bool[Array, ""]
    scale: Float[Array, ""]


class AbstractStage(eqx.Module):
    """A way to decide on a pair, for the pairs that the stage before left open."""

    @abc.abstractmethod
    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        """Decide on one pair by |w| <= limit."""


def settled(
    pair: Pair, pose: RelativePose, limit: Float[Array, ""]
) -> tuple[RelativePose, Use]:
    """The pose and the points that agree with it, from a pose near the right one."""
    use = pair.mask & (squares(pair, pose) <= limit**2)
    found = agreeing(pair, pose, use, limit, ROUNDS)
    # a few small errors do not stand out in a search: the points one by one, beginning
    # with all of them
    few = count(pair.mask & ~found[1]) <= FEW
    best, lowest, _ = one_by_one(pair, *found, limit, 2, few)
    other, cost, rests = one_by_one(pair, pose, pair.mask, limit, ROUNDS, few)
    first = rests & (cost < lowest)
    pose, use = jax.tree.map(lambda a, b: jnp.where(first, a, b), other, best)
    return pose, use & seen(pair, pose, limit)


def believed_if_it_fits(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: Float[Array, ""],
    share: float,
    accidents: float,
) -> Decision:
    """The decision for a pose of a quick search, which may have missed a better one.

    Points that agree with a wrong pose, as those of one depth do, lie about it as far
    as the limit reaches, and fail the global test. If they pass it by far, sigma is too
    large for it to tell that. Others agree by chance with a probability of about limit
    / mean |r|. That is large where errors are small, so that nearly all points need no
    such proof.
    """
    n, k = count(pair.mask), count(use)
    s = squares(pair, pose)
    misfit = total(jnp.where(use, s, 0.0))
    low, high = (
        evidence.chi_squared_limit(d, k - 5) for d in (-DEVIATIONS, DEVIATIONS)
    )
    fits = (misfit >= low) & (misfit <= high) & (k >= share * n) & (k > 5)
    nearly_all = k >= NEARLY_ALL * n
    out = pair.mask & ~use
    certain = evidence.accidents(evidence.scattered(s, out, limit), n, k) <= math.log(
        accidents
    )
    return Decision(pose, use, fits & (certain | nearly_all), jnp.ones_like(limit))


def on_a_plane(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> tuple[RelativePose, planes.Plane, Bool[Array, ""]]:
    """The pose turned so that the points are in front, the plane of the points in use,
    and whether it alone may have chosen between its two poses: most of these lie in it,
    and the points that are out may be good ones beside it."""
    facing = planes.facing(pair.with_mask(use), pose)
    plane = planes.plane(pair, facing, use, limit)
    return facing, plane, (plane.share >= FLAT) & (count(pair.mask & ~use) > 0)


def rescaled(pair: Pair, scale: Float[Array, ""]) -> Pair:
    """The pair with so many times the standard deviations."""
    sigma = jnp.where(pair.mask, pair.sigma * scale, 1.0)
    return Pair(*pair.coordinates, sigma, pair.mask, pair.focal_left, pair.focal_right)


def from_vertical(pair: Pair, steps: int) -> RelativePose:
    """All points by least squares."""
    start = vertical(jnp.zeros_like(pair.focal_left))
    return lax.fori_loop(
        0, steps, lambda _, pose: improved(pair, pose, pair.mask), start
    )
