"""Weights that fade with the distance from the pose, for the last solution of points
that a search has kept.

Least squares are best where the noise of the points kept is normal. Where it is not, or
where wrong points are to be expected among them, the weights of Geman and McClure give
a better pose. Their scale is the noise that the residuals themselves show.
"""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.kernels import if_needed
from ..xla.passes import count
from .agreement import squares
from .masked import Use, Values, mean_of, sum_of
from .steps import geman_mcclure, step_by_weights

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


def fade(pair: Pair, pose: RelativePose, use: Use) -> Pair:
    """The pair with standard deviations that give its points fading weights, if they
    are needed (`_is_heavy`); else the pair as it is. `pose`: of the points in use."""
    fixed = lax.stop_gradient(pair)
    heavy = _is_heavy(fixed, squares(fixed, pose), use)
    factors = lambda needed: _factors(fixed, pose, use & needed)
    factor = if_needed(heavy, factors, jnp.ones_like(pair.sigma))
    return dataclasses.replace(pair, sigma=pair.sigma * factor)


def _is_heavy(pair: Pair, s: Values, use: Use) -> Bool[Array, ""]:
    """Whether the mean fourth power of the residuals exceeds the one of normal
    residuals by more than chance, or the points left out are so many and so near that
    some wrong points agree by accident."""
    k = jnp.maximum(count(use), 1.0)
    out = pair.mask & ~use
    mean = mean_of(s, use)
    fourth = mean_of(s * s, use)
    chance_of_normal = HEAVY * jnp.sqrt(24 / k)
    long_tailed = fourth > mean**2 * (3 + chance_of_normal)
    distance = jnp.maximum(jnp.sqrt(s), LIMIT)
    expected = sum_of(LIMIT / distance, out)
    some_wrong = (expected > EXPECTED) & (k >= MANY)
    return long_tailed | some_wrong


def _factors(pair: Pair, pose: RelativePose, use: Use) -> Values:
    """The factors of the standard deviations that make the weights fade."""
    s = squares(pair, pose)
    narrow = lambda _, variance: _core_variance(s, use, variance)
    noise = lax.fori_loop(0, ESTIMATES, narrow, mean_of(s, use))
    variance = FADING**2 * noise

    def weight(s: Values) -> Values:
        return jnp.where(use, geman_mcclure(s, variance), 0.0)

    step = lambda _, pose: step_by_weights(pair, pose, weight)
    pose = lax.fori_loop(0, STEPS, step, pose)
    faint = jnp.maximum(weight(squares(pair, pose)), FAINTEST)
    return jnp.where(use, jnp.sqrt(1 / faint), 1.0)


def _core_variance(s: Values, use: Use, variance: Float[Array, ""]) -> Float[Array, ""]:
    """The variance of normal noise from the points within CORE standard deviations of a
    first value for it."""
    near = use & (s <= CORE**2 * variance)
    return mean_of(s, near) / WITHIN_CORE
