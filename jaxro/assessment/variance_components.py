"""Standard deviations of groups of measurements, estimated from the residuals of many
pairs.

The variance of coordinate l is theta_k sigma_l² for the group k it belongs to, so that
the condition of a point has

    d = Σ_k theta_k s_k,    s_k = Σ (dg/dl)² sigma_l² over its coordinates in group k.

The estimate is restricted maximum likelihood, which allows for the five elements of
every pair, by Fisher scoring. Each step is the estimation of Helmert (1907), or MINQUE,
with the weights of the last step (Förstner 1979b; Patterson and Thompson 1971):

    F theta = q,    F_kl = tr(P S_k P S_l),    q_k = gᵀ P S_k P g,    P = D⁻¹ - D⁻¹ A N⁻¹ Aᵀ D⁻¹,

summed over the pairs; the covariance of theta is 2 F⁻¹. The conditions are linearised
once, at the given poses.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import normal_equations as normal
from ..adjustment.guarded import ratio
from ..geometry.linear import Linear, Values, linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.orient import Orientation
from ..xla.passes import sums, total
from ..xla.programs import compiled
from ..xla.settings import RUN_FAST

SURE = 0.5
"""Standard error of a variance, relative to the pooled variance, above which a group
counts as not estimable."""

FLOOR = 1e-6
"""Smallest variance in the iteration, relative to the pooled variance; an estimate that
reaches it is reported as zero."""

HELD = 1e9
"""Weight of a bound that a step would cross, relative to the weight of the data."""

CONVERGED = 1e-6
"""Change of the variances in the last step, relative to the pooled variance."""


class Components(eqx.Module):
    """Standard deviations of K groups, as factors of the sigma of the pairs (in mm or
    px if that is 1).

    `estimable`: whether the pairs determine the group. If not, its variance was tied to
    the variance of all measurements together (`pooled` is the root of this) by a prior
    with a standard deviation of half of it; `sigma` is 0 and the errors are infinite.
    In near-vertical pairs this is so for x, and for y of the left and right photo
    unless tilts tell them apart: give them one group. `standard_error` of sigma,
    `variance_error` of sigma². `covariance` of the variances sigma²; rows of groups
    that are not estimable are 0. A sigma of 0 that is estimable came out negative: the
    errors of this group are too small to be seen beside the others, and
    `variance_error` says how small. `redundancy`: the part of each group in the degrees
    of freedom. If the estimate has not `converged`, use none of it.
    """

    sigma: Float[Array, "group"]
    standard_error: Float[Array, "group"]
    variance_error: Float[Array, "group"]
    covariance: Float[Array, "group group"]
    estimable: Bool[Array, "group"]
    pooled: Float[Array, ""]
    redundancy: Float[Array, "group"]
    degrees_of_freedom: Int[Array, ""]
    converged: Bool[Array, ""]


def estimate(
    pairs: Pair,
    orientations: Orientation,
    groups: Sequence[ArrayLike],
    *,
    steps: int = 30,
) -> Components:
    """The variance components of a batch of oriented pairs of one camera, (pair,
    point).

    `groups`: the group of each measurement of x_left, y_left, x_right, y_right, whole
    numbers from 0 or arrays of them that broadcast to (pair, point). (0, 0, 0, 0) pools
    everything, (0, 1, 0, 2) asks for the y of both photos; arrays (point,) or (pair,
    point) divide points into classes. Pairs whose orientation is not usable do not take
    part. Works under jit if the groups are known before tracing. Raises ValueError if
    they are not four, or a number is left out.
    """
    shape = pairs.x_left.shape
    if len(shape) != 2 or len(groups) != 4:
        raise ValueError(
            "variance_components: wants (pair, point) coordinates and four groups, "
            f"got {shape}, {len(groups)}"
        )
    if pairs.roots is not None:
        raise ValueError(
            "variance_components: the pairs have covariances of their points; groups of "
            "coordinates share one variance each, so make the pairs without them"
        )
    with jax.ensure_compile_time_eval():
        labels = [jnp.asarray(g) for g in groups]
        names = sorted({int(v) for g in labels for v in jnp.unique(g)})
    if names != list(range(len(names))):
        raise ValueError(
            "variance_components: groups must be numbered 0, 1, 2, ... without gaps, "
            f"got {names}"
        )
    options = {"labels": tuple(labels), "size": len(names), "steps": steps}
    return _estimate(pairs, orientations, **options)


def by_photo(pairs: Pair, orientations: Orientation, *, steps: int = 30) -> Components:
    """The standard deviations of the left photos (0) and of the right ones (1):
    `estimate` of these two groups.

    Near-vertical pairs do not tell them apart (`estimable` says so); convergent or
    tilted ones do.
    """
    return estimate(pairs, orientations, (0, 0, 1, 1), steps=steps)


class _Data(NamedTuple):
    """The conditions of all pairs, and for every group k the `parts` s_k of the
    variances of the conditions, (pair, point)."""

    linear: Linear
    parts: list[Array]
    mask: Bool[Array, "pair point"]

    def equations(self, theta: Array) -> tuple[Array, Array]:
        """F and q at the variances theta."""
        size = len(self.parts)
        of_pair = jax.vmap(lambda *data: _equations_of_pair(theta, *data))
        entries = [total(e) for e in of_pair(*self)]
        lower = [[entries.pop(0) for _ in range(k + 1)] for k in range(size)]
        return normal.dense(lower), jnp.stack(entries)


class _Prior(NamedTuple):
    """What holds the variances besides the data: a normal prior at `centre` with these
    weights, zero for estimable groups; and the `floor` below which none may fall."""

    centre: Array
    weight: Array
    floor: Array


@compiled(settings=RUN_FAST)
def _estimate(
    pairs: Pair,
    orientations: Orientation,
    *,
    labels: tuple[Array, ...],
    size: int,
    steps: int,
) -> Components:
    pairs = jax.vmap(lambda p: mask_unusable(p)[0])(pairs)
    pairs = pairs.with_mask(pairs.mask & orientations.usable[:, None])
    equations = _data(pairs, orientations, labels, size).equations
    points = total(pairs.mask.astype(pairs.sigma.dtype))
    freedom = total(jnp.maximum(points - 5, 0.0))

    f, q = equations(jnp.ones(size, pairs.sigma.dtype))
    pooled = ratio(jnp.sum(q), freedom, freedom > 0)
    positive = jnp.where(pooled > 0, pooled, 1.0)
    estimable = (freedom > 0) & (_errors(f) < SURE)
    weight = jnp.where(estimable, 0.0, 2 / (SURE * positive) ** 2)
    prior = _Prior(jnp.full_like(q, pooled), weight, FLOOR * pooled)

    def score(_, state):
        theta, _ = state
        new = _step(*equations(theta), theta, prior)
        change = jnp.where(estimable, jnp.abs(new - theta), 0.0)
        return new, jnp.max(change) / positive

    theta, change = jax.lax.fori_loop(0, steps, score, (prior.centre, pooled))
    f, _ = equations(theta)
    return _components(f, theta, prior, estimable, pooled, freedom, change < CONVERGED)


def _data(
    pairs: Pair, orientations: Orientation, labels: tuple[Array, ...], size: int
) -> _Data:
    linear = jax.vmap(linearise)(pairs, orientations.pose)
    shape = pairs.x_left.shape
    of_points = lambda g: jnp.broadcast_to(g[None, :] if g.ndim == 1 else g, shape)
    groups = [of_points(g) for g in labels]
    squares = [b**2 for b in linear.gradient]
    parts = []
    for k in range(size):
        own = [
            jnp.where(g == k, b2, 0.0) for g, b2 in zip(groups, squares, strict=True)
        ]
        parts.append(sum(own) * pairs.sigma**2)
    return _Data(linear, parts, pairs.mask)


def _step(f: Array, q: Array, theta: Array, prior: _Prior) -> Array:
    """The variances after one step of Fisher scoring."""
    new = _solve(f, q, prior.centre, prior.weight)
    # a variance that comes out too small falls tenfold, or steps may run in a circle;
    # the step is repeated with it held there, because the others depend on it
    low = jnp.maximum(prior.floor, 0.1 * theta)
    out = new < low
    held = jnp.where(out, HELD * jnp.diagonal(f), 0.0)
    new = _solve(f, q, jnp.where(out, low, prior.centre), prior.weight + held)
    return jnp.where(new > low, new, low)


def _solve(f: Array, q: Array, centre: Array, weight: Array) -> Array:
    """The solution of F theta = q with a prior of this centre and weight."""
    right = q - jnp.sum(f * centre[None, :], axis=1)
    return centre + jnp.stack(normal.solve(_lower(f + jnp.diag(weight)), list(right)))


def _components(
    f: Array,
    theta: Array,
    prior: _Prior,
    estimable: Array,
    pooled: Array,
    freedom: Array,
    converged: Array,
) -> Components:
    information = f + jnp.diag(prior.weight)
    error = _errors(information)
    estimable = estimable & (error < SURE * pooled)
    positive = estimable & (theta > prior.floor)
    sigma = jnp.where(positive, jnp.sqrt(theta), 0.0)
    standard_error = error / jnp.where(positive, 2 * sigma, 1.0)
    both = estimable[:, None] & estimable[None, :]
    return Components(
        sigma=sigma,
        standard_error=jnp.where(positive, standard_error, jnp.inf),
        variance_error=jnp.where(estimable, error, jnp.inf),
        covariance=jnp.where(both, 2 * _inverse(information), 0.0),
        estimable=estimable,
        pooled=jnp.sqrt(pooled),
        redundancy=theta * jnp.sum(f * theta[None, :], axis=1),
        degrees_of_freedom=freedom.astype(int),
        converged=converged,
    )


def _equations_of_pair(
    theta: Array, linear: Linear, parts: list[Values], mask: Array
) -> tuple[Array, ...]:
    """The lower triangle of F, row by row, and q of one pair, from sums over its points
    alone:

    tr(P S_k P S_l) = Σ s_k s_l (1 - 2 h) / d² + tr(N⁻¹ M_k N⁻¹ M_l),    M_k = Σ s_k a aᵀ / d²
    """
    d = sum(theta[k] * s for k, s in enumerate(parts))
    weight = ratio(1.0, d, mask)
    inverse, residuals, leverage = _adjust(linear, weight)
    turned = []
    for s in parts:
        m, _, _ = linear.normal_equations(s * weight**2)
        turned.append(_product(inverse, normal.dense(m)))
    lower = [(k, l) for k in range(len(parts)) for l in range(k + 1)]
    factor = weight**2 * (1 - 2 * leverage)
    own = sums(tuple(parts[k] * parts[l] * factor for k, l in lower))
    trace = [jnp.sum(turned[k] * turned[l].T) for k, l in lower]
    f = [a + b for a, b in zip(own, trace, strict=True)]
    q = sums(tuple(s * residuals**2 for s in parts))
    enough = total(mask.astype(weight.dtype)) > 5
    return tuple(jnp.where(enough, entry, 0.0) for entry in (*f, *q))


def _adjust(linear: Linear, weight: Values) -> tuple[Array, Values, Values]:
    """N⁻¹, P g and the leverage h of the points, with these weights."""
    n, right, _ = linear.normal_equations(weight)
    inverse, _ = normal.inverse(n)
    factor, _ = normal.cholesky(n)
    x = normal.substitute(factor, right)
    shifts = normal.substitute(factor, linear.columns)
    residuals = weight * (linear.g - linear.times(x))
    leverage = weight * linear.times(shifts)
    return normal.dense(inverse), residuals, leverage


def _product(a: Array, b: Array) -> Array:
    """a b of two small matrices, without a batched matrix product."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _lower(f: Array) -> list[list[Array]]:
    return [[f[i, j] for j in range(i + 1)] for i in range(f.shape[0])]


def _inverse(f: Array) -> Array:
    return normal.dense(normal.inverse(_lower(f))[0])


def _errors(f: Array) -> Array:
    """Standard errors of the variances; the inverse of a singular F is wrong, but
    large."""
    variance = jnp.diagonal(2 * _inverse(f))
    root = jnp.sqrt(jnp.where(variance > 0, variance, 1.0))
    return jnp.where(variance > 0, root, jnp.inf)
