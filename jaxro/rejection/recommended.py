"""The procedure to begin with: hypotheses that are compared, and verdicts that are held against chance.

1. `Plain`: all points, from the vertical. If they pass the global test and no |w| exceeds its limit, nothing is
   searched and nothing rejected.
2. `Quick`: graduated weights from the vertical. Believed only if the points kept pass the global test with the given
   standard deviation and are no accident.
3. `Thorough`: the best of what begins at the vertical, held against random subsets in any position until a better
   orientation would have been met.

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
from ..programs import where_needed, while_loop
from ..reductions import count, total
from . import evidence
from .base import OUTCOMES, AbstractProcedure, Rejection
from .fading import faded
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import Newton, squares
from .noise import noise_of
from .ransac import Ransac
from .robust import agreeing, improved, judged, normalised, one_by_one, reweighted, scaled, seen
from .search import Found, Search, score
from .undecided import undecided

Use = Bool[Array, "point"]

ROUNDS = 10
"""Turns of least squares and judgement of every point."""

FEW = 7
"""Points out up to which they are also judged one by one, beginning with all of them."""

TURNS = 2
"""Searches, the second one with the noise that the first one found."""

DEVIATIONS = 3.0
"""The level of the global test, as multiple of a standard deviation of a normal number."""

OVERWHELMING = math.log(1e-9)
"""Logarithm of an expected number of accidents at which a search that came to its end is believed in any case."""


APART = 0.6
"""Ratio of the noise found to that taken, or of that taken to that found, below which a search begins again."""

NARROWER, NARROWINGS = 0.7, 12
"""By how much the limit narrows in two steps, and how many steps: down to an eighth."""

MAJORITY = 0.4
"""Part of the points that agreed before that the noise has to be that of: a few points may agree by accident."""

MOST = 20.0
"""How many times larger or smaller than that taken at first the noise may be."""

UNKNOWN = 3000.0
"""Where nothing is said of the noise, a search begins with this part of the focal length."""


class Decision(NamedTuple):
    """The pose, the points that agree with it, whether that is believed, and by how many times the standard deviations
    that the pair states it was decided."""

    pose: RelativePose
    use: Use
    believed: Bool[Array, ""]
    scale: Float[Array, ""]


class AbstractStage(eqx.Module):
    """A way to decide on a pair, for the pairs that the stage before left open."""

    @abc.abstractmethod
    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        """Decide on one pair by |w| <= limit."""


class Plain(AbstractStage):
    """All points, in `steps` of least squares from the vertical. Believed if they pass the global test, and every |w|
    its limit."""

    steps: int = 5

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        pose = _from_vertical(pair, self.steps)
        return Decision(pose, pair.mask, _untouched(pair, pose, limit), jnp.ones_like(limit))


class Quick(AbstractStage):
    """The graduated search. Believed if at least `share` of the points are kept, these pass the global test, and sets
    as good are not expected by accident more than `accidents` times."""

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    share: float = 0.4
    accidents: float = 1e-4

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        decision = settled(pair, self.graduated.search(pair), limit)
        return _believed_if_it_fits(pair, *decision, limit, self.share, self.accidents)


class Thorough(AbstractStage):
    """Random subsets in any position until a better orientation would have been met, and the evidence for what is
    found.

    It begins with the best of all points from the vertical, the graduated search, and for at most `few` points many
    subsets solved from the vertical: of few points that finds what a search in any position takes long for. If that
    fits as `Quick` asks, with `accidents_at_once`, it is believed at once. Otherwise it is believed if the subsets were
    enough to have met a set of `better` times as many points, and sets as good are not expected by accident more than
    `accidents` times, by the chance of agreement that partners shifted among the points and the orientations that lost
    have on this scene. Points that repeat others count once. The search ends when no set that it could still find would
    be believed, after at least `least` subsets, so that the pose is as good as it can be where nothing is believed.

    Where the residuals leave no doubt that sigma is much too large, the search begins again with the noise that they
    show, by which the points are then judged, too; where sigma is not `known` they always are.
    """

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    near: Ransac = Ransac(hypotheses=Newton(block=64), count=1024, limit=5.0)
    few: int = 32
    search: Search = Search()
    share: float = 0.4
    accidents_at_once: float = 0.02
    accidents: float = 1e-3
    better: float = 1.5
    least: int = 256
    known: bool = True

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        again, key = evidence.repeats(pair)
        once = cleaned(pair.with_mask(pair.mask & ~again))[0]
        first = self._near_vertical(once)
        at_once = _believed_if_it_fits(once, *settled(once, first, limit), limit, self.share, self.accidents_at_once)
        at_once = at_once._replace(believed=at_once.believed & self.known)

        found, scale = self._searched(once, first, ~at_once.believed, limit)
        once = _rescaled(once, scale)
        pose, use = settled(once, found.pose, limit)
        chance = jnp.maximum(_chance(once, pose, use, limit), found.agreed / jnp.maximum(found.asked, 1.0))
        of = count(once.mask)
        expected = evidence.least_accidents(squares(once, pose), use, chance, of, limit)
        enough = self.search.enough_for(jnp.minimum(self.better * count(use), of), of)
        thorough = (found.counted >= enough) | (expected <= OVERWHELMING)
        later = Decision(pose, use, (expected <= math.log(self.accidents)) & thorough, scale)
        decision = jax.tree.map(lambda a, b: jnp.where(at_once.believed, a, b), at_once, later)
        return decision._replace(use=evidence.with_repeats(decision.use, again, key))

    def _searched(
        self, pair: Pair, first: RelativePose, wanted: Bool[Array, ""], limit: Float[Array, ""]
    ) -> tuple[Found, Float[Array, ""]]:
        """The search from a first pose, where it is wanted, and the noise to judge by, as a multiple of that stated."""

        def turn(state):
            k, _, scale, found = state
            own = _rescaled(pair, scale)
            found = self.search.run(own, self.search.begin(own, found.pose), self._worth(own, found.pose, limit))
            narrowed = _narrowed(own, found.pose, self.search.limit)
            noise = noise_of(squares(pair, narrowed), pair.mask)
            upper = noise.sigma * (1 + DEVIATIONS / jnp.sqrt(2 * jnp.maximum(noise.redundancy, 0.5)))
            most = noise.redundancy >= MAJORITY * count(squares(own, found.pose) <= self.search.limit**2)
            taken = noise.known & most & ((upper < APART * scale) | (not self.known))
            new = jnp.where(taken, jnp.clip(noise.sigma, 1 / MOST, MOST), scale)
            apart = (new < APART * scale) | (scale < APART * new)
            pose = jax.tree.map(lambda a, b: jnp.where(apart, a, b), narrowed, found.pose)
            return k + 1, apart, new, found._replace(pose=pose)

        one = jnp.ones_like(limit)
        start = jnp.zeros((), int), wanted, one, self.search.begin(pair, first)
        _, _, scale, found = while_loop(lambda state: state[1] & (state[0] < TURNS), turn, start, pair.focal_left)
        return found, scale

    def _worth(self, pair: Pair, pose: RelativePose, limit: Float[Array, ""]) -> Float[Array, ""]:
        """How many subsets are worth it: enough to meet the smallest set that would be believed."""
        of = count(pair.mask)
        use = pair.mask & (squares(pair, pose) <= limit**2)
        fewest = evidence.fewest(_chance(pair, pose, use, limit), of, math.log(self.accidents), pair.mask.shape[0])
        return jnp.maximum(self.search.enough_for(fewest, of), float(self.least))

    def _near_vertical(self, pair: Pair) -> RelativePose:
        """The best orientation of those that begin at the vertical."""
        small = cleaned(pair.with_mask(pair.mask & (count(pair.mask) <= self.few)))[0]
        best = _from_vertical(pair, 8)
        for other in (self.graduated.search(pair), self.near.search(small)):
            better = score(pair, other, self.search.limit) < score(pair, best, self.search.limit)
            best = jax.tree.map(lambda a, b, better=better: jnp.where(better, a, b), other, best)
        return best


class Recommended(AbstractProcedure):
    """The stages in turn, each where the one before was not believed; `no_consensus` where the last is not.

    Where another point could be the wrong one as well, the outcome is `undecided`: all these points are named and none
    of them rejected; the orientation is that without the one that is most likely wrong.

    `sigma`: the standard deviation of a coordinate; if None that of the pair. `level`: the probability that a pair
    without errors loses a point. `known`: whether sigma is known. If not, it is only where the search begins (the focal
    length / UNKNOWN for a pair whose sigma are all 1, as those that state none), and the points are judged by the noise
    that is found: sigma0 of the orientation, as a multiple of the sigma of the pair.
    """

    sigma: float | None = None
    level: float = 0.0025
    stages: tuple[AbstractStage, ...] = (Plain(), Quick(), Thorough())
    known: bool = True

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        begin = jnp.ones_like(pair.focal_left) if self.known else _unit(fixed)
        fixed = _rescaled(fixed, begin)
        limit = critical_values.by_count(
            lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0)), pair.x_left.shape[0], count(pair.mask)
        )
        zero = jnp.zeros_like(limit)
        decision = Decision(vertical(zero), fixed.mask & False, zero > 0, zero + 1)
        for stage in self.deciding:
            decision = _where_open(stage, fixed, limit, decision)
        pose, use, believed, scale = decision
        fixed = _rescaled(fixed, scale)
        w = normalised(linearised(fixed, pose), use)
        weighted = faded(_rescaled(pair, begin * scale), pose, use & believed)
        weighted = _rescaled(weighted, 1 / (begin * scale))
        rejection = judged(weighted, pose, use, limit, w).only_if(believed, OUTCOMES.no_consensus)
        return rejection.taking_back(_in_doubt(fixed, pose, use, believed))

    @property
    def deciding(self) -> tuple[AbstractStage, ...]:
        """The stages that decide: where sigma is not known only those that find the noise themselves."""
        if self.known:
            return self.stages
        return tuple(dataclasses.replace(stage, known=False) for stage in self.stages if isinstance(stage, Thorough))

    def separate(self, points: int) -> list["Recommended"]:
        """Two procedures for batches: the first stages, which are quick for any number of pairs at once, and the search
        for the pairs that these left open."""
        if not self.known:
            return [self]
        parts = self.stages[:2], self.stages[2:]
        return [dataclasses.replace(self, stages=stages) for stages in parts if stages]


def settled(pair: Pair, pose: RelativePose, limit: Float[Array, ""]) -> tuple[RelativePose, Use]:
    """The pose and the points that agree with it, from a pose near the right one."""
    use = pair.mask & (squares(pair, pose) <= limit**2)
    found = agreeing(pair, pose, use, limit, ROUNDS)
    # a few small errors do not stand out in a search: the points one by one, beginning with all of them
    few = count(pair.mask & ~found[1]) <= FEW
    best, lowest, _ = one_by_one(pair, *found, limit, 2, few)
    other, cost, rests = one_by_one(pair, pose, pair.mask, limit, ROUNDS, few)
    first = rests & (cost < lowest)
    pose, use = jax.tree.map(lambda a, b: jnp.where(first, a, b), other, best)
    return pose, use & seen(pair, pose, limit)


def _chance(pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]) -> Float[Array, ""]:
    """The chance that a wrong point agrees with a pose."""
    agreed, asked = evidence.shifted_agreement(pair, pose, limit)
    spread = evidence.scattered(squares(pair, pose), pair.mask & ~use, limit) / 2
    return jnp.maximum((agreed + 1) / (asked + 2), spread)


def _in_doubt(pair: Pair, pose: RelativePose, use: Use, believed: Bool[Array, ""]) -> Use:
    """The points of which some are wrong, though nothing tells which; of pairs with few points out."""
    out = pair.mask & ~use
    asked = believed & (count(out) > 0) & (count(out) <= FEW)

    def found(asked):
        own = pair.with_mask(pair.mask & asked)
        return undecided(own, pose, use & asked, out & asked & seen(own, pose, 0.0))

    return where_needed(asked, found, jnp.zeros_like(use))


def _narrowed(pair: Pair, pose: RelativePose, limit: float) -> RelativePose:
    """The pose that the points near it lead to, as the limit within which they count narrows (graduated weights of
    Geman and McClure): where sigma is too large, wrong points within the limit hide the right pose from a search."""

    def step(k, pose):
        width = limit * NARROWER ** (k / 2)
        return reweighted(pair, pose, lambda s: 1 / (1 + s / width**2) ** 2)

    steps = jnp.arange(NARROWINGS, dtype=pair.focal_left.dtype)
    return lax.scan(lambda pose, k: (step(k, pose), None), pose, steps)[0]


def _unit(pair: Pair) -> Float[Array, ""]:
    """By what the standard deviations of a pair are to be multiplied where all are 1, as in one that states none."""
    stated = count(pair.mask & (pair.sigma != 1)) > 0
    return jnp.where(stated, 1.0, pair.focal_left / UNKNOWN)


def _rescaled(pair: Pair, scale: Float[Array, ""]) -> Pair:
    """The pair with so many times the standard deviations."""
    sigma = jnp.where(pair.mask, pair.sigma * scale, 1.0)
    return Pair(*pair.coordinates, sigma, pair.mask, pair.focal_left, pair.focal_right)


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
    the global test. If they pass it by far, sigma is too large for it to tell that. Others agree by chance with a
    probability of about limit / mean |r|.
    """
    n, k = count(pair.mask), count(use)
    s = squares(pair, pose)
    misfit = total(jnp.where(use, s, 0.0))
    low, high = (evidence.chi_squared_limit(d, k - 5) for d in (-DEVIATIONS, DEVIATIONS))
    fits = (misfit >= low) & (misfit <= high) & (k >= share * n) & (k > 5)
    out = pair.mask & ~use
    certain = evidence.accidents(evidence.scattered(s, out, limit), n, k) <= math.log(accidents)
    return Decision(pose, use, fits & (certain | (count(out) == 0)), jnp.ones_like(limit))


def _where_open(stage: AbstractStage, pair: Pair, limit: Float[Array, ""], before: Decision) -> Decision:
    """The decision of a stage where there is none yet."""
    decide = lambda open_: stage(cleaned(pair.with_mask(pair.mask & open_))[0], limit)
    return where_needed(~before.believed, decide, before)
