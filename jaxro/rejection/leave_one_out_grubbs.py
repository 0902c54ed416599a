"""Leave-one-out with Grubbs' test (Burshtynskaya and Tumskaya 1989)."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, ScalarLike

from ..adjustment import critical_values
from ..adjustment.normal_equations import accumulate, cholesky, substitute
from ..geometry.elements import AbstractElements
from ..geometry.mock_pairs import draw_points, noisy, plant
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import orient
from ..xla.kernels import computed_once
from ..xla.passes import count, sums, total
from .base import AbstractProcedure, PointValues, Rejection
from .masked import mean_of
from .parallaxes import (
    adjust_parallaxes,
    iterate_once,
    parallax_residuals,
    parallaxes,
)
from .rounds import (
    Round,
    conclude,
    element_values,
    finished_outcome,
    largest,
    repeat_rounds,
    rounds_of_one,
)
from .steps import inner

UNTESTABLE = 1e-3
"""Redundancy number below which a point is not tested: its omission leaves a (nearly)
singular system, whose refits do not converge in two iterations, and one such row would
hide all others."""

ROUNDING = 1e-10
"""Standard deviation of the means, in units of the coordinates or relative to the
means, up to which they differ by rounding alone."""

SMALL = 1e-5
"""Standard deviation of the simulated errors of `calibrate`, as part of the focal
length: small, so that the equations stay linear."""

Means = tuple[Float[Array, "point"], Bool[Array, "point"]]
"""Mean |q| after the omission of each point, and whether that can be tested."""


class Influence(NamedTuple):
    """The parallax adjustment linearised at given elements: q, the columns of A, those
    of (AᵀA)⁻¹ Aᵀ, and the redundancy numbers 1 - h_ii, H = A (AᵀA)⁻¹ Aᵀ; all zero for
    points that are not in use."""

    q: PointValues
    columns: list[PointValues]
    solved: list[PointValues]
    redundancy: PointValues


def influence(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> Influence:
    """The influence of the parallaxes of the points in use on the solution."""
    residuals = parallax_residuals(pair, mask, elements)
    (q,), jacobian, weight = residuals.columns()
    n, _, _ = accumulate([q], jacobian, weight)
    columns = [jnp.where(mask, column, 0.0) for (column,) in jacobian]
    solved = substitute(cholesky(n)[0], columns)
    h = inner(columns, solved)
    return Influence(
        q=jnp.where(mask, q, 0.0),
        columns=columns,
        solved=solved,
        redundancy=jnp.where(mask, 1 - h, 0.0),
    )


def refit_means(
    pair: Pair,
    mask: Bool[Array, "point"],
    elements: AbstractElements,
    iterations: int = 2,
) -> Means:
    """Mean |q| after the omission of each point in turn (matrix 5 and means 6 of 1989).

    All omissions are solved at once, each by some iterations from the solution of all
    points. Every iteration squares the error: two leave 1e-6 mm for a point with an
    error of 2 mm, and rounding for one with an error of 0.2 mm.
    """

    def mean_without(omitted):
        use = mask & ~omitted
        solved = elements
        for _ in range(iterations):
            solved = iterate_once(pair, use, solved)
        left = total(jnp.abs(parallaxes(pair, use, solved)))
        return left / jnp.maximum(count(mask), 1.0)

    redundancy = influence(pair, mask, elements).redundancy
    omissions = jnp.eye(mask.shape[0], dtype=bool)
    return jax.vmap(mean_without)(omissions), mask & (redundancy > UNTESTABLE)


def first_order_means(
    pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
) -> Means:
    """The same to first order: the omission of i changes q_j by h_ji q_i / r_i, r_i =
    1 - h_ii.

    It differs from `refit_means` for points of much leverage, or where the elements
    change by much.
    """

    def change_elements(pair, mask, elements):
        found = influence(pair, mask, elements)
        testable = mask & (found.redundancy > UNTESTABLE)
        safe = jnp.where(testable, found.redundancy, 1.0)
        factor = jnp.where(testable, found.q / safe, 0.0)
        changes = [factor * column for column in found.solved]
        return found.q, found.columns, changes, testable

    q, columns, changes, testable = computed_once(change_elements)(pair, mask, elements)

    def mean_without(own, *change):
        moved = q + inner(columns, change)
        # Σ |moved| as two sums in one pass: as a single sum XLA would compute it after
        # all n² numbers have been written
        above, below = sums((jnp.maximum(moved, 0.0), jnp.maximum(-moved, 0.0)))
        # q and the columns of a point that is not in use are zero
        return (above + below - own) / jnp.maximum(count(mask), 1.0)

    own = jnp.abs(q + inner(columns, changes))
    return jax.vmap(mean_without)(own, *changes), testable


def grubbs_statistic(
    means: Float[Array, "point"], use: Bool[Array, "point"]
) -> PointValues:
    """V of every omission: (mean of the means - its mean) / S, eqs (7) to (9)."""
    centre = mean_of(means, use)
    spread = jnp.sqrt(mean_of((means - centre) ** 2, use))
    real = spread > ROUNDING * jnp.maximum(centre, 1.0)
    v = (centre - means) / jnp.where(real, spread, 1.0)
    return jnp.where(use & real, v, 0.0)


class LeaveOneOutGrubbs(AbstractProcedure):
    """Omit each point in turn; the point whose omission leaves the smallest mean |q| is
    wrong if its V exceeds the critical value.

    One point a round, until none is rejected or `least` are left. `exact`: by refits,
    else to first order. `critical`: critical values by number of points in use, made by
    `calibrate`; otherwise Grubbs' formula at `level`, which takes the means for a
    normal sample. They are none: at 5 % the formula rejects a point of nearly half of
    all pairs without an error. A point whose omission leaves a singular system is not
    testable, and never rejected.
    """

    level: ScalarLike = 0.05
    exact: bool = True
    least: int = 6
    critical: Float[Array, "count"] | None = None

    def clean(self, pair: Pair) -> Rejection:
        pair = mask_unusable(pair)[0]

        def judge(mask):
            solved = adjust_parallaxes(pair, mask)
            v, testable = self.statistic(pair, mask, solved.pose)
            limit = self.limit(pair, mask, testable)
            worst = largest(v, testable) & (v > limit)
            return Round(
                statistic=v,
                limit=limit,
                rejected=worst & (count(mask) > self.least),
                parallax=solved.parallax,
                elements=element_values(solved.elements),
            )

        history = repeat_rounds(judge, pair, rounds_of_one(pair, self.least))
        final = adjust_parallaxes(pair, history.mask)
        return conclude(history, final, finished_outcome(pair))

    def statistic(
        self, pair: Pair, mask: Bool[Array, "point"], elements: AbstractElements
    ) -> tuple[PointValues, Bool[Array, "point"]]:
        """V of every point in use, and which points can be tested."""
        means_without = refit_means if self.exact else first_order_means
        means, testable = means_without(pair, mask, elements)
        return grubbs_statistic(means, testable), testable

    def limit(
        self, pair: Pair, mask: Bool[Array, "point"], testable: Bool[Array, "point"]
    ) -> Float[Array, ""]:
        """The critical value for the points in use, of which some can be tested."""
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


def calibrate(
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
    names = ("x_left", "y_left", "x_right", "y_right")
    exact = plant(pair, **dict(zip(names, solved.corrections(pair), strict=True)))

    def largest_v(key, omitted):
        noise, choice = jax.random.split(key)
        mask = pair.mask & ~draw_points(choice, pair.mask, omitted)
        measured = noisy(exact, noise, SMALL * pair.focal_left)
        pose = adjust_parallaxes(measured, mask, solved.pose).pose
        return jnp.max(procedure.statistic(measured, mask, pose)[0])

    simulate = jax.jit(jax.vmap(largest_v, (0, None)))
    used = int(count(pair.mask))
    table = jnp.zeros(pair.x_left.shape[0] + 1)
    for omitted in range(min(rounds, max(used - procedure.least, 0)) + 1):
        keys = jax.random.split(jax.random.fold_in(key, omitted), trials)
        value = jnp.quantile(simulate(keys, omitted), 1 - procedure.level)
        table = table.at[used - omitted].set(value)
    return dataclasses.replace(procedure, critical=table)
