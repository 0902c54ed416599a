"""Leave-one-out with Grubbs' test (Burshtynskaya and Tumskaya 1989)."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ..adjustment import critical_values
from ..adjustment.normal_equations import accumulate, cholesky, substitute
from ..geometry.elements import AbstractElements
from ..geometry.mock_pairs import noisy, plant
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..xla.kernels import computed_once
from ..xla.passes import count, sums, total
from .base import (
    AbstractProcedure,
    PointValues,
    Rejection,
    Round,
    began,
    by_parallax,
    ended,
    finished,
    iterated,
    largest,
    mean_of,
    parallaxes,
    repeated,
    residuals_at,
    values,
)

UNTESTABLE = 1e-3
"""Redundancy number below which the omission of a point leaves a (nearly) singular
system: the refits then do not converge in two iterations, and one such row would hide
all others."""

ROUNDING = 1e-10
"""Differences of means (of the unit of the coordinates, or relative to them) that say
nothing."""

Means = tuple[Float[Array, "point"], Bool[Array, "point"]]


def refitted(
    pair: Pair,
    mask: Bool[Array, "point"],
    elements: AbstractElements,
    iterations: int = 2,
) -> Means:
    """Mean |q| after the omission of each point in turn (matrix 5 and means 6 of 1989),
    and whether it can be omitted.

    All omissions at once, each solved by some iterations from the solution of all
    points, of which every one squares the error: two leave 1e-6 mm where an error is 2
    mm, and rounding where it is .2 mm.
    """
    out = jnp.eye(mask.shape[0], dtype=bool)

    def one(omitted):
        use = mask & ~omitted
        solved = elements
        for _ in range(iterations):
            solved = iterated(pair, use, solved)
        return total(jnp.abs(parallaxes(pair, use, solved))) / jnp.maximum(
            count(mask), 1.0
        )

    _, _, redundancy = linearised(pair, mask, elements)
    return jax.vmap(one)(out), mask & (redundancy > UNTESTABLE)


def closed_form(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> Means:
    """The same to first order: the omission of i changes q_j by h_ji q_i / r_i, H = A
    (AᵀA)⁻¹ Aᵀ, r_i = 1 - h_ii.

    It differs from `refitted` where a point has much leverage or the elements change by
    much.
    """

    def shared(pair, mask, elements):
        q, (a, z), redundancy = linearised(pair, mask, elements)
        testable = mask & (redundancy > UNTESTABLE)
        factor = jnp.where(testable, q / jnp.where(testable, redundancy, 1.0), 0.0)
        return q, a, [factor * column for column in z], testable

    q, a, change, testable = computed_once(shared)(pair, mask, elements)

    def one(own, *change):
        moved = q + sum(column * c for column, c in zip(a, change, strict=True))
        # Σ |moved| as two sums in one pass: a single one XLA computes after all n²
        # numbers have been written
        above, below = sums((jnp.maximum(moved, 0.0), jnp.maximum(-moved, 0.0)))
        # a point not in use has q = a = 0
        return (above + below - own) / jnp.maximum(count(mask), 1.0)

    own = jnp.abs(q + sum(x * y for x, y in zip(a, change, strict=True)))
    return jax.vmap(one)(own, *change), testable


def linearised(pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements):
    """q, (the columns a of A, those of (AᵀA)⁻¹ Aᵀ) and the redundancy numbers 1 -
    h_ii."""
    (q,), jacobian, weight = residuals_at(pair, mask, elements).columns(
        (jnp.zeros_like(pair.focal_left),) * 5
    )
    n, _, _ = accumulate([q], jacobian, weight)
    a = [jnp.where(mask, column, 0.0) for (column,) in jacobian]
    z = substitute(cholesky(n)[0], a)
    h = sum(x * y for x, y in zip(a, z, strict=True))
    return jnp.where(mask, q, 0.0), (a, z), jnp.where(mask, 1 - h, 0.0)


def grubbs_statistic(
    means: Float[Array, "point"], use: Bool[Array, "point"]
) -> PointValues:
    """V of every omission: (mean of the means - its mean) / S, eqs (7) to (9)."""
    centre = mean_of(means, use)
    spread = jnp.sqrt(mean_of((means - centre) ** 2, use))
    # pairs without any error differ by rounding alone
    real = spread > ROUNDING * jnp.maximum(centre, 1.0)
    return jnp.where(use & real, (centre - means) / jnp.where(real, spread, 1.0), 0.0)


class LeaveOneOutGrubbs(AbstractProcedure):
    """Omit each point in turn; the omission with the smallest mean |q| is wrong if its
    V exceeds the critical value.

    One point a round, until none is rejected or `least` are left. `exact`: refits, or
    the closed form. `critical`: by number of points in use, from `calibrated`;
    otherwise Grubbs' formula at `level`, which takes the means for a normal sample.
    They are none: at 5 % it rejects a point of nearly half of all pairs without an
    error. An omission that leaves a singular system is not testable and never judged.
    """

    level: float = 0.05
    exact: bool = True
    least: int = 6
    critical: Float[Array, "count"] | None = None

    def __call__(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]

        def judge(mask, history):
            solved = by_parallax(pair, mask)
            v, testable = self.statistic(pair, mask, solved.pose)
            limit = self.limit(pair, mask, testable)
            out = largest(v, testable) & (v > limit) & (count(mask) > self.least)
            return Round(v, limit, out, solved.parallax, values(solved.elements))

        history = repeated(
            judge, began(pair, max(pair.x_left.shape[0] - self.least, 0) + 1)
        )
        return ended(history, by_parallax(pair, history.mask), finished(pair))

    def statistic(
        self, pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
    ) -> tuple:
        """V of every point in use, and which can be tested."""
        means, testable = (refitted if self.exact else closed_form)(
            pair, mask, elements
        )
        return grubbs_statistic(means, testable), testable

    def limit(
        self, pair: Pair, mask: Bool[Array, "point"], testable: Bool[Array, "point"]
    ) -> Float[Array, ""]:
        """The critical value for so many points in use, of which so many can be
        tested."""
        formula = critical_values.by_count(
            lambda n: critical_values.grubbs(self.level, n),
            pair.x_left.shape[0],
            count(testable),
        )
        if self.critical is None:
            return formula
        here = jnp.arange(self.critical.shape[0]) == count(mask).astype(int)
        known = total(jnp.where(here, self.critical, 0.0))
        return jnp.where(known > 0, known, formula)


def calibrated(
    procedure: LeaveOneOutGrubbs,
    pair: Pair,
    key: PRNGKeyArray,
    trials: int = 4000,
    rounds: int = 10,
) -> LeaveOneOutGrubbs:
    """The procedure with critical values from the distribution of the largest V on the
    layout of this pair.

    Errors of equal variance are added to the adjusted points of the pair; V does not
    depend on their size. For the rounds after a rejection as many random points are
    left out. Numbers of points beyond `rounds` use the formula.
    """
    pair = mask_unusable(pair)[0]
    solved = orient(pair)
    x_left, y_left, x_right, y_right = solved.corrections(pair)
    exact = plant(pair, x_left=x_left, y_left=y_left, x_right=x_right, y_right=y_right)
    size = 1e-5 * pair.focal_left
    used = int(count(pair.mask))
    table = jnp.zeros(pair.x_left.shape[0] + 1)

    def one(key, omitted):
        noise, choice = jax.random.split(key)
        rank = jnp.argsort(
            jnp.argsort(
                jnp.where(
                    pair.mask, jax.random.uniform(choice, pair.mask.shape, float), 2.0
                )
            )
        )
        measured = noisy(exact, noise, size)
        mask = pair.mask & (rank >= omitted)
        return jnp.max(
            procedure.statistic(
                measured, mask, by_parallax(measured, mask, solved.pose).pose
            )[0]
        )

    run = jax.jit(jax.vmap(one, (0, None)))
    for omitted in range(min(rounds, max(used - procedure.least, 0)) + 1):
        largest_v = run(
            jax.random.split(jax.random.fold_in(key, omitted), trials), omitted
        )
        table = table.at[used - omitted].set(
            jnp.quantile(largest_v, 1 - procedure.level)
        )
    return dataclasses.replace(procedure, critical=table)
