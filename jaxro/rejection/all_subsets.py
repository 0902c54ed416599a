"""Every choice of up to k omissions: exact where several errors hide each other."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from .. import critical_values
from ..orientation import orient
from ..pairs import Pair, cleaned
from ..reductions import count, total
from ..starts import AbstractStart, Vertical
from .base import OUTCOMES, AbstractProcedure, Rejection, Round, began, ended, finished, independent, recorded
from .robust import at, normalised, scaled, stepped

BLOCK = 64
"""Choices solved together."""


class AllSubsets(AbstractProcedure):
    """Of all choices of at most `most` omissions the fewest that pass the global test, and of these the best.

    Each choice is solved by `iterations` Gauss-Newton steps from the solution of all points; it passes if
    Σ (r/sigma)² of the points left is at most the chi-squared value of `level` for their n - 5 degrees of freedom. At
    least `least` points stay. No choice passes: `operator_needed`, and nothing is rejected. The number of choices,
    C(n, 1) + ... + C(n, most), is 2,516 for four of 16 points and 14,892 for six.
    """

    most: int = 4
    level: float = 0.001
    sigma: float | None = None
    iterations: int = 4
    least: int = 6
    start: AbstractStart = Vertical()

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(cleaned(pair)[0], self.sigma)
        n = pair.x_left.shape[0]
        begin = orient(pair, start=lax.stop_gradient(self.start(lax.stop_gradient(pair)).pose)).pose
        choices, sizes = _choices(n, min(self.most, max(n - self.least, 0)))
        largest = int(sizes.max())
        used = count(pair.mask)

        def objective(omitted):
            use = pair.mask & ~omitted
            pose = begin
            for _ in range(self.iterations):
                linear = at(pair, pose)
                pose = stepped(pose, linear, jnp.where(use, linear.weight, 0.0))
            allowed = (count(omitted & ~pair.mask) == 0) & (used - count(omitted) >= self.least)
            squares = total(jnp.where(use, at(pair, pose).squares, 0.0))
            return jnp.where(allowed & jnp.isfinite(squares), squares, jnp.inf)

        def block(best, new):
            omitted, size = new
            squares = jax.vmap(objective)(omitted)
            rest = []
            for k, (lowest, choice) in enumerate(best):
                here = jnp.where(size == k, squares, jnp.inf)
                first = jnp.arange(BLOCK) == jnp.argmin(here)
                low = jnp.min(here)
                better = jnp.any(first[:, None] & omitted, axis=0)
                rest.append((jnp.minimum(low, lowest), jnp.where(low < lowest, better, choice)))
            return rest, None

        none = pair.mask & False
        begin_best = [(jnp.full_like(pair.focal_left, jnp.inf), none)] * (largest + 1)
        blocks = (jnp.asarray(choices.reshape(-1, BLOCK, n)), jnp.asarray(sizes.reshape(-1, BLOCK)))
        best, _ = lax.scan(block, begin_best, blocks)
        limits = [
            critical_values.by_count(
                lambda m: critical_values.chi_squared(self.level, jnp.maximum(m - 5, 1.0)), n, used - k
            )
            for k in range(largest + 1)
        ]
        omitted, found = none, none[0]
        for (lowest, choice), limit in zip(best, limits, strict=True):
            passes = ~found & (lowest <= limit)
            omitted = jnp.where(passes, choice, omitted)
            found = found | passes
        return self._ended(pair, omitted, found)

    def _ended(self, pair: Pair, omitted: Bool[Array, "point"], found: Bool[Array, ""]) -> Rejection:
        use = pair.mask & ~omitted
        solved = orient(pair.with_mask(use), start=self.start(lax.stop_gradient(pair.with_mask(use))).pose)
        w = jnp.where(pair.mask, normalised(at(pair, solved.pose), use), 0.0)
        limit = critical_values.by_count(lambda m: critical_values.normal(self.level + 0 * m), 1, count(use) * 0)
        new = Round(w, limit, omitted & pair.mask, solved.parallax, independent(solved.pose))
        outcome = OUTCOMES.where(found, finished(pair), OUTCOMES.operator_needed)
        return ended(recorded(began(pair, 1), new), solved, outcome)


def _choices(n: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Omissions (choice, point) of 0 to `most` points and how many each has; whole blocks, the rest of size -1."""
    rows = [c for k in range(most + 1) for c in combinations(range(n), k)]
    count = -(-len(rows) // BLOCK) * BLOCK
    omitted, sizes = np.zeros((count, n), bool), np.full(count, -1)
    for i, row in enumerate(rows):
        omitted[i, list(row)] = True
        sizes[i] = len(row)
    return omitted, sizes
