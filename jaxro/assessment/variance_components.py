"""Standard deviations of groups of measurements, estimated from the residuals of many
pairs.

The variance of coordinate l is theta_k sigma_l² for the group k it belongs to, so that
the condition of a point has

    d = Σ_k theta_k s_k,    s_k = Σ (dg/dl)² sigma_l² over its coordinates in group k.

Restricted maximum likelihood, which allows for the five elements of every pair, by
Fisher scoring; each step is the estimation of Helmert (1907) and MINQUE with the
weights of the last one (Förstner 1979b; Patterson and Thompson 1971):

    F theta = q,    F_kl = tr(P S_k P S_l),    q_k = gᵀ P S_k P g,    P = D⁻¹ - D⁻¹ A N⁻¹ Aᵀ D⁻¹,

summed over the pairs; the covariance of theta is 2 F⁻¹. One linearisation at the given
poses serves all steps.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..adjustment import normal_equations as normal
from ..geometry.linear import Linear, linearised
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.result import Orientation
from ..xla.passes import sums, total
from ..xla.programs import Program, is_traced

SURE = 0.5
"""Standard error of a variance, relative to the pooled variance, above which the group
counts as not estimable."""

FLOOR = 1e-6
"""Smallest variance of the iteration, relative to the pooled one; an estimate that
reaches it is reported as zero."""


class Components(eqx.Module):
    """Standard deviations of K groups, factors to the sigma of the pairs (mm or px
    where that is 1).

    `estimable`: whether the pairs determine the group. Where not, its variance was tied
    to that of all measurements together (`pooled` is its root) by a prior with a
    standard deviation of half of it; `sigma` is 0 and the errors are infinite. In
    near-vertical pairs that is so for x, and for y of the left and right photo unless
    tilts tell them apart: give them one group. `covariance`: of the variances sigma²;
    rows of what is not estimable are 0. A sigma of 0 that is estimable came out
    negative: the errors of this group are too small to be seen beside the others, and
    `variance_error` says how small. Where it has not `converged`, none of this is to be
    used. `redundancy`: the part of each group in the degrees of freedom.
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
    """The variance components of a batch of pairs of one camera, (pair, point),
    oriented in any reasonable way.

    `groups`: the group of each measurement of x_left, y_left, x_right, y_right, whole
    numbers from 0 or arrays of them that broadcast to (pair, point). (0, 0, 0, 0) pools
    everything, (0, 1, 0, 2) asks for the y of both photos; arrays (point,) or (pair,
    point) part points into classes. Pairs whose orientation is not usable do not take
    part. Works under jit where the groups are known before tracing. Raises ValueError
    if they are not four, or a number is left out.
    """
    shape = pairs.x_left.shape
    if len(shape) != 2 or len(groups) != 4:
        raise ValueError(
            "variance_components: wants (pair, point) coordinates and four groups, "
            f"got {shape}, {len(groups)}"
        )
    with jax.ensure_compile_time_eval():
        labels = [jnp.asarray(g) for g in groups]
        names = sorted({int(v) for g in labels for v in jnp.unique(g)})
    if names != list(range(len(names))):
        raise ValueError(
            "variance_components: groups must be numbered 0, 1, 2, ... without gaps, "
            f"got {names}"
        )
    labels = tuple(labels)
    if is_traced((pairs, orientations)):
        return _estimate(
            (pairs, orientations), labels=labels, size=len(names), steps=steps
        )
    return Program(_estimate, {"labels": labels, "size": len(names), "steps": steps})(
        (pairs, orientations)
    )


def by_photo(pairs: Pair, orientations: Orientation, *, steps: int = 30) -> Components:
    """The standard deviations of the left photos (0) and of the right ones (1):
    `estimate` of these two groups.

    Near-vertical pairs do not tell them apart (`estimable` says so); convergent or
    tilted ones do.
    """
    return estimate(pairs, orientations, (0, 0, 1, 1), steps=steps)


