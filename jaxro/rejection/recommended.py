"""The procedure to begin with: hypotheses that are compared, and verdicts that are held against chance.

1. `Plain`: all points, from the vertical. If they pass the global test and no |w| exceeds its limit, nothing is
   searched and nothing rejected.
2. `Quick`: graduated weights from the vertical, held against a few random subsets of five points in any position.
   Believed only if the points kept pass the global test with the given standard deviation and are no accident.
3. `NearVertical`: of few points many subsets, solved from the vertical; believed in the same way.
4. `Thorough`: the best of these held against random subsets in any position until a better orientation would have been
   met.

Every orientation is compared by the same truncated cost. What is found is solved by least squares, and every point, in
use or not, judged anew by its normalised residual |w| at the familywise level, in turns: a good point that a search
lost comes back. Where few points are out, the same is done point by point from all points, by which few and small
errors are found best.
"""

import abc
import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .. import critical_values
from ..conditions import linearised
from ..elements import RelativePose, vertical
from ..pairs import Pair, cleaned
from ..programs import while_loop
from ..reductions import count, total
from . import evidence
from .base import OUTCOMES, AbstractProcedure, Rejection
from .fading import faded
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import Newton, squares
from .ransac import Ransac
from .robust import agreeing, improved, judged, normalised, one_by_one, scaled, seen
from .search import Search, score
from .undecided import undecided

Use = Bool[Array, "point"]

ROUNDS = 10
"""Turns of least squares and judgement of every point."""

FEW = 7
"""Points out up to which they are also judged one by one, beginning with all of them."""

DEVIATIONS = 3.0
"""The level of the global test, as multiple of a standard deviation of a normal number."""

OVERWHELMING = math.log(1e-9)
"""Logarithm of an expected number of accidents at which a search that came to its end is believed in any case."""


class Decision(NamedTuple):
    """The pose, the points that agree with it, and whether that is believed."""

    pose: RelativePose
    use: Use
    believed: Bool[Array, ""]


class AbstractStage(eqx.Module):
    """A way to decide on a pair, for the pairs that the stage before left open."""

    @abc.abstractmethod
    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        """Decide on one pair by |w| <= limit."""


class Plain(AbstractStage):
    """All points, in `steps` of least squares from the vertical. Believed if they pass the global test, and every |w|
    its limit."""

    steps: int = 8

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        pose = _from_vertical(pair, self.steps)
        return Decision(pose, pair.mask, _untouched(pair, pose, limit))


class Quick(AbstractStage):
    """The graduated search, held against a few subsets. Believed if at least `share` of the points are kept, these pass
    the global test, and sets as good are not expected by accident more than `accidents` times."""

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    search: Search = Search(count=4, block=4, finalists=2)
    share: float = 0.4
    accidents: float = 1e-4

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        found = self.search.run(pair, self.search.begin(pair, self.graduated.search(pair)))
        return _believed_if_it_fits(pair, *settled(pair, found.pose, limit), limit, self.share, self.accidents)


class NearVertical(AbstractStage):
    """Subsets solved by Newton's method from the vertical, for pairs of at most `most` points: of few points this finds
    what a search in any position takes long for. Believed as `Quick` is."""

    search: Ransac = Ransac(hypotheses=Newton(block=64), count=1024, limit=5.0)
    most: int = 32
    share: float = 0.4
    accidents: float = 0.02

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        small = count(pair.mask) <= self.most
        pair = cleaned(pair.with_mask(pair.mask & small))[0]
        pose, use = settled(pair, self.search.search(pair), limit)
        decision = _believed_if_it_fits(pair, pose, use, limit, self.share, self.accidents)
        return decision._replace(believed=decision.believed & small)


class Thorough(AbstractStage):
    """Random subsets until a better orientation would have been met, and the evidence for what is found.

    Believed if the subsets were enough for the share of points kept, and sets as good are not expected by accident more
    than `accidents` times, by the chance of agreement that partners shifted among the points and the orientations that
    lost have on this scene. Points that repeat others count once. At `least` so many subsets are tried, so that the
    pose is as good as it can be where no set would be believed.
    """

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    search: Search = Search()
    accidents: float = 1e-3
    least: int = 2048

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        again, key = evidence.repeats(pair)
        once = cleaned(pair.with_mask(pair.mask & ~again))[0]
        best, other = self.graduated.search(once), _from_vertical(once, 8)
        better = score(once, other, self.search.limit) < score(once, best, self.search.limit)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), other, best)
        agreed, asked = evidence.shifted_agreement(once, best, limit)
        bound, of = math.log(self.accidents), count(once.mask)
        fewest = evidence.fewest((agreed + 1) / (asked + 2), of, bound, once.mask.shape[0])
        worth = jnp.maximum(self.search.enough_for(fewest, of), float(self.least))
        found = self.search.run(once, self.search.begin(once, best), worth)
        pose, use = settled(once, found.pose, limit)
        agreed, asked = evidence.shifted_agreement(once, pose, limit)
        chance = jnp.maximum((agreed + 1) / (asked + 2), found.agreed / jnp.maximum(found.asked, 1.0))
        expected = evidence.accidents(chance, of, count(use))
        thorough = (found.counted >= self.search.enough_for(count(use), of)) | (expected <= OVERWHELMING)
        certain = expected <= bound
        return Decision(pose, evidence.with_repeats(use, again, key), certain & thorough)


