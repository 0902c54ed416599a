"""Every choice of up to k omissions: exact where several errors hide each other."""

from itertools import combinations
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment import critical_values
from ..adjustment.normal_equations import SINGULAR, accumulate, cholesky, substitute
from ..geometry.linear import Linear, linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..orientation.starts import AbstractStart, Vertical
from ..xla.passes import count, total
from .base import (
    OUTCOMES,
    AbstractProcedure,
    Rejection,
    Round,
    began,
    ended,
    finished,
    independent,
    recorded,
)
from .robust import improved, normalised, scaled

CHOICES = 1 << 18
"""Choices that are compared at most: their numbers take some 10 MB."""


class AllSubsets(AbstractProcedure):
    """Of all choices of at most `most` omissions the fewest that pass the global test,
    and of these the best.

    What a choice S leaves of Σ r² (r of sigma 1) is first computed from the solution of
    all points, to first order: Ω - r_S' (I - H_SS)⁻¹ r_S, H = A N⁻¹ A' (Cook and
    Weisberg 1982). The best `shortlist` of every number of omissions are then solved by
    `iterations` Gauss-Newton steps. A choice passes if Σ r² is at most the chi-squared
    value of `level` for its n - 5 degrees of freedom. At least `least` points stay. No
    choice passes: `no_choice`, and nothing is rejected. There are 2,516 choices of at
    most four of 16 points, and 14,892 of at most six; of many points fewer are left
    out, so that there are at most CHOICES (four of 50 points, two of 200).
    """

    most: int = 4
    level: float = 0.001
    sigma: float | None = None
    shortlist: int = 8
    iterations: int = 3
    least: int = 6
    start: AbstractStart = Vertical()

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        n = pair.x_left.shape[0]
        most = min(self.most, max(n - self.least, 0))
        while sum(comb(n, k) for k in range(most + 1)) > CHOICES:
            most -= 1
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        used = count(fixed.mask)
        begin = orient(fixed, start=self.start(fixed).pose).pose

        def left_over(omitted):
            """Σ r² without these points."""
            use, pose = fixed.mask & ~omitted, begin
            for _ in range(self.iterations):
                pose = improved(fixed, pose, use)
            allowed = (count(omitted & ~fixed.mask) == 0) & (
                used - count(omitted) >= self.least
            )
            squares = total(jnp.where(use, linearised(fixed, pose).squares, 0.0))
            return jnp.where(allowed & jnp.isfinite(squares), squares, jnp.inf)

        def best_of(carry, omitted):
            squares = jax.vmap(left_over)(omitted)
            first = jnp.arange(len(squares)) == jnp.argmin(squares)
            return carry, (jnp.min(squares), jnp.any(first[:, None] & omitted, axis=0))

        _, (squares, choices) = lax.scan(
            best_of, None, self._shortlists(fixed, linearised(fixed, begin), most)
        )
        value = lambda m: critical_values.chi_squared(
            self.level, jnp.maximum(m - 5, 1.0)
        )
        passes = squares <= jnp.stack(
            [critical_values.by_count(value, n, used - k) for k in range(most + 1)]
        )
        fewest = (jnp.arange(most + 1) == jnp.argmax(passes)) & passes
        return self._ended(
            pair, jnp.any(fewest[:, None] & choices, axis=0), jnp.any(passes)
        )

    def _shortlists(
        self, pair: Pair, linear: Linear, most: int
    ) -> Bool[Array, "size choice point"]:
        """The most promising choices of each number of omissions, repeated where there
        are fewer."""
        root = jnp.sqrt(linear.weight)
        r = linear.g * root
        columns = [column * root for column in linear.columns]
        z = substitute(
            cholesky(
                accumulate([linear.g], [[c] for c in linear.columns], [linear.weight])[
                    0
                ]
            )[0],
            columns,
        )
        h = sum(a[:, None] * b[None, :] for a, b in zip(columns, z, strict=True))
        n = len(r)
        lists = [jnp.zeros((self.shortlist, n), bool)]
        for k in range(1, most + 1):
            choices = np.array(list(combinations(range(n), k))).T
            block = [
                [h[i, j] for j in choices[: row + 1]]  # pyright: ignore[reportIndexIssue]
                for row, i in enumerate(choices)
            ]
            gain = _gain(block, [r[i] for i in choices])
            gain = jnp.where(
                sum((~pair.mask[i]).astype(gain.dtype) for i in choices) > 0,
                -jnp.inf,
                gain,
            )
            _, best = lax.top_k(
                gain.astype(jnp.float32), min(self.shortlist, gain.shape[0])
            )
            best = best[np.arange(self.shortlist) % best.shape[0]]
            points = jnp.asarray(choices.T)[best]
            lists.append(
                jnp.any(points[:, :, None] == jnp.arange(n)[None, None, :], axis=1)
            )
        return jnp.stack(lists)

    def _ended(
        self, pair: Pair, omitted: Bool[Array, "point"], found: Bool[Array, ""]
    ) -> Rejection:
        use = pair.mask & ~omitted
        # the optimum does not depend on where it is sought
        solved = orient(
            pair.with_mask(use),
            start=self.start(lax.stop_gradient(pair.with_mask(use))).pose,
        )
        w = jnp.where(pair.mask, normalised(linearised(pair, solved.pose), use), 0.0)
        limit = critical_values.by_count(
            lambda m: critical_values.normal(self.level + 0 * m), 1, count(use) * 0
        )
        new = Round(
            w, limit, omitted & pair.mask, solved.parallax, independent(solved.pose)
        )
        outcome = OUTCOMES.where(found, finished(pair), OUTCOMES.no_choice)
        return ended(recorded(began(pair, 1), new), solved, outcome)


def _gain(h: list[list[Array]], r: list[Array]) -> Float[Array, "choice"]:
    """r' (I - H)⁻¹ r of every choice; none where the other points do not determine the
    orientation without it."""
    factor, pivot = cholesky(
        [
            [1 - a if i == j else -a for j, a in enumerate(row)]
            for i, row in enumerate(h)
        ]
    )
    solved = substitute(factor, r)
    gain = sum(a * b for a, b in zip(r, solved, strict=True))
    return jnp.where(pivot > SINGULAR**0.5, gain, -jnp.inf)
