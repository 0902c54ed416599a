"""Stages of `recommended`: a stage decides on a pair or leaves it open for the next
one. Another stage is another `AbstractStage`; here stands what stages share."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, ScalarLike

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..orientation import planes
from ..xla.passes import count
from . import evidence
from .agreement import keep_agreeing, one_by_one, points_within, squares
from .judgement import OF_DECISION, AbstractStep, Decision, Judgement
from .level import Level
from .masked import Use, choose
from .visibility import seen

ROUNDS = 10
"""Turns of least squares and judgement of every point."""

CHANGES = 2
"""Points of the set found by a search that may change sides, one by one."""

FEW = 7
"""Points out up to which points are also judged one by one, from all of them."""

NEARLY_ALL = 0.75
"""Share of the points from which on the others are exceptions, whatever size their
errors have."""

FLAT = 0.6
"""Share of the points kept from which on their plane alone may have chosen between its
two poses."""


class AbstractStage(eqx.Module):
    """A way to decide on a pair, for the pairs that the stage before left open."""

    @abc.abstractmethod
    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        """Decide on one pair by |w| <= limit."""

    def as_steps(self, level: Level) -> tuple[AbstractStep, ...]:
        """The steps that it is made of."""
        return (Decides(self, level),)


class Decides(AbstractStep):
    """A stage as one step."""

    stage: AbstractStage
    level: Level
    reads: ClassVar[tuple[str, ...]] = ()
    changes: ClassVar[tuple[str, ...]] = OF_DECISION

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return ~known.decision.believed

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the decision of the stage."""
        decision = self.stage(self.level.first(pair), self.level.limit(pair))
        return self.level.decide(pair, known, decision)


def settle(
    pair: Pair, pose: RelativePose, limit: Float[Array, ""]
) -> tuple[RelativePose, Use]:
    """The pose and the points that agree with it, from a pose near the right one.

    A few small errors do not stand out in a search. Where few points are out, the
    points are also judged one by one, beginning with all of them, and the set of lower
    cost is taken.
    """
    near = points_within(pair, pose, limit)
    found, use = keep_agreeing(pair, pose, near, limit, ROUNDS)
    out = pair.mask & ~use
    few = count(out) <= FEW
    start = lambda pose, use, rounds: (pose, use, jnp.asarray(rounds))
    starts = start(found, use, CHANGES), start(pose, pair.mask, ROUNDS)
    # one after the other, so that the loop is compiled once
    every = jax.tree.map(lambda *both: jnp.stack(both), *starts)
    judge = lambda start: one_by_one(pair, *start, limit, few)
    judged, costs, rest = lax.map(judge, every)
    first, other = (jax.tree.map(lambda a, k=k: a[k], judged) for k in range(2))
    better = rest[1] & (costs[1] < costs[0])
    pose, use = choose(better, other, first)
    return pose, use & seen(pair, pose, limit, use)


def believe_if_it_fits(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: Float[Array, ""],
    share: ScalarLike,
    accidents: ScalarLike,
) -> Bool[Array, ""]:
    """Whether to believe the pose of a quick search, which may have missed a better
    one: at least this `share` of the points agree, they pass the global test, and sets
    as good are not expected by accident more than `accidents` times.

    Points that agree with a wrong pose, as those of one depth do, lie about it as far
    as the limit reaches, and fail the global test. If they pass it by far, sigma is too
    large for it to tell that. Others agree by chance with a probability of about limit
    / mean |r|. That is large where errors are small, so that nearly all points need no
    such proof.
    """
    n = count(pair.mask)
    k = count(use)
    out = pair.mask & ~use
    s = squares(pair, pose)
    fits = evidence.fits_well(s, use)
    too_well = evidence.fits_too_well(s, use)
    chance = evidence.chance_by_distance(s, out, limit)
    expected = evidence.log_accidents(chance, n, k)
    certain = expected <= jnp.log(accidents)
    nearly_all = k >= NEARLY_ALL * n
    enough = (k >= share * n) & (k > 5)
    return fits & ~too_well & enough & (certain | nearly_all)


def on_a_plane(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> tuple[RelativePose, planes.Plane, Bool[Array, ""]]:
    """The pose turned so that the points are in front, the plane of the points in use,
    and whether the plane alone may have chosen between its two poses: most of these
    points lie in it, and the points that are out may be good ones beside it."""
    facing = planes.facing(pair.with_mask(use), pose)
    plane = planes.plane(pair, facing, use, limit)
    out = pair.mask & ~use
    flat = plane.share >= FLAT
    return facing, plane, flat & (count(out) > 0)
