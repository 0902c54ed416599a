"""Where to measure: positions of points that make a criterion of accuracy or
reliability smallest, by gradient.

Each coordinate is x = middle + half sin(u), so that it stays in the overlap, and a best
place at the edge is an ordinary stationary point (with a sigmoid it would lie at
infinity). BFGS improves u from several random starts at once, and the best of them
counts.

A largest value is not smooth. Instead of it the p-norm is minimised, for p = 16 and
after that for p = 256, at most 2 % above the largest value; the values themselves are
compared and reported. `layout_criteria` has the criteria.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from ..xla.programs import compiled, is_traced
from .layout_criteria import (
    DELTA0 as DELTA0,
    AbstractCriterion as AbstractCriterion,
    DetectableError as DetectableError,
    Determinant as Determinant,
    HeightDeviation as HeightDeviation,
    Overlap as Overlap,
    Plan as Plan,
    Positions,
    Trace as Trace,
    detectable_errors as detectable_errors,
    height_deviations as height_deviations,
    photograph as photograph,
    plan_layout as plan_layout,
)

NORMS = (16.0, 256.0)
"""p of the p-norms that replace the largest value, one after the other."""

STEPS = 300
"""Steps of BFGS allowed for each of them."""

INSIDE = 0.99
"""|sin u| of a start at most: at the edge u has no gradient."""


class Design(NamedTuple):
    """The best layout found: its positions x and y and the `value` of the criterion;
    and for every start the criterion `before` and `after`, and whether the iteration
    has `converged`. No start ends worse than it began."""

    x: Float[Array, "point"]
    y: Float[Array, "point"]
    value: Float[Array, ""]
    before: Float[Array, "start"]
    after: Float[Array, "start"]
    converged: Bool[Array, "start"]


def design(
    criterion: AbstractCriterion,
    overlap: Overlap,
    points: int,
    key: PRNGKeyArray,
    *,
    sigma: ArrayLike = 1.0,
    starts: int = 8,
    start: tuple[ArrayLike, ArrayLike] | None = None,
    kept: tuple[ArrayLike, ArrayLike] | None = None,
) -> Design:
    """The positions of `points` points that make the criterion smallest, with
    coordinates of standard deviation `sigma`.

    `starts`: number of random layouts to begin with; a criterion has several minima.
    `start`: positions (x, y) of one more layout to begin with. `kept`: positions of
    further points that stay where they are; they come last in the result. Raises
    ValueError for fewer points than the criterion needs, and for an overlap that is no
    box.
    """
    whole = points + (0 if kept is None else np.size(kept[0]))
    if whole < criterion.fewest:
        raise ValueError(
            f"design: {whole} points, where {criterion.fewest} are the fewest, with "
            "those kept"
        )
    for axis, side in (("x", overlap.x), ("y", overlap.y)):
        if not is_traced(side) and not 0 < np.ptp(np.asarray(side, float)) < np.inf:
            raise ValueError(
                f"design: the overlap has {axis} = {side}; it must be an interval"
            )
    number = lambda a: jnp.asarray(a, float) if isinstance(a, float | np.ndarray) else a
    arguments = {
        "criterion": criterion,
        "overlap": overlap,
        "sigma": sigma,
        "start": start,
        "kept": kept,
    }
    arguments = jax.tree.map(number, arguments)
    options = arguments | {"points": points, "starts": starts}
    return _design(key, **options)


@compiled
def _design(key, *, criterion, overlap, points, starts, sigma, start, kept) -> Design:
    box = _Box(*(jnp.asarray(side, float) for side in (overlap.x, overlap.y)))
    kept = () if kept is None else tuple(jnp.asarray(a, float) for a in kept)
    search = _Search(criterion, overlap, box, sigma, kept)
    first = box.draw(key, (starts, points))
    if start is not None:
        given = [jnp.asarray(a, float)[None] for a in start]
        first = jax.tree.map(lambda *a: jnp.concatenate(a), tuple(given), first)
    ends, before, after, converged = jax.vmap(search.improve)(first)
    best = jnp.argmin(after)
    x, y = search.with_kept((ends[0][best], ends[1][best]))
    return Design(
        x=x,
        y=y,
        value=after[best],
        before=before,
        after=after,
        converged=converged,
    )


class _Box(NamedTuple):
    """The intervals of x and y, and the angles u that stand for positions in them."""

    x: Float[Array, "2"]
    y: Float[Array, "2"]

    def places(self, angles: Positions) -> Positions:
        x, y = (
            (low + high) / 2 + (high - low) / 2 * jnp.sin(u)
            for (low, high), u in zip(self, angles, strict=True)
        )
        return x, y

    def angles(self, places: Positions) -> Positions:
        sines = (
            (2 * a - low - high) / (high - low)
            for (low, high), a in zip(self, places, strict=True)
        )
        x, y = (jnp.arcsin(jnp.clip(sine, -INSIDE, INSIDE)) for sine in sines)
        return x, y

    def draw(
        self, key: PRNGKeyArray, shape: tuple[int, int]
    ) -> tuple[Float[Array, "start point"], Float[Array, "start point"]]:
        """Random positions."""
        x, y = (
            jax.random.uniform(k, shape, float, *side)
            for k, side in zip(jax.random.split(key), self, strict=True)
        )
        return x, y


class _Search(NamedTuple):
    """What a layout is searched for; `kept`: x and y of points that stay, or empty."""

    criterion: AbstractCriterion
    overlap: Overlap
    box: _Box
    sigma: ArrayLike
    kept: tuple[Array, ...]

    def with_kept(
        self, free: Positions
    ) -> tuple[Float[Array, "every"], Float[Array, "every"]]:
        """The free points and those that stay."""
        if not self.kept:
            return free
        x, y = (jnp.concatenate(both) for both in zip(free, self.kept, strict=True))
        return x, y

    def plan(self, free: Positions) -> Plan:
        return plan_layout(self.overlap, self.with_kept(free), self.sigma)

    def improve(self, first: Positions) -> tuple[Positions, Array, Array, Array]:
        """The layout found from a first one, the criterion before and after, and
        whether the iteration has converged."""
        criterion, box = self.criterion, self.box
        norms = NORMS if criterion.largest else NORMS[:1]
        objective = lambda u, p: criterion.logarithm(self.plan(box.places(u)), p)
        u, converged = _minimise(objective, box.angles(first), norms)
        last = box.places(u)
        before, after = criterion(self.plan(first)), criterion(self.plan(last))
        better = after < before
        end = jax.tree.map(lambda a, b: jnp.where(better, a, b), last, first)
        return end, before, jnp.where(better, after, before), converged


def _minimise(
    function, u: Positions, norms: tuple[float, ...]
) -> tuple[Positions, Bool[Array, ""]]:
    """The u that minimises function(u, p) for the last p, begun at the minimum for the
    one before, and whether this has converged."""

    def minimise(u, p):
        solver = optx.BFGS(rtol=1e-8, atol=1e-8)
        found = optx.minimise(function, solver, u, args=p, max_steps=STEPS, throw=False)
        return found.value, found.result == optx.RESULTS.successful

    u, converged = lax.scan(minimise, u, jnp.asarray(norms))
    return u, converged[-1]