class Recommended(AbstractProcedure):
    """The stages in turn, each where the one before was not believed; `no_consensus` where the last is not.

    Where another point could be the wrong one as well, the outcome is `undecided`: all these points are named and none
    of them rejected; the orientation is that without the one that is most likely wrong.

    `sigma`: the standard deviation of a coordinate; if None that of the pair. `level`: the probability that a pair
    without errors loses a point.
    """

    sigma: float | None = None
    level: float = 0.0025
    stages: tuple[AbstractStage, ...] = (Plain(), Quick(), NearVertical(), Thorough())

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        limit = critical_values.by_count(
            lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0)), pair.x_left.shape[0], count(pair.mask)
        )
        zero = jnp.zeros_like(limit)
        decision = Decision(vertical(zero), fixed.mask & False, zero > 0)
        for stage in self.stages:
            decision = _where_open(stage, fixed, limit, decision)
        pose, use, believed = decision
        w = normalised(linearised(fixed, pose), use)
        rejection = judged(faded(pair, pose, use), pose, use, limit, w).only_if(believed, OUTCOMES.no_consensus)
        return rejection.taking_back(_in_doubt(fixed, pose, use))

    def separate(self, points: int) -> list["Recommended"]:
        """The stages for pairs of up to so many points as procedures of their own, for batches: each for the pairs that
        the one before left open."""
        return [dataclasses.replace(self, stages=(stage,)) for stage in self.stages]


def settled(pair: Pair, pose: RelativePose, limit: Float[Array, ""]) -> tuple[RelativePose, Use]:
    """The pose and the points that agree with it, from a pose near the right one."""
    use = pair.mask & (squares(pair, pose) <= limit**2)
    found = agreeing(pair, pose, use, limit, ROUNDS)
    best, lowest, _ = one_by_one(pair, *found, limit, 2)
    # a few small errors do not stand out in a search: the points one by one, beginning with all of them
    few = count(pair.mask & ~best[1]) <= FEW
    other, cost, rests = one_by_one(pair, pose, pair.mask, limit, ROUNDS, few)
    first = rests & (cost < lowest)
    pose, use = jax.tree.map(lambda a, b: jnp.where(first, a, b), other, best)
    return pose, use & seen(pair, pose, limit)


def _in_doubt(pair: Pair, pose: RelativePose, use: Use) -> Use:
    """The points of which some are wrong, though nothing tells which; of pairs with few points out."""
    out = pair.mask & ~use & seen(pair, pose, 0.0)
    few = count(pair.mask & ~use) <= FEW
    return undecided(pair, pose, use, out & few)


def _from_vertical(pair: Pair, steps: int) -> RelativePose:
    """All points by least squares."""
    start = vertical(jnp.zeros_like(pair.focal_left))
    return lax.fori_loop(0, steps, lambda _, pose: improved(pair, pose, pair.mask), start)


def _untouched(pair: Pair, pose: RelativePose, limit: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether all points agree: the global test, every |w|, and every point in front of both photos."""
    linear = linearised(pair, pose)
    within = normalised(linear, pair.mask) <= limit
    agree = count(pair.mask & within & seen(pair, pose, limit)) == count(pair.mask)
    misfit = total(jnp.where(pair.mask, linear.squares, 0.0))
    return agree & (misfit <= evidence.chi_squared_limit(DEVIATIONS, count(pair.mask) - 5))


def _believed_if_it_fits(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""], share: float, accidents: float
) -> Decision:
    """The decision for a pose of a quick search, which may have missed a better one.

    Points that agree with a wrong pose, as those of one depth do, lie about it as far as the limit reaches, and fail
    the global test. Others agree by chance with a probability of about limit / mean |r|.
    """
    n, k = count(pair.mask), count(use)
    s = squares(pair, pose)
    misfit = total(jnp.where(use, s, 0.0))
    fits = (misfit <= evidence.chi_squared_limit(DEVIATIONS, k - 5)) & (k >= share * n) & (k > 5)
    out = pair.mask & ~use
    mean = total(jnp.where(out, jnp.sqrt(s), 0.0)) / jnp.maximum(count(out), 1.0)
    chance = limit / jnp.maximum(mean, 2 * limit)
    certain = evidence.accidents(chance, n, k) <= math.log(accidents)
    untouched = (count(out) == 0) & _untouched(pair, pose, limit)
    return Decision(pose, use, (fits & certain) | untouched)


def _where_open(stage: AbstractStage, pair: Pair, limit: Float[Array, ""], before: Decision) -> Decision:
    """The decision of a stage where there is none yet: a loop of at most one round, which under vmap is entered only
    if some pair of the batch needs it. What it works on depends on the round, or XLA would compute it anyway."""

    def decide(state):
        open_, decision = state
        masked = cleaned(pair.with_mask(pair.mask & open_))[0]
        new = stage(masked, limit)
        return open_ & False, jax.tree.map(lambda a, b: jnp.where(open_, a, b), new, decision)

    return while_loop(lambda state: state[0], decide, (~before.believed, before), pair.focal_left)[1]
