"""Which points agree with a pose: distances, normalised residuals, and the set of
points that judges itself.

    |w| = |r| / (sigma sqrt(1 - h)) of a point in use,    |r| / (sigma sqrt(1 + h)) else,

h the leverage of the point, so that points in use and points left out are judged alike.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree, ScalarLike

from ..adjustment import critical_values
from ..adjustment.normal_equations import cholesky, substitute
from ..geometry import coplanarity
from ..geometry.elements import RelativePose
from ..geometry.linear import Linear, linearise
from ..geometry.pairs import Pair
from ..xla.kernels import while_loop
from ..xla.passes import count
from .masked import Use, Values, sum_of
from .steps import inner, normal_equations, take_step

LEAST = 0.01
"""Smallest redundancy of a point when sets are compared: below it a point would be
rejected for its small redundancy alone."""

SMALLEST_VARIANCE = 1e-6
"""Smallest variance of a residual, in units of sigma²."""


def state_sigma(pair: Pair, sigma: ScalarLike | None) -> Pair:
    """The pair with this standard deviation of its coordinates; its own if None. Raises
    ValueError for a pair whose coordinates have covariances."""
    if sigma is None:
        return pair
    if pair.roots is not None:
        raise ValueError(
            f"sigma = {sigma} is one standard deviation for all coordinates, but the "
            "pair has covariances of its own: leave out the sigma of the procedure"
        )
    return dataclasses.replace(pair, sigma=jnp.full_like(pair.sigma, sigma))


def scale_sigma(pair: Pair, scale: Float[Array, ""]) -> Pair:
    """The pair with so many times the standard deviations."""
    sigma = jnp.where(pair.mask, pair.sigma * scale, 1.0)
    return eqx.tree_at(lambda pair: pair.sigma, pair, sigma)


def familywise_limit(level: ScalarLike, pair: Pair) -> Float[Array, ""]:
    """The value that the largest |w| of a pair without errors exceeds with the
    probability `level`, as if all its tests were independent: the normal value of level
    / n (Bonferroni)."""
    return critical_values.by_count(
        lambda n: critical_values.normal(level / np.maximum(n, 1.0)),
        pair.x_left.shape[0],
        count(pair.mask),
    )


def squares(pair: Pair, pose: RelativePose) -> Values:
    """(r / sigma)² of every point; zero of masked ones."""
    residuals = coplanarity.residuals(pair, pose)
    square = lambda g, d, use: jnp.where(use, g[0] ** 2 / d[0][0], 0.0)
    return residuals.groups(square, residuals.shared())


def points_within(pair: Pair, pose: RelativePose, limit: ArrayLike) -> Use:
    """The points with |r| <= limit sigma."""
    most = jnp.asarray(limit, pair.sigma.dtype) ** 2
    return pair.mask & (squares(pair, pose) <= most)


def normalised_residuals(linear: Linear, share: Use | Values) -> Values:
    """|w| of all points against the solution of the points in use, or of all points
    with a `share` of their weights."""
    variance, _ = _variances(linear, share)
    return jnp.sqrt(linear.squares / variance)


def _variances(linear: Linear, share: Use | Values) -> tuple[Values, Float[Array, ""]]:
    """The variance of each r / sigma, 1 + (1 - 2 share) h with the leverage h = a N⁻¹
    aᵀ / d, and log det N."""
    share = share.astype(linear.weight.dtype)
    n, _ = normal_equations(linear, linear.weight * share)
    factor, _ = cholesky(n)
    solved = substitute(factor, linear.columns)
    leverage = linear.weight * inner(linear.columns, solved)
    leverage = jnp.where(jnp.isfinite(leverage), leverage, 1.0)
    variance = 1 + (1 - 2 * share) * leverage
    inverse_pivots = [row[i] for i, row in enumerate(factor)]
    log_det = -2 * sum(map(jnp.log, inverse_pivots))
    variance = jnp.maximum(variance, SMALLEST_VARIANCE)
    return variance, log_det  # pyright: ignore[reportReturnType]


@partial(jax.jit, static_argnames="rounds")
def keep_agreeing(
    pair: Pair, pose: RelativePose, use: Use, limit: ArrayLike, rounds: int
) -> tuple[RelativePose, Use]:
    """The pose of the points with |w| <= limit, and these points: in turns, one step on
    the points in use, then every point is judged anew.

    Ends when the points stay the same after two turns or more, at last after `rounds`.
    """
    limit = jnp.asarray(limit, pair.sigma.dtype)

    def turn(state):
        k, _, _, use, ahead = state
        linear = linearise(pair, ahead)
        agree = pair.mask & (normalised_residuals(linear, use) <= limit)
        new = jnp.where(k == 0, use, agree)
        changed = count(new ^ use) > 0
        return k + 1, (k <= 1) | changed, ahead, new, _step(ahead, linear, new)

    state = _repeat(rounds, jnp.asarray(True), turn, pair, pose, use, pose)
    _, pose, use, _ = state
    return pose, use


@jax.jit
def one_by_one(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    rounds: Int[Array, ""],
    limit: ArrayLike,
    wanted: Bool[Array, ""] | bool = True,
) -> tuple[tuple[RelativePose, Use], Float[Array, ""], Bool[Array, ""]]:
    """(pose, points) near the least cost, that cost (before the last change if the set
    still changes), and whether the set has come to rest.

    The cost is Σ (r/sigma)² of the points in use + limit² (points rejected) + log det N
    of those in use. This is minus twice the logarithm of the evidence for the set, by
    Laplace's approximation (MacKay 1992): a wrong point agrees by accident the more
    easily, the less the others say about where it should be. In each round the one
    point changes sides that lowers the cost most: out, by w² - limit² - log(1 - h), or
    in, by limit² - w² - log(1 + h). The limit is widened by what this takes from it on
    the average of n points all in use, log(n / (n - 5)). Where it is not `wanted`,
    nothing happens and nothing comes to rest.
    """
    wanted = jnp.asarray(wanted)
    n = count(pair.mask)
    freedom = jnp.maximum(n - 5, 1.0)
    widening = jnp.log(jnp.maximum(n, 6.0) / freedom)
    cut = jnp.asarray(limit, pair.sigma.dtype) ** 2 + widening

    def turn(state):
        k, _, _, use, _, ahead = state
        linear = linearise(pair, ahead)
        variance, log_det = _variances(linear, use)
        cost = sum_of(jnp.where(use, linear.squares, cut), pair.mask) + log_det
        cost = jnp.where(jnp.isfinite(cost) & (k > 0), cost, jnp.inf)
        over = linear.squares / variance - cut
        redundancy = jnp.maximum(variance, LEAST)
        gain = jnp.where(use, over, -over) - jnp.log(redundancy)
        gain = jnp.where(pair.mask, gain, 0.0)
        best = jnp.max(gain)
        better = best > 0
        use = use ^ ((gain == best) & better & (k > 0))
        return k + 1, better | (k == 0), ahead, use, cost, _step(ahead, linear, use)

    start = pose, use, cut + jnp.inf, pose
    going, pose, use, cost, _ = _repeat(rounds, wanted, turn, pair, *start)
    return (pose, use), cost, wanted & ~going


def _step(pose: RelativePose, linear: Linear, use: Use) -> RelativePose:
    """The pose after one step of least squares on the points in use."""
    return take_step(pose, linear, jnp.where(use, linear.weight, 0.0))


def _repeat(
    rounds: int | Int[Array, ""],
    going: Bool[Array, ""],
    turn: Callable,
    pair: Pair,
    *state: PyTree,
):
    """(going, *state) after turns (k, going, *state) -> the same, while they go on. The
    first only takes a step; at most `rounds` follow.

    A turn judges at the pose `ahead`, to which the last step led, and takes the next
    step from there: the conditions are linearised once.
    """
    more = lambda state: state[1] & (state[0] <= rounds)
    start = (jnp.zeros((), int), going, *state)
    return while_loop(more, turn, start, pair.focal_left)[1:]
