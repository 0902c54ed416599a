"""Steps of reweighted Gauss-Newton on the distances of the points, and the set of
points that agree with a pose."""

import abc
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..adjustment.normal_equations import accumulate, cholesky, solve, substitute
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, linearised
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..xla.kernels import while_loop
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

Values = Float[Array, "point"]
Use = Bool[Array, "point"]

LEAST = 0.01
"""Smallest redundancy of a point when sets are compared: below it a point would be
rejected for that alone."""


class AbstractSearch(AbstractProcedure):
    """A procedure that finds the pose first, and the wrong points by it."""

    @abc.abstractmethod
    def search(self, pair: Pair) -> RelativePose:
        """A pose near the right one, in spite of the wrong points."""


def judged(
    pair: Pair, pose: RelativePose, use: Use, limit: ArrayLike, w: Values | None = None
) -> Rejection:
    """The verdict that only `use` are right, with the orientation of them and the
    evidence |w| against the limit: that by which it was decided, or else that of this
    orientation; infinite where a point was rejected as it cannot be seen. Of five
    points and fewer none can be tested."""
    enough = count(pair.mask) > 5
    use = jnp.where(enough, use, pair.mask)
    solved = orient(pair.with_mask(use), start=pose)
    if w is None:
        w = normalised(linearised(pair, solved.pose), use)
    limit = jnp.asarray(limit, w.dtype)
    w = jnp.where(~use & (w <= limit) & ~seen(pair, solved.pose, limit), jnp.inf, w)
    w = jnp.where(pair.mask & enough, w, 0.0)
    new = Round(w, limit, pair.mask & ~use, solved.parallax, independent(solved.pose))
    outcome = OUTCOMES.where(enough, finished(pair), OUTCOMES.nothing_to_test)
    return ended(recorded(began(pair, 1), new), solved, outcome)


def in_single(tree: PyTree) -> PyTree:
    """The tree with its floating-point numbers in single precision."""
    return jax.tree.map(
        lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a,
        tree,
    )


def scaled(pair: Pair, sigma: float | None) -> Pair:
    """The pair with the given standard deviation of its coordinates, or its own."""
    if sigma is None:
        return pair
    known = jnp.full_like(pair.sigma, sigma)
    return Pair(*pair.coordinates, known, pair.mask, pair.focal_left, pair.focal_right)


def stepped(
    pose: RelativePose, linear: Linear, weight: Values, most: float = 0.3
) -> RelativePose:
    """The pose after one Gauss-Newton step with these weights in place of those of
    `linear`, no component longer than `most` (rad)."""
    n, h, _ = accumulate([linear.g], [[c] for c in linear.columns], [weight])
    delta = solve(n, h)
    longest = delta[0] * 0
    for d in delta:
        longest = jnp.maximum(longest, jnp.abs(d))
    shrink = jnp.minimum(
        1.0, most / jnp.maximum(longest, jnp.finfo(longest.dtype).tiny)
    )
    shrink = jnp.where(jnp.isfinite(longest), shrink, 0.0)
    moved = pose.move(
        tuple(jnp.where(jnp.isfinite(d), -shrink * d, 0.0) for d in delta)
    )
    return moved.normalise()


def reweighted(
    pair: Pair, pose: RelativePose, weight: Callable[[Values], Values]
) -> RelativePose:
    """One step with the weights `weight`((r / sigma)²)."""
    linear = linearised(pair, pose)
    return stepped(pose, linear, linear.weight * weight(linear.squares))


def normalised(linear: Linear, share: Use | Values) -> Values:
    """|w| of all points against the solution of those in use, or of all with a `share`
    of their weights.

    A point in use has the variance 1 - h, h = a N⁻¹ aᵀ its leverage; one not in use has
    1 + h; in between it is 1 + (1 - 2p) h.
    """
    return jnp.sqrt(linear.squares / _controlled(linear, share)[0])


def _controlled(linear: Linear, share: Use | Values) -> tuple[Values, Float[Array, ""]]:
    """The variance of each r / sigma, and log det N."""
    share = share.astype(linear.weight.dtype)
    n, _, _ = accumulate(
        [linear.g], [[c] for c in linear.columns], [linear.weight * share]
    )
    factor, _ = cholesky(n)
    z = substitute(factor, linear.columns)
    h = linear.weight * sum(a * b for a, b in zip(linear.columns, z, strict=True))
    h = jnp.where(jnp.isfinite(h), h, 1.0)
    inverse_pivots = [row[i] for i, row in enumerate(factor)]
    return jnp.maximum(1 + (1 - 2 * share) * h, 1e-6), -2 * sum(
        map(jnp.log, inverse_pivots)
    )  # pyright: ignore[reportReturnType]


