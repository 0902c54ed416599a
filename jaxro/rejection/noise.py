"""The standard deviation of measurements, estimated from residuals among which many
belong to wrong points.

The distances |r| of n points from the right pose are a mixture. Those of right points
are half-normal with a scale s; those of wrong points spread so widely that their
density is flat within a few s of zero:

    density of |r| in the window [0, W] = a 2/s phi(r/s) + (1 - a) / W,    W = 8 s.

1. Where to begin: s is tried at all scales, in steps of sqrt(2). A trial takes this
   mixture inside its window and a histogram in log |r| outside of it; the largest
   likelihood wins. Five right points fit any pose through them, so the density of five
   points counts as 1 / max |r| (compare Moisan and Stival 2004). Nothing has to be
   known of the scale beforehand, and few right points suffice.
2. Maximum likelihood of a and s in the window by EM (Dempster, Laird and Rubin 1977): a
   point is right with the probability p = a phi / density.
3. The five elements have taken their part of the squares: Σ p r² / sigma² is chi-square
   with m = Σ p - 5 degrees of freedom, and sigma² = Σ p r² / (m (1 - 2 / 9m)³), which
   is above the truth as often as below (the median of chi-square by Wilson and Hilferty
   1931). Its standard deviation is that of a chi-square, enlarged by the information
   that is lost to not knowing which points are right (Louis 1982).

Many pairs of one camera: sigma² = Σ squares / Σ redundancy over all pairs whose own
estimates agree with the median of all, as a pair in the wrong pose, or with repeated
structures, does not.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float

from ..xla.passes import count, sums, total

PARAMETERS = 5
"""Elements of a relative orientation."""

SCALES = 50
"""Scales of step 1, in ratios of sqrt(2) from the largest |r| downwards: down to 4e-8
of it."""

WINDOW = 8.0
"""Width of the window in units of s: six steps of step 1."""

BINS = 16
"""Bins of the window in step 1; the innermost one reaches from zero to s / 23."""

ROUNDS = 30
"""Steps of EM."""

APART = 2.5
"""Standard deviations from the median of the pairs above which a pair takes no part in
the pooled estimate."""


class Noise(eqx.Module):
    """The noise of the measurements; for a batch every field has leading axes.

    `sigma` in the unit of the residuals, and its standard `deviation`. `share`: the
    part of the points that are right. `squares` = Σ p r² and `redundancy` = Σ p - 5, or
    the sums of both. Where the redundancy is not positive nothing is known: sigma is 0,
    and its deviation infinite.
    """

    sigma: Float[Array, "*pairs"]
    deviation: Float[Array, "*pairs"]
    share: Float[Array, "*pairs"]
    squares: Float[Array, "*pairs"]
    redundancy: Float[Array, "*pairs"]

    @property
    def known(self) -> Bool[Array, "*pairs"]:
        """Whether the residuals tell anything."""
        return self.sigma > 0


def noise_of(squares: Float[Array, "point"], mask: Bool[Array, "point"]) -> Noise:
    """The noise of one pair from the squared residuals r² of its points at the right
    pose.

    The pose is that of least squares on the right points, or near it; the residuals of
    wrong points are those at this pose. Residuals whitened by a sigma give the ratio to
    that sigma. Works under jit and vmap. From eleven right points on it is reliable; of
    fewer among many wrong ones the scale may be that of an accident.
    """
    r = jnp.sqrt(jnp.where(mask, squares, 0.0))
    n = count(mask)
    begin = _scale(r, mask, n)
    # in units of the first scale, so that no number of the iteration depends on the
    # unit
    u = r / jnp.where(begin > 0, begin, 1.0)

    def improved(_, state):
        s, a = state
        p, inside = _probabilities(u, mask, s, a)
        right, within, moment = sums((p, inside, p * u**2))
        s = jnp.sqrt(moment / jnp.maximum(right, 1e-300))
        return jnp.maximum(s, 1e-6), jnp.clip(
            right / jnp.maximum(within, 1.0), 0.01, 1.0
        )

    one = jnp.ones_like(begin)
    s, a = jax.lax.fori_loop(0, ROUNDS, improved, (one, 0.5 * one))
    p, inside = _probabilities(u, mask, s, a)
    z = (u / s) ** 2 - 1
    doubt = p * (1 - p)
    right, within, moment, spread, both, doubts = sums(
        (p, inside, p * u**2, doubt * z**2, doubt * z, doubt)
    )
    redundancy = right - PARAMETERS
    known = (redundancy > 0) & (begin > 0)
    redundancy = jnp.where(known, redundancy, 0.0)
    safe = jnp.where(known, redundancy, 1.0)
    squares_of_right = jnp.where(known, moment * begin**2, 0.0)
    # information on log s: of known points, less what is lost to not knowing which are
    # right, less what a takes
    of_share = jnp.maximum(within * a * (1 - a) - doubts, 1e-6)
    information = (
        (2 * right - spread - both**2 / of_share) * safe / jnp.maximum(right, 1.0)
    )
    sigma = jnp.sqrt(squares_of_right / (safe * _median(safe)))
    certain = known & (information > 0)
    return Noise(
        sigma=sigma,
        deviation=jnp.where(
            certain, sigma / jnp.sqrt(jnp.where(certain, information, 1.0)), jnp.inf
        ),
        share=jnp.where(known, right / jnp.maximum(n, 1.0), 0.0),
        squares=squares_of_right,
        redundancy=redundancy,
    )


def _median(freedom: Array) -> Array:
    """The median of chi-square over its degrees of freedom; no smaller than that of one
    half."""
    return (1 - 2 / (9 * jnp.maximum(freedom, 0.5))) ** 3


def _probabilities(u: Array, mask: Array, s: Array, a: Array) -> tuple[Array, Array]:
    """The probability of every point that it is right, and whether it lies in the
    window (0 or 1)."""
    inside = mask & (u <= WINDOW * s)
    core = a * math.sqrt(2 / math.pi) * jnp.exp(-0.5 * (u / s) ** 2)
    return jnp.where(inside, core / (core + (1 - a) / WINDOW), 0.0), inside.astype(
        u.dtype
    )


def _scale(
    r: Float[Array, "point"], mask: Bool[Array, "point"], n: Float[Array, ""]
) -> Float[Array, ""]:
    """The scale s of the likeliest trial; 0 if all residuals are."""
    top = jnp.max(r)
    ratio = 2 ** (-np.arange(SCALES + BINS + 1) / 2)
    edges = WINDOW * top * ratio
    below = total(
        (mask[None, :] & (r[None, :] <= edges[:, None])).astype(r.dtype)
    )  # points within each edge
    counts = below[:-1] - below[1:]
    widths = ratio[:-1] - ratio[1:]  # in units of the widest window
    taken = counts > 0
    entropy = jnp.where(
        taken, counts * jnp.log(jnp.where(taken, counts, 1.0) / widths), 0.0
    )
    outside = (
        jnp.cumsum(entropy) - entropy
    )  # of the bins beyond the window of each trial

    # the window of trial j holds the bins j, j + 1, ..., and one from zero to the last
    # edge
    offsets = np.arange(SCALES)[:, None] + np.arange(BINS)[None, :]
    last = below[np.arange(SCALES) + BINS]
    held = jnp.concatenate([counts[offsets], last[:, None]], axis=1)
    part = 2 ** (-np.arange(BINS + 1) / 2)  # edges in units of the window
    flat = np.append(part[:-1] - part[1:], part[-1])
    reached = erf(WINDOW * part / math.sqrt(2))
    core = jnp.append(reached[:-1] - reached[1:], reached[-1])
    within = jnp.sum(held, axis=1)
    share = jnp.full_like(within, 0.5)[:, None]

    def improved(_, share):
        p = (
            share
            * core[None, :]
            / (share * core[None, :] + (1 - share) * flat[None, :])
        )
        return (
            jnp.sum(held * p, axis=1, keepdims=True) / jnp.maximum(within, 1.0)[:, None]
        )

    share = jax.lax.fori_loop(0, 8, improved, share)
    density = (share * core[None, :] + (1 - share) * flat[None, :]) / flat[None, :]
    s_of = ratio[:SCALES]
    inner = jnp.sum(held * jnp.log(density), axis=1) + within * jnp.log(
        jnp.maximum(within, 1.0) / s_of
    )
    likelihood = outside[:SCALES] + inner + PARAMETERS * jnp.log(s_of)
    likelihood = jnp.where(share[:, 0] * within > PARAMETERS, likelihood, -jnp.inf)
    return edges[jnp.argmax(likelihood)] / WINDOW


def pooled(noises: Noise) -> Noise:
    """The noise of many pairs of one camera, (pair,), from that of each.

    Weights are the redundancies. A pair takes no part if its own estimate is farther
    from the median of all than 2.5 standard deviations, to which the pairs' own
    differences belong. `share`: of the points of all pairs, kept or not, weighted
    alike.
    """
    known = noises.known
    freedom = jnp.where(known, noises.redundancy, 0.0)
    safe = jnp.where(known, freedom, 1.0)
    own = jnp.log(jnp.where(known, noises.sigma, 1.0))
    weight = freedom / (
        freedom + PARAMETERS
    )  # a few large pairs must not outvote the others
    centre = _weighted_median(own, weight)
    apart = jnp.abs(own - centre)
    expected = jnp.sqrt(0.5 / jnp.maximum(safe, 0.5))
    # how much more the pairs differ than each of them is uncertain
    ratio = jnp.maximum(_weighted_median(apart / expected, weight) / 0.6745, 1.0)
    used = known & (apart <= APART * ratio * expected)
    squares, redundancy = sums(
        (jnp.where(used, noises.squares, 0.0), jnp.where(used, freedom, 0.0))
    )
    there = redundancy > 0
    divisor = jnp.where(there, redundancy, 1.0)
    sigma = jnp.sqrt(squares / divisor)
    # each pair's deviation, at the pooled sigma, combined by the weights of the sum
    certain = used & jnp.isfinite(noises.deviation)
    relative = jnp.where(
        certain, noises.deviation / jnp.where(known, noises.sigma, 1.0), expected
    )
    spread = jnp.sqrt(total(jnp.where(used, (freedom * relative) ** 2, 0.0))) / divisor
    return Noise(
        sigma=sigma,
        deviation=jnp.where(there, sigma * spread * ratio, jnp.inf),
        share=total(noises.share) / noises.share.shape[0],
        squares=squares,
        redundancy=redundancy,
    )


def _weighted_median(
    values: Float[Array, "pair"], weights: Float[Array, "pair"]
) -> Float[Array, ""]:
    """The smallest value up to which half of the weight lies."""
    order = jnp.argsort(values)
    reached = jnp.cumsum(weights[order])
    return values[order][jnp.argmax(reached >= 0.5 * reached[-1])]
