"""The standard deviation of measurements, estimated from residuals among which many
belong to wrong points.

The distances |r| of n points from the right pose are a mixture. Those of right points
are half-normal with a scale s; those of wrong points spread so widely that their
density is flat within a few s of zero:

    density of |r| in the window [0, W] = a 2/s phi(r/s) + (1 - a) / W,    W = 8 s.

1. The first scale (`_scale`): s is tried at all scales, in steps of sqrt(2). A trial
   takes this mixture inside its window and a histogram in log |r| outside of it; the
   largest likelihood wins. Five right points fit any pose through them, so the density
   of five points counts as 1 / max |r| (compare Moisan and Stival 2004). Nothing has to
   be known of the scale beforehand, and few right points suffice.
2. Maximum likelihood of a and s in the window by EM (Dempster, Laird and Rubin 1977): a
   point is right with the probability p = a phi / density.
3. The five elements have taken their part of the squares: Σ p r² / sigma² is chi-square
   with m = Σ p - 5 degrees of freedom, and sigma² = Σ p r² / (m (1 - 2 / 9m)³), which
   is above the truth as often as below (the median of chi-square by Wilson and Hilferty
   1931). Its standard deviation is that of a chi-square, enlarged by the information
   that is lost to not knowing which points are right (Louis 1982).

Many pairs of one camera (`pooled`): sigma² = Σ squares / Σ redundancy over all pairs
whose own estimates agree with the median of all. The estimate of a pair in the wrong
pose, or with repeated structures, does not.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float

from ..xla.passes import count, sums, total
from .masked import sum_of

PARAMETERS = 5
"""Elements of a relative orientation."""

SCALES = 50
"""Scales of step 1, in ratios of sqrt(2) from the largest |r| downwards: down to 4e-8
of it."""

WINDOW = 8.0
"""Width of the window in units of s: six steps of step 1."""

BINS = 16
"""Bins of the window in step 1; the innermost one reaches from zero to s / 23."""

SHARES = 8
"""Steps of EM for the share of right points of each trial of step 1."""

ROUNDS = 30
"""Steps of EM in step 2."""

SMALLEST, FEWEST = 1e-6, 0.01
"""Smallest scale of step 2 in units of the first one, and smallest share of right
points in the window."""

APART = 2.5
"""Standard deviations from the median of the pairs above which a pair takes no part in
the pooled estimate."""

HALF_NORMAL = math.sqrt(2 / math.pi)
"""The density of the absolute value of a normal number at zero."""

QUARTILE = 0.6745
"""The median of the absolute value of a normal number."""


class Noise(eqx.Module):
    """The noise of the measurements; for a batch every field has leading axes.

    `sigma`: in the unit of the residuals; `deviation`: its standard deviation. `share`:
    the part of the points that are right. `squares` = Σ p r² and `redundancy` = Σ p -
    5, or the sums of both over several pairs. Where the redundancy is not positive
    nothing is known: sigma is 0, and its deviation infinite.
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

    The pose is the one of least squares on the right points, or near it; the residuals
    of wrong points are those at this pose. Residuals whitened by a sigma give the ratio
    to that sigma. Works under jit and vmap. From eleven right points on it is reliable;
    of fewer among many wrong ones the scale may come from an accident.
    """
    r = jnp.sqrt(jnp.where(mask, squares, 0.0))
    n = count(mask)
    scale = _scale(r, mask)
    # in units of the first scale, so that no number of the iteration depends on the
    # unit
    u = r / jnp.where(scale > 0, scale, 1.0)
    s, share = _maximum_likelihood(u, mask)
    p, inside = _probabilities(u, mask, s, share)
    right, moment = sums((p, p * u**2))
    known = (right > PARAMETERS) & (scale > 0)
    redundancy = jnp.where(known, right - PARAMETERS, 0.0)
    freedom = jnp.where(known, redundancy, 1.0)
    squares_of_right = jnp.where(known, moment * scale**2, 0.0)
    sigma = jnp.sqrt(squares_of_right / (freedom * _chi_squared_median(freedom)))
    information = _information(u, p, inside, s, share) * freedom
    information = information / jnp.maximum(right, 1.0)
    certain = known & (information > 0)
    relative = 1 / jnp.sqrt(jnp.where(certain, information, 1.0))
    return Noise(
        sigma=sigma,
        deviation=jnp.where(certain, sigma * relative, jnp.inf),
        share=jnp.where(known, right / jnp.maximum(n, 1.0), 0.0),
        squares=squares_of_right,
        redundancy=redundancy,
    )


def _maximum_likelihood(
    u: Float[Array, "point"], mask: Bool[Array, "point"]
) -> tuple[Array, Array]:
    """s and a of step 2, in units of the first scale."""

    def improve(_, state):
        s, share = state
        p, inside = _probabilities(u, mask, s, share)
        right, within, moment = sums((p, inside, p * u**2))
        s = jnp.sqrt(moment / jnp.maximum(right, 1e-300))
        share = jnp.clip(right / jnp.maximum(within, 1.0), FEWEST, 1.0)
        return jnp.maximum(s, SMALLEST), share

    one = jnp.ones_like(u, shape=())
    return jax.lax.fori_loop(0, ROUNDS, improve, (one, 0.5 * one))


def _probabilities(u: Array, mask: Array, s: Array, share: Array) -> tuple:
    """The probability of every point that it is right, and whether it lies in the
    window (0 or 1)."""
    inside = mask & (u <= WINDOW * s)
    normal = jnp.exp(-0.5 * (u / s) ** 2)
    core = share * HALF_NORMAL * normal
    flat = (1 - share) / WINDOW
    p = jnp.where(inside, core / (core + flat), 0.0)
    return p, inside.astype(u.dtype)


def _information(u: Array, p: Array, inside: Array, s: Array, share: Array) -> Array:
    """The information on log s (Louis 1982): of points known to be right, less what is
    lost to not knowing which are right, less what the share takes."""
    z = (u / s) ** 2 - 1
    doubt = p * (1 - p)
    right, within, lost, both, doubts = sums(
        (p, inside, doubt * z**2, doubt * z, doubt)
    )
    of_share = jnp.maximum(within * share * (1 - share) - doubts, 1e-6)
    return 2 * right - lost - both**2 / of_share


def _chi_squared_median(freedom: Array) -> Array:
    """The median of chi-squared over its degrees of freedom, of which there are at
    least one half."""
    return (1 - 2 / (9 * jnp.maximum(freedom, 0.5))) ** 3


def _scale(r: Float[Array, "point"], mask: Bool[Array, "point"]) -> Float[Array, ""]:
    """The scale s of the likeliest trial; 0 if all residuals are."""
    ratio = _halvings(SCALES + BINS)
    edges = WINDOW * jnp.max(r) * ratio
    within_edge = r[None, :] <= edges[:, None]
    below = total((mask[None, :] & within_edge).astype(r.dtype))
    counts = below[:-1] - below[1:]
    outside = _outside_likelihood(counts, ratio[:-1] - ratio[1:])

    # the window of trial j holds the bins j, j + 1, ..., and one from zero to the last
    # edge
    trials = np.arange(SCALES)[:, None]
    bins = trials + np.arange(BINS)[None, :]
    innermost = below[trials + BINS]
    held = jnp.concatenate([counts[bins], innermost], axis=1)
    share, inside = _inside_likelihood(held)
    within = jnp.sum(held, axis=1)
    s_of = ratio[:SCALES]
    density = within * jnp.log(jnp.maximum(within, 1.0) / s_of)
    # five points fit any pose
    likelihood = outside + (inside + density) + PARAMETERS * jnp.log(s_of)
    enough = share * within > PARAMETERS
    best = jnp.argmax(jnp.where(enough, likelihood, -jnp.inf))
    return edges[best] / WINDOW


def _halvings(number: int) -> Float[np.ndarray, " edge"]:
    """1, 1 / sqrt(2), 1/2, ..."""
    return 2 ** (-np.arange(number + 1) / 2)


def _outside_likelihood(
    counts: Float[Array, "bin"], widths: Float[np.ndarray, " bin"]
) -> Float[Array, "trial"]:
    """The log likelihood of the histogram beyond the window of each trial."""
    taken = counts > 0
    density = jnp.where(taken, counts, 1.0) / widths
    entropy = jnp.where(taken, counts * jnp.log(density), 0.0)
    return (jnp.cumsum(entropy) - entropy)[:SCALES]


def _inside_likelihood(
    held: Float[Array, "trial bin"],
) -> tuple[Float[Array, "trial"], Float[Array, "trial"]]:
    """The share of right points in the window of each trial, and the log likelihood
    there against an even density."""
    edges = _halvings(BINS)  # in units of the window
    reached = erf(WINDOW * edges / math.sqrt(2))
    bins = lambda a: jnp.append(a[:-1] - a[1:], a[-1])[None, :]
    flat, core = bins(edges), bins(reached)
    within = jnp.maximum(jnp.sum(held, axis=1, keepdims=True), 1.0)
    density = lambda share: share * core + (1 - share) * flat

    def improve(_, share):
        p = share * core / density(share)
        right = jnp.sum(held * p, axis=1, keepdims=True)
        return right / within

    half = jnp.full_like(within, 0.5)
    share = jax.lax.fori_loop(0, SHARES, improve, half)
    ratio = density(share) / flat
    inside = jnp.sum(held * jnp.log(ratio), axis=1)
    return share[:, 0], inside


def pooled(noises: Noise) -> Noise:
    """The noise of many pairs of one camera, (pair,), from the noise of each.

    Weights are the redundancies. A pair takes no part if its own estimate is farther
    from the median of all than 2.5 standard deviations, to which the pairs' own
    differences belong. `share`: of the points of all pairs, kept or not, weighted
    alike.
    """
    known = noises.known
    freedom = jnp.where(known, noises.redundancy, 0.0)
    own = jnp.where(known, noises.sigma, 1.0)
    expected, ratio, apart = _differences(known, freedom, own)
    used = known & (apart <= APART * ratio * expected)
    squares, redundancy = sums(
        (jnp.where(used, noises.squares, 0.0), jnp.where(used, freedom, 0.0))
    )
    there = redundancy > 0
    divisor = jnp.where(there, redundancy, 1.0)
    sigma = jnp.sqrt(squares / divisor)
    # each pair's deviation, at the pooled sigma, combined by the weights of the sum
    certain = used & jnp.isfinite(noises.deviation)
    relative = jnp.where(certain, noises.deviation / own, expected)
    variance = sum_of((freedom * relative) ** 2, used)
    spread = jnp.sqrt(variance) / divisor
    return Noise(
        sigma=sigma,
        deviation=jnp.where(there, sigma * spread * ratio, jnp.inf),
        share=total(noises.share) / noises.share.shape[0],
        squares=squares,
        redundancy=redundancy,
    )


def _differences(
    known: Bool[Array, "pair"], freedom: Float[Array, "pair"], own: Float[Array, "pair"]
) -> tuple[Array, Array, Array]:
    """Of log sigma of the pairs: its expected standard deviations, how many times more
    the pairs differ (at least 1), and their distances from the median."""
    # a few large pairs must not outvote the others
    weight = freedom / (freedom + PARAMETERS)
    value = jnp.log(own)
    apart = jnp.abs(value - _weighted_median(value, weight))
    safe = jnp.where(known, freedom, 1.0)
    expected = jnp.sqrt(0.5 / jnp.maximum(safe, 0.5))
    ratio = _weighted_median(apart / expected, weight) / QUARTILE
    return expected, jnp.maximum(ratio, 1.0), apart


def _weighted_median(
    values: Float[Array, "pair"], weights: Float[Array, "pair"]
) -> Float[Array, ""]:
    """The smallest value up to which half of the weight lies."""
    order = jnp.argsort(values)
    reached = jnp.cumsum(weights[order])
    half = jnp.argmax(reached >= 0.5 * reached[-1])
    return values[order][half]
