"""Weights that fade with the distance from the pose, for the last solution of points
that a search has kept.

Least squares are best where the noise of the points kept is normal. Where it is not, or
where wrong points are to be expected among them, the weights of Geman and McClure give
a better pose. Their scale is the noise that the residuals themselves show.

Weights that were chosen by the residuals are none that were known before: sigma0 and
cofactors are those of the M-estimate that this is (`adjustment.m_estimates`).
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment import losses, m_estimates
from ..adjustment.normal_equations import dense, inverse
from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import degeneracy
from ..orientation.orient import Orientation
from ..xla.kernels import if_needed
from ..xla.passes import count
from .agreement import squares
from .masked import Use, Values, mean_of, sum_of
from .steps import geman_mcclure, normal_equations, step_by_weights

FADING = 3.0
"""Multiple of the noise at which the weight of a point has faded to a quarter."""

HEAVY = 3.0
"""Standard deviations by which the mean fourth power of residuals exceeds the one of
normal residuals if they are not normal."""

LIMIT, EXPECTED, MANY = 3.3, 3.0, 20.0
"""Wrong points are to be expected among the points in use if EXPECTED of those left out
could lie within LIMIT sigma by accident, and if MANY points are in use, from which a
noise can be estimated."""

CORE, WITHIN_CORE = 2.0, 0.774
"""Multiple of the noise within which it is estimated, and the mean square there of
normal numbers of variance 1."""

ESTIMATES, STEPS = 6, 6
"""Turns of the estimate of the noise, and steps with fading weights."""

FAINTEST = 1e-6
"""The smallest factor of a weight."""


class Fading(NamedTuple):
    """Whether the weights of a pair fade (`needed`), the `factor` of each standard
    deviation by which they do, and the `noise` on which that depends, in units of the
    given sigma."""

    needed: Bool[Array, ""]
    factor: Values
    noise: Float[Array, ""]

    def weaken(self, pair: Pair) -> Pair:
        """The pair with standard deviations that give its points these weights."""
        return dataclasses.replace(pair, sigma=pair.sigma * self.factor)

    def spread(self, pair: Pair, use: Use, solved: Orientation) -> Orientation:
        """The orientation that was solved with these weights, with sigma0 and the
        cofactors of an M-estimate; `pair` with the sigma that is known."""

        def estimate(needed: Bool[Array, ""]) -> m_estimates.Spread:
            fixed, pose = lax.stop_gradient((pair, solved.pose))
            r = jnp.sqrt(squares(fixed, pose))
            loss = losses.GemanMcClure(scale=FADING * self.noise)
            used = (use & needed).astype(r.dtype)
            return m_estimates.spread(loss, r, used, 5)

        one = jnp.ones_like(self.noise)
        found = if_needed(self.needed, estimate, m_estimates.Spread(one, one))
        ratio = jnp.where(self.needed, found.sigma0 / solved.sigma0, 1.0)
        plain = self._plain_cofactor(pair, use, solved.pose)

        def of_errors(needed: Bool[Array, ""]) -> Float[Array, "5 5"]:
            used = mask_unusable(pair.with_mask(use & needed))[0]
            fixed = lax.stop_gradient((used, solved.pose, plain, found.sigma0))
            return degeneracy.worst_direction(*fixed).cofactor - fixed[2]

        more = if_needed(self.needed, of_errors, jnp.zeros_like(plain))
        return dataclasses.replace(
            solved,
            # the value of the M-estimate, the derivative of the last solution
            sigma0=solved.sigma0 * lax.stop_gradient(ratio),
            cofactor=jnp.where(
                self.needed, found.factor * (plain + more), solved.cofactor
            ),
        )

    def _plain_cofactor(
        self, pair: Pair, use: Use, pose: RelativePose
    ) -> Float[Array, "5 5"]:
        """The cofactors of the points in use with their full weights; where they are
        not needed those of a regular matrix, whose derivatives are finite."""
        linear = linearise(pair, pose)
        weight = jnp.where(use & self.needed, linear.weight, 0.0)
        n, _ = normal_equations(linear, weight)
        missing = jnp.where(self.needed, 0.0, 1.0)
        for i, row in enumerate(n):
            row[i] = row[i] + missing
        return dense(inverse(n)[0])


def fade(pair: Pair, pose: RelativePose, use: Use) -> Fading:
    """`Fading` of the points in use, where it is needed (`is_heavy`); else all factors
    are 1. `pose`: of the points in use."""
    fixed = lax.stop_gradient(pair)
    needed = is_heavy(fixed, pose, use)
    factors = lambda needed: _factors(fixed, pose, use & needed)
    one = jnp.ones_like(pair.focal_left)
    factor, noise = if_needed(needed, factors, (jnp.ones_like(pair.sigma), one))
    return Fading(needed, factor, noise)


def fade_again(pair: Pair, pose: RelativePose) -> Pair:
    """A pair that was solved with weights that faded, at its pose, with the standard
    deviations that give its points these weights."""
    factor, _ = _factors(pair, pose, pair.mask)
    return dataclasses.replace(pair, sigma=pair.sigma * factor)


def is_heavy(pair: Pair, pose: RelativePose, use: Use) -> Bool[Array, ""]:
    """Whether the mean fourth power of the residuals exceeds the one of normal
    residuals by more than chance, or the points left out are so many and so near that
    some wrong points agree by accident."""
    s, k = squares(pair, pose), jnp.maximum(count(use), 1.0)
    out = pair.mask & ~use
    mean = mean_of(s, use)
    fourth = mean_of(s * s, use)
    chance_of_normal = HEAVY * jnp.sqrt(24 / k)
    long_tailed = fourth > mean**2 * (3 + chance_of_normal)
    distance = jnp.maximum(jnp.sqrt(s), LIMIT)
    expected = sum_of(LIMIT / distance, out)
    some_wrong = (expected > EXPECTED) & (k >= MANY)
    return long_tailed | some_wrong


def _factors(
    pair: Pair, pose: RelativePose, use: Use
) -> tuple[Values, Float[Array, ""]]:
    """The factors of the standard deviations that make the weights fade, and the
    noise."""
    s = squares(pair, pose)
    narrow = lambda _, variance: _core_variance(s, use, variance)
    noise = lax.fori_loop(0, ESTIMATES, narrow, mean_of(s, use))
    variance = FADING**2 * noise

    def weight(s: Values) -> Values:
        return jnp.where(use, geman_mcclure(s, variance), 0.0)

    step = lambda _, pose: step_by_weights(pair, pose, weight)
    pose = lax.fori_loop(0, STEPS, step, pose)
    faint = jnp.maximum(weight(squares(pair, pose)), FAINTEST)
    return jnp.where(use, jnp.sqrt(1 / faint), 1.0), jnp.sqrt(noise)


def _core_variance(s: Values, use: Use, variance: Float[Array, ""]) -> Float[Array, ""]:
    """The variance of normal noise from the points within CORE standard deviations of a
    first value for it."""
    near = use & (s <= CORE**2 * variance)
    return mean_of(s, near) / WITHIN_CORE
