"""Standard deviation of unit weight, and covariance of the parameters, of an adjustment
with a robust loss.

The loss acts on whitened residuals r of n conditions with p parameters; psi(r) = r
rho'(r²) is its influence function.

* sigma0 is consistent for normal errors: it is the tau with

      Σ rho(r²) / (n - p) = E rho(tau² z²),    z normal,

  which is sqrt(Σ r² / (n - p)) for rho(s) = s. If the left side exceeds all values of
  the right side, as it may for a bounded loss, tau is the largest that is searched.
* The covariance is C = v (AᵀA)⁻¹, A the whitened columns without the weights of the
  loss. One estimate of v comes from the residuals (Huber 1981, eq. 6.1 of chapter 7,
  with one factor K in place of two, which fits a dozen points better),

      v1 = K [Σ psi² / (n - p)] / mean(psi')²,    K = 1 + p/n var(psi') / mean(psi')²,

  another one from normal errors of the standard deviation sigma0,

      v2 = E psi² / (E psi')².

  v1 stays right with wrong points. But few points determine mean(psi') badly; and where
  psi' is negative the minimum is one of several, chosen with a large mean(psi'). With c
  the share of the negative part in Σ |psi'| and a = 1 / (K + 25 c)

      v = v1^a v2^(1-a),

  so that v is near v1 for many points and convex losses, and near v2 for few points and
  redescending losses. The exponent was found by simulation of 16 and 50 points;
  tests/adjustment/test_losses.py has the coverage.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..xla.passes import total
from .bisection import bisect
from .losses import AbstractLoss

Scalar = Float[Array, ""]

NEGATIVE = 25.0
"""Weight of the share of negative psi' in the exponent."""

LARGEST = 7.0
"""log(sigma0 / sqrt(Σ rho / (n - p))) up to which sigma0 is searched: a factor of a
thousand."""

HALVINGS = 48

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)
Z = 4.5 * (1 + _NODES)
"""Abscissae of an integral over z > 0 of the normal density."""
DENSITY = 9.0 * _WEIGHTS * np.exp(-(Z**2) / 2) / np.sqrt(2 * np.pi)
"""Their weights; both signs of z together."""


class Spread(NamedTuple):
    """`sigma0`, and the `factor` v / sigma0² of (AᵀA)⁻¹ that gives the cofactors of the
    parameters."""

    sigma0: Scalar
    factor: Scalar


def spread(
    loss: AbstractLoss,
    r: Float[Array, " entry"],
    use: Float[Array, " entry"],
    p: int | Float[Array, ""],
) -> Spread:
    """`Spread` of residuals r whitened without the loss, by p parameters; `use` is 1 for
    those that count and 0 for others.

    Both numbers are finite, but mean nothing, without redundancy.
    """
    n = total(use)
    freedom = jnp.maximum(n - p, 1.0)
    sigma0 = scale(loss, total(use * loss.rho(r * r)) / freedom)

    psi, slope = influence(loss, r)
    mean = total(use * slope) / n
    variance = total(use * (slope - mean) ** 2) / n
    square = jnp.maximum(mean * mean, jnp.finfo(r.dtype).eps)
    k = 1 + p / n * variance / square
    observed = k * total(use * psi * psi) / freedom / square

    size = total(use * jnp.abs(slope))
    negative = total(use * jnp.maximum(-slope, 0.0)) / size
    part = 1 / (k + NEGATIVE * negative)
    tiny = jnp.finfo(r.dtype).tiny ** 0.5
    logarithm = lambda v: jnp.log(jnp.maximum(v, tiny))
    both = part * logarithm(observed) + (1 - part) * logarithm(_normal(loss, sigma0))
    return Spread(sigma0, jnp.exp(both) / jnp.maximum(sigma0 * sigma0, tiny))


def influence(loss: AbstractLoss, r: Array) -> tuple[Array, Array]:
    """psi(r) = r rho'(r²) and its derivative."""
    return jax.jvp(lambda r: r * loss.weight(r * r), (r,), (jnp.ones_like(r),))


def scale(loss: AbstractLoss, mean: Scalar) -> Scalar:
    """tau with E rho(tau² z²) = mean; its derivatives are those of the implicit
    function."""
    tiny = jnp.finfo(mean.dtype).tiny ** 0.5
    least = 0.5 * jnp.log(jnp.maximum(mean, tiny))  # rho(s) <= s

    def expected_rho(log_tau):
        z = jnp.exp(log_tau) * jnp.asarray(Z, mean.dtype)
        return expectation(loss.rho(z * z))

    there = mean < expected_rho(least + LARGEST)
    mean = jnp.where(there, mean, expected_rho(lax.stop_gradient(least)))
    logarithm = lambda x: jnp.log(jnp.maximum(x, tiny))
    excess = lambda log_tau: logarithm(expected_rho(log_tau)) - logarithm(mean)
    solve = lambda excess, low: bisect(
        lambda x: ~(excess(x) < 0), low, low + LARGEST, HALVINGS
    )
    solve_tangent = lambda slope, y: y / slope(jnp.ones_like(y))
    root = lax.custom_root(excess, lax.stop_gradient(least), solve, solve_tangent)
    return jnp.exp(jnp.where(there, root, least + LARGEST))


def expectation(values: Array) -> Scalar:
    """E of an even function of a normal z from its values at `Z`."""
    return total(values * jnp.asarray(DENSITY, values.dtype))


def _normal(loss: AbstractLoss, sigma0: Scalar) -> Scalar:
    """v2; E psi'(tau z) = E z psi(tau z) / tau is positive for every loss."""
    z = sigma0 * jnp.asarray(Z, sigma0.dtype)
    weight = loss.weight(z * z)
    slope = expectation(weight * jnp.asarray(Z**2, sigma0.dtype))
    return expectation((weight * z) ** 2) / slope**2
