"""Every choice of up to k omissions: exact where several errors hide each other."""

from itertools import combinations
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, ScalarLike

from ..adjustment import critical_values
from ..adjustment.normal_equations import SINGULAR, cholesky, substitute
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..orientation.starts import AbstractStart, Vertical
from ..xla.passes import count
from .agreement import normalised_residuals, state_sigma
from .base import OUTCOMES, AbstractProcedure, Rejection
from .masked import Use, sum_of
from .rounds import Round, conclude_round, finished_outcome, independent_values
from .steps import improve, inner, normal_equations

CHOICES = 1 << 18
"""Choices that are compared at most: their numbers take some 10 MB."""

Choices = Bool[Array, "number choice point"]
"""Points omitted, by number of omissions and choice."""


class AllSubsets(AbstractProcedure):
    """Of all choices of at most `most` omissions the fewest that pass the global test,
    and of these the best.

    What a choice S leaves of Σ r² (r in units of sigma) is first computed from the
    solution of all points, to first order: Ω - r_S' (I - H_SS)⁻¹ r_S, H = A N⁻¹ A'
    (Cook and Weisberg 1982). The best `shortlist` of every number of omissions are then
    solved by `iterations` Gauss-Newton steps. A choice passes if Σ r² is at most the
    chi-squared value of `level` for its n - 5 degrees of freedom. At least `least`
    points stay. If no choice passes, the outcome is `no_choice` and nothing is
    rejected. There are 2,516 choices of at most four of 16 points, and 14,892 of at
    most six. For many points `most` is lowered so that there are at most CHOICES (four
    of 50 points, two of 200).
    """

    most: int = 4
    level: ScalarLike = 0.001
    sigma: ScalarLike | None = None
    shortlist: int = 8
    iterations: int = 3
    least: int = 6
    start: AbstractStart = Vertical()

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        pose = orient(fixed, start=self.start(fixed).pose).pose
        choices = self._shortlists(fixed, linearise(fixed, pose))

        def best_of(carry, omitted):
            left = jax.vmap(lambda out: self._left_over(fixed, pose, out))(omitted)
            first = jnp.arange(len(left)) == jnp.argmin(left)
            return carry, (jnp.min(left), jnp.any(first[:, None] & omitted, axis=0))

        _, (left, best) = lax.scan(best_of, None, choices)
        passes = left <= self._limits(fixed, len(choices))
        fewest = (jnp.arange(len(choices)) == jnp.argmax(passes)) & passes
        omitted = jnp.any(fewest[:, None] & best, axis=0)
        return self._conclude(pair, omitted, jnp.any(passes))

    def _most(self, points: int) -> int:
        """How many points may be omitted of so many."""
        most = min(self.most, max(points - self.least, 0))
        while sum(comb(points, k) for k in range(most + 1)) > CHOICES:
            most -= 1
        return most

    def _left_over(
        self, pair: Pair, pose: RelativePose, omitted: Use
    ) -> Float[Array, ""]:
        """Σ (r / sigma)² without these points; infinite if they cannot be omitted."""
        use = pair.mask & ~omitted
        for _ in range(self.iterations):
            pose = improve(pair, pose, use)
        left = sum_of(linearise(pair, pose).squares, use)
        masked = count(omitted & ~pair.mask) > 0
        enough = count(pair.mask) - count(omitted) >= self.least
        return jnp.where(enough & ~masked & jnp.isfinite(left), left, jnp.inf)

    def _limits(self, pair: Pair, numbers: int) -> Float[Array, "number"]:
        """The critical values of Σ (r / sigma)² after 0, 1, ... omissions."""
        value = lambda n: critical_values.chi_squared(
            self.level, np.maximum(n - 5, 1.0)
        )
        points, used = pair.x_left.shape[0], count(pair.mask)
        limits = [
            critical_values.by_count(value, points, used - k) for k in range(numbers)
        ]
        return jnp.stack(limits)

    def _shortlists(self, pair: Pair, linear: Linear) -> Choices:
        """The most promising choices of each number of omissions, some of them repeated
        where there are fewer."""
        n = pair.x_left.shape[0]
        root = jnp.sqrt(linear.weight)
        residuals = linear.g * root
        columns = [column * root for column in linear.columns]
        factor, _ = cholesky(normal_equations(linear, linear.weight)[0])
        solved = substitute(factor, columns)
        hat = jnp.zeros((n, n))
        for column, z in zip(columns, solved, strict=True):
            hat = hat + column[:, None] * z[None, :]
        numbers = jnp.arange(n)[None, None, :]
        lists = [jnp.zeros((self.shortlist, n), bool)]
        for k in range(1, self._most(n) + 1):
            choices = np.array(list(combinations(range(n), k)))
            gain = _gain(hat, residuals, choices)
            masked = sum((~pair.mask[i]).astype(gain.dtype) for i in choices.T)
            gain = jnp.where(masked > 0, -jnp.inf, gain)
            taken = min(self.shortlist, len(choices))
            _, best = lax.top_k(gain.astype(jnp.float32), taken)
            repeated = best[np.arange(self.shortlist) % taken]
            points = jnp.asarray(choices)[repeated]
            lists.append(jnp.any(points[:, :, None] == numbers, axis=1))
        return jnp.stack(lists)

    def _conclude(self, pair: Pair, omitted: Use, found: Bool[Array, ""]) -> Rejection:
        use = pair.mask & ~omitted
        kept = pair.with_mask(use)
        # the optimum does not depend on where it is sought
        start = self.start(lax.stop_gradient(kept)).pose
        solved = orient(kept, start=start)
        w = normalised_residuals(linearise(pair, solved.pose), use)
        only = Round(
            statistic=jnp.where(pair.mask, w, 0.0),
            limit=critical_values.normal(self.level) + 0 * count(use),
            rejected=omitted & pair.mask,
            parallax=solved.parallax,
            elements=independent_values(solved.pose),
        )
        finished = finished_outcome(pair)
        outcome = OUTCOMES.where(found, finished, OUTCOMES.no_choice)
        return conclude_round(pair, only, solved, outcome)


def _gain(
    hat: Float[Array, "point point"],
    residuals: Float[Array, "point"],
    choices: np.ndarray,
) -> Float[Array, "choice"]:
    """r_S' (I - H_SS)⁻¹ r_S of every choice S; minus infinity where the other points
    do not determine the orientation."""
    places = choices.T
    identity = np.eye(len(places))
    left_over = [
        [identity[row, column] - hat[i, places[column]] for column in range(row + 1)]
        for row, i in enumerate(places)
    ]
    r = [residuals[i] for i in places]
    factor, pivot = cholesky(left_over)
    solved = substitute(factor, r)
    gain = inner(r, solved)
    return jnp.where(pivot > SINGULAR**0.5, gain, -jnp.inf)