def in_front(pair: Pair, pose: RelativePose) -> Use:
    """The points in front of both photos, with the sign of the base that most of them
    ask for."""
    rotation, base = pose.relative()

    def depths(point):
        return coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )[3:]

    lam, mu = jax.vmap(depths)(pair.coordinates)
    front, behind = pair.mask & (lam > 0) & (mu > 0), pair.mask & (lam < 0) & (mu < 0)
    return jnp.where(count(front) >= count(behind), front, behind)


def parallel(pair: Pair, pose: RelativePose, limit: ArrayLike) -> Use:
    """The points whose rays are parallel within `limit` standard deviations of the
    angle between them."""
    rotation, base = pose.relative()

    def one(point, sigma):
        first, second, w2, *_ = coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )
        variance = sigma**2 * (1 / rot.dot(first, first) + 1 / rot.dot(second, second))
        return w2 <= jnp.asarray(limit, w2.dtype) ** 2 * variance * rot.dot(
            first, first
        ) * rot.dot(second, second)

    return pair.mask & jax.vmap(one)(pair.coordinates, pair.sigma)


def seen(pair: Pair, pose: RelativePose, limit: ArrayLike) -> Use:
    """The points that can be seen: in front of both photos, or so far that the sign of
    their depth says nothing."""
    return in_front(pair, pose) | parallel(pair, pose, limit)


@partial(jax.jit, static_argnames="rounds")
def agreeing(
    pair: Pair, pose: RelativePose, use: Use, limit: ArrayLike, rounds: int
) -> tuple[RelativePose, Use]:
    """The pose of the points with |w| <= limit, found in turns: solve, judge every
    point anew.

    Ends when the points stay the same after two turns or more, at last after `rounds`.
    """
    limit = jnp.asarray(limit, pair.sigma.dtype)

    def turn(state):
        k, _, pose, use = state
        pose = improved(pair, pose, use)
        new = pair.mask & (normalised(linearised(pair, pose), use) <= limit)
        return k + 1, (k == 0) | (count(new ^ use) > 0), pose, new

    return _while_needed(rounds, jnp.asarray(True), turn, pair, pose, use)[1:]


@partial(jax.jit, static_argnames="rounds")
def one_by_one(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: ArrayLike,
    rounds: int,
    wanted: Bool[Array, ""] | bool = True,
):
    """(pose, points) near the least cost, the cost (before the last change, if it does
    not rest), and whether it rests.

    The cost is Σ (r/sigma)² over the points in use + limit² (points rejected) + log det
    N of those in use, minus twice the logarithm of the evidence for that set by
    Laplace's approximation (MacKay 1992): a wrong point agrees by accident the more
    easily the less the others say about where it should be. In each round the one point
    changes sides that lowers the cost most: out, by w² - limit² - log(1 - h), or in, by
    limit² - w² - log(1 + h). The limit is widened by what this takes from it on the
    average of n points all in use, log(n / (n - 5)). Nothing happens, and nothing
    rests, where it is not `wanted`.
    """
    n, wanted = count(pair.mask), jnp.asarray(wanted)
    cut = jnp.asarray(limit, pair.sigma.dtype) ** 2 + jnp.log(
        jnp.maximum(n, 6.0) / jnp.maximum(n - 5, 1.0)
    )

    def turn(state):
        k, _, pose, use, _ = state
        pose = improved(pair, pose, use)
        linear = linearised(pair, pose)
        variance, log_det = _controlled(linear, use)
        cost = (
            total(jnp.where(pair.mask, jnp.where(use, linear.squares, cut), 0.0))
            + log_det
        )
        over = linear.squares / variance - cut
        gain = jnp.where(use, over, -over) - jnp.log(jnp.maximum(variance, LEAST))
        gain = jnp.where(pair.mask, gain, 0.0)
        best = jnp.max(gain)
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        return k + 1, best > 0, pose, use ^ ((gain == best) & (best > 0)), cost

    going, pose, use, cost = _while_needed(
        rounds, wanted, turn, pair, pose, use, cut + jnp.inf
    )
    return (pose, use), cost, wanted & ~going


def improved(pair: Pair, pose: RelativePose, use: Use) -> RelativePose:
    """The pose after one step of least squares on the points in use."""
    linear = linearised(pair, pose)
    return stepped(pose, linear, jnp.where(use, linear.weight, 0.0))


def _while_needed(
    rounds: int, needed: Bool[Array, ""], turn: Callable, pair: Pair, *state: PyTree
):
    """(needed, *state) after turns (k, needed, *state) -> the same, while needed and at
    most `rounds`."""
    start = (jnp.zeros((), int), needed, *state)
    return while_loop(
        lambda state: state[1] & (state[0] < rounds), turn, start, pair.focal_left
    )[1:]
