"""Standard deviation of unit weight, and spread of the parameters, of an adjustment
with a robust loss.

The loss acts on whitened residuals r of n conditions with p parameters; psi(r) = r
rho'(r²) is its influence function.

* sigma0 is consistent for normal errors: the tau with

      Σ rho(r²) / (n - p) = E rho(tau² z²),    z normal,

  which is sqrt(Σ r² / (n - p)) for rho(s) = s. A bounded loss whose left side exceeds
  all values of the right one gets the largest tau that is looked for.
* The covariance is C = v (AᵀA)⁻¹, A the whitened columns without the weights of the
  loss. As observed (Huber 1981, eq. 6.1 of chapter 7, with one factor K, which fits a
  dozen points better than two),

      v1 = K [Σ psi² / (n - p)] / mean(psi')²,    K = 1 + p/n var(psi') / mean(psi')²,

  and as expected of normal errors of the standard deviation sigma0,

      v2 = E psi² / (E psi')².

  v1 stays right with wrong points. But few points know mean(psi') badly, and where psi'
  is negative the minimum is one of several, chosen with a large mean(psi'). With c the
  share of the negative part in Σ |psi'| and a = 1 / (K + 25 c)

      v = v1^a v2^(1-a),

  so that many points and convex losses have v1, few points and redescending losses v2.
  The exponent was found by simulation of 16 and 50 points; tests/test_losses.py has the
  coverage.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..xla.passes import total
from .losses import AbstractLoss

Scalar = Float[Array, ""]

NEGATIVE = 25.0
"""Weight of the share of negative psi' in the exponent."""

LARGEST = 7.0
"""log(sigma0 / sqrt(Σ rho / (n - p))) up to which sigma0 is looked for: a factor of a
thousand."""

HALVINGS = 48

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)
Z = 4.5 * (1 + _NODES)
"""Abscissae of an integral over z > 0 of the normal density."""
DENSITY = 9.0 * _WEIGHTS * np.exp(-(Z**2) / 2) / np.sqrt(2 * np.pi)
"""Their weights; both signs of z together."""


class Spread(NamedTuple):
    """sigma0, and v / sigma0²: the factor of (AᵀA)⁻¹ that gives the cofactors of the
    parameters."""

    sigma0: Scalar
    factor: Scalar


def influence(loss: AbstractLoss, r: Array) -> tuple[Array, Array]:
    """psi(r) = r rho'(r²) and its derivative."""
    return jax.jvp(lambda r: r * loss.weight(r * r), (r,), (jnp.ones_like(r),))


def expected(values: Array) -> Scalar:
    """E of an even function of a normal z from its values at `Z`."""
    return total(values * jnp.asarray(DENSITY, values.dtype))


def spread(
    loss: AbstractLoss, r: Float[Array, " entry"], use: Float[Array, " entry"], p: int
) -> Spread:
    """`Spread` of residuals whitened without the loss, `use` 1 for those that count and
    0 for others.

    Both numbers are finite, but mean nothing, without redundancy.
    """
    n = total(use)
    freedom = jnp.maximum(n - p, 1.0)
    psi, slope = influence(loss, r)
    sigma0 = scale(loss, total(use * loss.rho(r * r)) / freedom)
    mean = total(use * slope) / n
    variance = total(use * (slope - mean) ** 2) / n
    square = jnp.maximum(mean * mean, jnp.finfo(r.dtype).eps)
    k = 1 + p / n * variance / square
    negative = total(use * jnp.maximum(-slope, 0.0)) / total(use * jnp.abs(slope))
    observed = k * total(use * psi * psi) / freedom / square
    z = sigma0 * jnp.asarray(Z, r.dtype)
    weight = loss.weight(z * z)
    # E psi'(tau z) = E z psi(tau z) / tau, positive for every loss
    normal = (
        expected((weight * z) ** 2) / expected(weight * jnp.asarray(Z**2, r.dtype)) ** 2
    )
    part = 1 / (k + NEGATIVE * negative)
    tiny = jnp.finfo(r.dtype).tiny ** 0.5
    v = jnp.exp(
        part * jnp.log(jnp.maximum(observed, tiny))
        + (1 - part) * jnp.log(jnp.maximum(normal, tiny))
    )
    return Spread(sigma0, v / jnp.maximum(sigma0 * sigma0, tiny))


def scale(loss: AbstractLoss, mean: Scalar) -> Scalar:
    """tau with E rho(tau² z²) = mean; its derivatives are those of the implicit
    function."""
    tiny = jnp.finfo(mean.dtype).tiny ** 0.5
    least = 0.5 * jnp.log(jnp.maximum(mean, tiny))  # rho(s) <= s

    def of(log_tau):
        z = jnp.exp(log_tau) * jnp.asarray(Z, mean.dtype)
        return expected(loss.rho(z * z))

    there = mean < of(least + LARGEST)
    mean = jnp.where(there, mean, of(lax.stop_gradient(least)))

    def excess(log_tau):
        return jnp.log(jnp.maximum(of(log_tau), tiny)) - jnp.log(
            jnp.maximum(mean, tiny)
        )

    def bisected(excess, low):
        def halved(_, interval):
            low, high = interval
            middle = (low + high) / 2
            below = excess(middle) < 0
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        low, high = lax.fori_loop(0, HALVINGS, halved, (low, low + LARGEST))
        return (low + high) / 2

    guess = lax.stop_gradient(least)
    root = lax.custom_root(
        excess, guess, bisected, lambda slope, y: y / slope(jnp.ones_like(y))
    )
    return jnp.exp(jnp.where(there, root, least + LARGEST))
