"""The procedure to begin with, made of what the comparisons prove best."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from .. import critical_values
from ..conditions import linearised
from ..elements import RelativePose, vertical
from ..pairs import Pair, cleaned
from ..programs import while_loop
from ..reductions import count, total
from .base import OUTCOMES, AbstractProcedure, Rejection
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import EightPoint, FivePoint, Newton
from .ransac import Ransac
from .robust import AbstractSearch, agreeing, in_front, judged, one_by_one, scaled, seen


class Stage(eqx.Module):
    """A search; the expected number of accidents up to which it is believed; the fewest points of a pair for it."""

    search: AbstractSearch
    accidents: float
    fewest: int = 0


class Recommended(AbstractProcedure):
    """Searches, each only where the one before found nothing convincing, then normalised residuals.

    1. Graduated non-convexity from the vertical: no subsets, its work grows with n; right in nearly all near-vertical
       pairs of fifty and more points with half of them wrong. Skipped for pairs of fewer than thirty points, where it
       sometimes ends in a wrong set that still convinces.
    2. Random subsets of five points solved by Newton's method from the vertical: for few points, and where 1 fails.
    3. Random subsets of eight points, solved linearly: for photos in any position.
    4. Thirty times as many as in 2: for few points of near-vertical photos, half of them wrong.
    5. Random subsets solved by the five-point method: for what is left, such as plane scenes in any position.

    What is found is solved by least squares, and every point, in use or not, judged anew by its normalised residual
    |w| at the familywise `level`, in turns: a good point that a search lost comes back. Where no more than `few` are
    out, the same is done point by point from all points, by which few and small errors are found best; that set is
    taken if it rests and costs less, by `robust.one_by_one`: among few points, one that would bend the solution to
    itself is therefore rejected at a |w| a little below the limit.

    How convincing a set of k of n points is, is told by the expected number C(n, k) p^(k-5) (u/(1-u))^(k-5) of such
    sets that agree by accident: p = limit / mean |r| of the rejected points is about the share of wrong points that
    agree by chance, u = `wrong` the share of wrong points expected beforehand. (Without this factor a dozen points that
    agree, beside three errors of ten sigma, would count as an accident.) Above the `accidents` of a stage, or with less
    than this `share` of the points, which right ones may give a wrong pose as well, the next stage follows; above those
    of the last the outcome is `no_consensus`. A point behind a photo is rejected, unless infinitely far.
    """

    sigma: float | None = None
    level: float = 0.0025
    rounds: int = 10
    few: int = 7
    wrong: float = 1 / 3
    stages: tuple[Stage, ...] = (
        Stage(GraduatedNonConvexity(), accidents=1e-4, fewest=30),
        Stage(Ransac(hypotheses=Newton(), count=32, limit=5.0), accidents=1e-3),
        Stage(Ransac(hypotheses=EightPoint(), count=128, confidence=0.9, limit=5.0), accidents=1e-3),
        Stage(Ransac(hypotheses=Newton(block=64), count=1024, limit=5.0), accidents=0.05),
        Stage(Ransac(hypotheses=FivePoint(), count=128, limit=5.0), accidents=0.05),
    )
    share: float = 0.3

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        limit = critical_values.by_count(
            lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0)), pair.x_left.shape[0], count(pair.mask)
        )
        zero = jnp.zeros_like(limit)
        pose, use, expected, believed = vertical(zero), fixed.mask & False, zero + jnp.inf, 0.0
        for stage in self.stages:
            enough = count(use) >= self.share * count(fixed.mask)
            needed = ~((expected <= believed) & enough) & (count(fixed.mask) >= stage.fewest)
            pose, use, expected = self._elsewhere(stage.search, fixed, limit, pose, use, expected, needed)
            believed = math.log(stage.accidents)
        least = self.share if len(self.stages) == 1 else 0.0
        convinced = (expected <= believed) & (count(use) >= least * count(fixed.mask))
        return judged(pair, pose, use, limit).only_if(convinced, OUTCOMES.no_consensus)

    def separate(self, points: int) -> list["Recommended"]:
        """The stages of pairs of up to so many points as procedures of their own, for batches: each for the pairs that
        the one before left open."""
        shares = [self.share] * (len(self.stages) - 1) + [0.0]
        stages = zip(self.stages, shares, strict=True)
        return [
            dataclasses.replace(self, stages=(stage,), share=share) for stage, share in stages if stage.fewest <= points
        ]

    def _found(self, search: AbstractSearch, pair: Pair, limit: Float[Array, ""]):
        pose = search.search(pair)
        use = pair.mask & (linearised(pair, pose).squares <= limit**2)
        found = agreeing(pair, pose, use, limit, self.rounds)
        best, lowest, _ = one_by_one(pair, *found, limit, 2)
        # a few small errors do not stand out in a search: the points one by one, beginning with all of them
        few = count(pair.mask & ~best[1]) <= self.few
        other, cost, rests = one_by_one(pair, pose, pair.mask, limit, self.rounds, few)
        first = rests & (cost < lowest)
        pose, use = jax.tree.map(lambda a, b: jnp.where(first, a, b), other, best)
        return pose, use & seen(pair, pose, limit)

    def _elsewhere(self, search, pair: Pair, limit, pose: RelativePose, use, expected, needed):
        """The same by another search where it is needed: a loop of at most one round, which under vmap is entered only
        if some pair of the batch needs it. What it works on depends on the round, or XLA would compute it anyway."""

        def again(state):
            needed, *found = state
            masked = cleaned(pair.with_mask(pair.mask & needed))[0]
            pose, use = self._found(search, masked, limit)
            new = [pose, use, self._accidents(pair, pose, use, limit)]
            return needed & False, *jax.tree.map(lambda a, b: jnp.where(needed, a, b), new, found)

        return while_loop(lambda state: state[0], again, (needed, pose, use, expected), pair.focal_left)[1:]

    def _accidents(self, pair: Pair, pose: RelativePose, use, limit) -> Float[Array, ""]:
        """Logarithm of the expected number."""
        linear, mask = linearised(pair, pose), pair.mask
        use = use & (linear.squares <= limit**2) & in_front(pair, pose)
        n, k = count(mask), count(use)
        wrong = mask & ~use
        mean = total(jnp.where(wrong, jnp.sqrt(linear.squares), 0.0)) / jnp.maximum(count(wrong), 1.0)
        chance = limit / jnp.maximum(mean, 2 * limit)
        choices = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
        odds = math.log(self.wrong / (1 - self.wrong))
        return jnp.where(k > 5, choices + (k - 5) * (jnp.log(chance) + odds), jnp.inf)
