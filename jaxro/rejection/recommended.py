"""The procedure to begin with, made of what the comparisons prove best."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from .. import critical_values
from ..conditions import linearised
from ..elements import RelativePose
from ..pairs import Pair, cleaned
from ..reductions import count, total
from .base import OUTCOMES, AbstractProcedure, Rejection
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import EightPoint, FivePoint, Newton
from .ransac import Ransac
from .robust import AbstractSearch, agreeing, in_front, judged, one_by_one, scaled, seen


class Recommended(AbstractProcedure):
    """Searches, each only where the one before found nothing convincing, then normalised residuals.

    1. Graduated non-convexity from the vertical: no subsets, its work grows with n; right in nearly all near-vertical
       pairs of fifty and more points with half of them wrong.
    2. Random subsets of five points solved by Newton's method from the vertical: for few points, where 1 fails.
    3. Random subsets of eight points, solved linearly: for photos in any position.
    4. Thirty times as many as in 2: for few points of near-vertical photos, half of them wrong.
    5. Random subsets solved by the five-point method: for what is left, such as plane scenes in any position.

    What is found is solved by least squares, and every point, in use or not, judged anew by its normalised residual
    |w| at the familywise `level`, in turns: a good point that a search lost comes back. Where no more than `few` are
    out, the same is done point by point from all points, by which few and small errors are found best; that set is
    taken if it rests, and convinces or has the smaller Σ r² + limit² (rejected).

    How convincing a set of k of n points is, is told by the expected number C(n, k) p^(k-5) (u/(1-u))^(k-5) of such
    sets that agree by accident: p = limit / mean |r| of the rejected points is about the share of wrong points that
    agree by chance, u = `wrong` the share of wrong points expected beforehand, without which a dozen points that agree
    beside three errors of ten sigma would count as an accident. Above `accidents` of a search, or with
    less than this `share` of the points, which right ones may give a wrong pose as well, the next one follows; above
    the last of `accidents` the outcome is `no_consensus`. A point behind a photo is rejected, unless infinitely far.
    """

    sigma: float | None = None
    level: float = 0.001
    rounds: int = 10
    few: int = 7
    wrong: float = 1 / 3
    searches: tuple[AbstractSearch, ...] = (
        GraduatedNonConvexity(),
        Ransac(hypotheses=Newton(), count=32, limit=5.0),
        Ransac(hypotheses=EightPoint(), count=128, confidence=0.9, limit=5.0),
        Ransac(hypotheses=Newton(), count=1024, limit=5.0),
        Ransac(hypotheses=FivePoint(), count=128, limit=5.0),
    )
    accidents: tuple[float, ...] = (1e-4, 1e-3, 1e-3, 0.05, 0.05)
    share: float = 0.3

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        limit = critical_values.by_count(
            lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0)), pair.x_left.shape[0], count(pair.mask)
        )
        pose, use = self._found(self.searches[0], fixed, limit)
        expected = self._accidents(fixed, pose, use, limit)
        for search, most in zip(self.searches[1:], self.accidents, strict=False):
            enough = count(use) >= self.share * count(fixed.mask)
            needed = ~((expected <= math.log(most)) & enough)
            pose, use, expected = self._elsewhere(search, fixed, limit, pose, use, expected, needed)
        least = self.share if len(self.searches) == 1 else 0.0
        convinced = (expected <= math.log(self.accidents[-1])) & (count(use) >= least * count(fixed.mask))
        return judged(pair, pose, use, limit).only_if(convinced, OUTCOMES.no_consensus)

    def stages(self) -> list["Recommended"]:
        """The searches as procedures of their own, for batches: each for the pairs that the one before left open."""
        shares = [self.share] * (len(self.searches) - 1) + [0.0]
        return [
            dataclasses.replace(self, searches=(search,), accidents=(most,), share=share)
            for search, most, share in zip(self.searches, self.accidents, shares, strict=True)
        ]

    def _found(self, search: AbstractSearch, pair: Pair, limit: Float[Array, ""]):
        pose = search.search(pair)
        use = pair.mask & (linearised(pair, pose).squares <= limit**2)
        found = agreeing(pair, pose, use, limit, self.rounds)
        best, lowest, _ = one_by_one(pair, *found, limit, 2)
        # a few small errors do not stand out in a search: the points one by one, beginning with all of them
        few = count(pair.mask & ~best[1]) <= self.few
        other, cost, rests = one_by_one(pair, pose, pair.mask, limit, self.rounds, few)
        convinces = self._accidents(pair, *other, limit) <= math.log(self.accidents[0])
        first = rests & ((cost < lowest) | convinces)
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

        return lax.while_loop(lambda state: state[0], again, (needed, pose, use, expected))[1:]

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
