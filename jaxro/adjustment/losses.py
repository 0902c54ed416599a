"""Robust losses rho(s) of the squared whitened residual s = r², each with rho(s) = s +
O(s²) at zero.

A loss enters the adjustment as the transformed residual r sqrt(rho(r²)/r²), whose
squares add up to the robust objective: optimum and implicit derivative are then both
exact. The package's own solver reaches that optimum by steps with the weights rho'(r²)
instead. `scale` is in units of the whitened residual, that is multiples of sigma, or mm
where sigma is 1.

Weights that belong to no loss in use serve the reweighting of `rejection.Reweighting`
alone.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Values = Float[Array, "..."]


class AbstractWeight(eqx.Module):
    """The factor by which reweighted least squares multiplies the weight of an
    observation."""

    @abc.abstractmethod
    def weight(self, s: Values) -> Values:
        """The factor, 1 at zero, of squared whitened residuals."""


class AbstractLoss(AbstractWeight):
    """rho(s), and from it the weight rho'(s) of iteratively reweighted least
    squares."""

    scale: eqx.AbstractVar[float]

    @abc.abstractmethod
    def rho(self, s: Values) -> Values:
        """The loss of squared residuals."""

    def weight(self, s: Values) -> Values:
        """rho'(s), by autodiff."""
        return jax.jvp(self.rho, (s,), (jnp.ones_like(s),))[1]

    def transformed(self, r: Values) -> Values:
        """r sqrt(rho(r²)/r²), smooth through zero."""
        s = r * r
        tiny = s < 1e-16 * self.scale**2
        safe = jnp.where(tiny, self.scale**2, s)
        return r * jnp.where(tiny, 1.0, jnp.sqrt(self.rho(safe) / safe))


class Huber(AbstractLoss):
    """s inside the scale, 2 k sqrt(s) - k² outside (Huber 1964)."""

    scale: float = 1.345

    def rho(self, s):
        k2 = self.scale**2
        outside = s > k2
        return jnp.where(
            outside, 2 * self.scale * jnp.sqrt(jnp.where(outside, s, 1.0)) - k2, s
        )


class SoftL1(AbstractLoss):
    """2 k² (sqrt(1 + s/k²) - 1)"""

    scale: float = 1.0

    def rho(self, s):
        # without a difference of nearly equal numbers
        return 2 * s / (1 + jnp.sqrt(1 + s / self.scale**2))


class Cauchy(AbstractLoss):
    """k² log(1 + s/k²)"""

    scale: float = 2.385

    def rho(self, s):
        return self.scale**2 * jnp.log1p(s / self.scale**2)


class GemanMcClure(AbstractLoss):
    """s / (1 + s/k²), bounded by k²"""

    scale: float = 2.0

    def rho(self, s):
        return s / (1 + s / self.scale**2)


class Tukey(AbstractLoss):
    """k²/3 (1 - (1 - s/k²)³) inside the scale, k²/3 outside (biweight)."""

    scale: float = 4.685

    def rho(self, s):
        t = jnp.minimum(s / self.scale**2, 1.0)
        return self.scale**2 * t * (1 - t + t * t / 3)


class LeastAbsolute(AbstractWeight):
    """k / sqrt(s) outside the scale k, 1 inside: Σ |r| = min, with a small k against
    infinite weights."""

    scale: float = 0.1

    def weight(self, s):
        return self.scale / jnp.sqrt(jnp.maximum(s, self.scale**2))


class Danish(AbstractWeight):
    """1 inside the scale k, exp(-factor (sqrt(s)/k)^power) outside (Krarup, Juhl and
    Kubik 1980; k = 2 or 3)."""

    scale: float = 2.0
    factor: float = 0.05
    power: float = 3.0

    def weight(self, s):
        return jnp.where(
            s > self.scale**2,
            jnp.exp(-self.factor * (s / self.scale**2) ** (self.power / 2)),
            1.0,
        )


class IggThree(AbstractWeight):
    """1 inside k0, (k0/|r|) ((k1 - |r|) / (k1 - k0))² up to k1, zero beyond (IGG III,
    Yang 1994)."""

    scale: float = 1.5
    last: float = 4.5

    def weight(self, s):
        r = jnp.sqrt(jnp.maximum(s, self.scale**2))
        return (
            self.scale
            / r
            * (jnp.maximum(self.last - r, 0.0) / (self.last - self.scale)) ** 2
        )