def _estimate(
    data: tuple[Pair, Orientation], *, labels: tuple[Array, ...], size: int, steps: int
) -> Components:
    pairs, orientations = data
    shape = pairs.x_left.shape
    parted = [jnp.broadcast_to(g if g.ndim != 1 else g[None, :], shape) for g in labels]
    pairs = jax.vmap(lambda p: mask_unusable(p)[0])(pairs)
    pairs = pairs.with_mask(pairs.mask & orientations.usable[:, None])
    linear = jax.vmap(linearised)(pairs, orientations.pose)
    parts = [
        sum(
            jnp.where(g == k, b**2, 0.0)
            for g, b in zip(parted, linear.gradient, strict=True)
        )
        * pairs.sigma**2
        for k in range(size)
    ]
    freedom = total(jnp.maximum(total(pairs.mask.astype(pairs.sigma.dtype)) - 5, 0.0))
    there = freedom > 0

    def equations(theta: Array):
        return [
            total(s)
            for s in jax.vmap(lambda *of: _of_pair(theta, *of))(
                linear, parts, pairs.mask
            )
        ]

    one = jnp.ones(size, pairs.sigma.dtype)
    f, q = _unpacked(equations(one), size)
    pooled = jnp.sum(q) / jnp.where(there, freedom, 1.0)
    safe = jnp.where(pooled > 0, pooled, 1.0)
    estimable = there & (_errors(f) < SURE)
    prior = jnp.where(estimable, 0.0, 2 / (SURE * safe) ** 2)
    least = FLOOR * pooled

    def solved(f, q, centre, prior):
        right = q - jnp.sum(f * centre[None, :], axis=1)
        return centre + jnp.stack(
            normal.solve(_lower(f + jnp.diag(prior)), list(right))
        )

    def scored(_, state):
        theta, _ = state
        f, q = _unpacked(equations(theta), size)
        new = solved(f, q, one * pooled, prior)
        # a variance that comes out too small falls tenfold, or steps may run in a
        # circle; the others have to know it
        low = jnp.maximum(least, 0.1 * theta)
        out = new < low
        new = solved(
            f,
            q,
            jnp.where(out, low, pooled),
            prior + jnp.where(out, 1e9 * jnp.diagonal(f), 0.0),
        )
        new = jnp.where(new > low, new, low)
        return new, jnp.max(jnp.where(estimable, jnp.abs(new - theta), 0.0)) / safe

    theta, change = jax.lax.fori_loop(0, steps, scored, (one * pooled, pooled))
    f, _ = _unpacked(equations(theta), size)
    error = _errors(f + jnp.diag(prior))
    estimable = estimable & (error < SURE * pooled)
    positive = estimable & (theta > least)
    sigma = jnp.where(positive, jnp.sqrt(theta), 0.0)
    both = estimable[:, None] & estimable[None, :]
    return Components(
        sigma,
        jnp.where(positive, error / jnp.where(positive, 2 * sigma, 1.0), jnp.inf),
        jnp.where(estimable, error, jnp.inf),
        jnp.where(both, 2 * _inverse(f + jnp.diag(prior)), 0.0),
        estimable,
        jnp.sqrt(pooled),
        theta * jnp.sum(f * theta[None, :], axis=1),
        freedom.astype(int),
        change < 1e-6,
    )


def _of_pair(
    theta: Array, linear: Linear, parts: list[Array], mask: Array
) -> tuple[Array, ...]:
    """The lower triangle of F and q of one pair, from sums over its points alone:

    tr(P S_k P S_l) = Σ s_k s_l (1 - 2 h) / d² + tr(N⁻¹ M_k N⁻¹ M_l),    M_k = Σ s_k a aᵀ / d²
    """
    terms = [theta[k] * s for k, s in enumerate(parts)]
    d = sum(terms[1:], terms[0])
    weight = jnp.where(mask, 1 / jnp.where(mask, d, 1.0), 0.0)
    columns = [[c] for c in linear.columns]
    n, right, _ = normal.accumulate([linear.g], columns, [weight])
    inverse, _ = normal.inverse(n)
    factor, _ = normal.cholesky(n)
    x = normal.substitute(factor, right)
    z = normal.substitute(factor, linear.columns)
    h = weight * sum(a * b for a, b in zip(linear.columns, z, strict=True))
    v = weight * (
        linear.g - sum(a * b for a, b in zip(linear.columns, x, strict=True))
    )  # P g
    q = normal.dense(inverse)
    turned = []
    for s in parts:
        m, _, _ = normal.accumulate([linear.g], columns, [s * weight**2])
        turned.append(_product(q, normal.dense(m)))
    pairs = [(k, l) for k in range(len(parts)) for l in range(k + 1)]
    own = sums(tuple(parts[k] * parts[l] * weight**2 * (1 - 2 * h) for k, l in pairs))
    trace = [jnp.sum(turned[k] * turned[l].T) for k, l in pairs]
    squares = sums(tuple(s * v**2 for s in parts))
    enough = total(mask.astype(d.dtype)) > 5
    return tuple(
        jnp.where(enough, e, 0.0)
        for e in (*(a + b for a, b in zip(own, trace, strict=True)), *squares)
    )


def _product(a: Array, b: Array) -> Array:
    """a b of two small matrices, without a batched matrix product."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _unpacked(entries: list[Array], size: int) -> tuple[Array, Array]:
    """F as a matrix, and q."""
    rest = list(entries)
    lower = [[rest.pop(0) for _ in range(k + 1)] for k in range(size)]
    return normal.dense(lower), jnp.stack(rest)


def _lower(f: Array) -> list[list[Array]]:
    return [[f[i, j] for j in range(i + 1)] for i in range(f.shape[0])]


def _inverse(f: Array) -> Array:
    return normal.dense(normal.inverse(_lower(f))[0])


def _errors(f: Array) -> Array:
    """Standard errors of the variances; the lifted inverse of a singular F is wrong,
    but large."""
    variance = jnp.diagonal(2 * _inverse(f))
    return jnp.where(
        variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), jnp.inf
    )
