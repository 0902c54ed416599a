"""Robust losses rho(s) of the squared whitened residual s = r², and weights of
iteratively reweighted least squares.

An adjustment with a loss minimises Σ rho(r²). Each rho(s) is s + O(s²) at zero, so that
small residuals count as in least squares. `scale` is in units of the whitened residual:
multiples of sigma, or the unit of the coordinates if sigma is 1.

A loss of your own subclasses `AbstractLoss` and defines `rho`; its weights and the
transformed residuals follow from it. `AbstractWeight` is for weights that are the
derivative of no loss in use; `rejection.Reweighting` takes these as well.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

Values = Float[Array, "..."]


class AbstractWeight(eqx.Module):
    """A factor of the weight of an observation in iteratively reweighted least
    squares."""

    @abc.abstractmethod
    def weight(self, s: Values) -> Values:
        """The factor for squared whitened residuals s; 1 at zero."""


class AbstractLoss(AbstractWeight):
    """A loss rho(s); its weight is rho'(s)."""

    scale: eqx.AbstractVar[float]

    @abc.abstractmethod
    def rho(self, s: Values) -> Values:
        """The loss of squared whitened residuals."""

    def weight(self, s: Values) -> Values:
        """rho'(s), by autodiff."""
        return jax.jvp(self.rho, (s,), (jnp.ones_like(s),))[1]

    def transform(self, r: Values) -> Values:
        """r sqrt(rho(r²) / r²), smooth through zero.

        The squares of these residuals add up to the robust objective, so that a
        least-squares solver finds its optimum and implicit derivatives are exact.
        """
        s = r * r
        tiny = s < 1e-16 * self.scale**2
        safe = jnp.where(tiny, self.scale**2, s)
        factor = jnp.sqrt(self.rho(safe) / safe)
        return r * jnp.where(tiny, 1.0, factor)


class Huber(AbstractLoss):
    """s inside the scale, 2 k sqrt(s) - k² outside (Huber 1964)."""

    scale: ScalarLike = 1.345

    def rho(self, s):
        k2 = self.scale**2
        outside = s > k2
        root = jnp.sqrt(jnp.where(outside, s, 1.0))
        return jnp.where(outside, 2 * self.scale * root - k2, s)


class SoftL1(AbstractLoss):
    """2 k² (sqrt(1 + s/k²) - 1)"""

    scale: ScalarLike = 1.0

    def rho(self, s):
        # the same without a difference of nearly equal numbers
        root = jnp.sqrt(1 + s / self.scale**2)
        return 2 * s / (1 + root)


class Cauchy(AbstractLoss):
    """k² log(1 + s/k²)"""

    scale: ScalarLike = 2.385

    def rho(self, s):
        return self.scale**2 * jnp.log1p(s / self.scale**2)


class GemanMcClure(AbstractLoss):
    """s / (1 + s/k²), bounded by k²"""

    scale: ScalarLike = 2.0

    def rho(self, s):
        return s / (1 + s / self.scale**2)


class Tukey(AbstractLoss):
    """k²/3 (1 - (1 - s/k²)³) inside the scale, k²/3 outside (biweight)."""

    scale: ScalarLike = 4.685

    def rho(self, s):
        t = jnp.minimum(s / self.scale**2, 1.0)
        return self.scale**2 * t * (1 - t + t * t / 3)


class LeastAbsolute(AbstractWeight):
    """k / sqrt(s) outside the scale k, 1 inside. It minimises Σ |r|; a small k avoids
    infinite weights."""

    scale: ScalarLike = 0.1

    def weight(self, s):
        return self.scale / jnp.sqrt(jnp.maximum(s, self.scale**2))


class Danish(AbstractWeight):
    """1 inside the scale k, exp(-factor (sqrt(s)/k)^power) outside (Krarup, Juhl and
    Kubik 1980, with k of 2 or 3)."""

    scale: ScalarLike = 2.0
    factor: ScalarLike = 0.05
    power: ScalarLike = 3.0

    def weight(self, s):
        k2 = self.scale**2
        outside = jnp.exp(-((s / k2) ** (self.power / 2) * self.factor))
        return jnp.where(s > k2, outside, 1.0)


class IggThree(AbstractWeight):
    """1 inside k0, (k0/|r|) ((k1 - |r|) / (k1 - k0))² up to k1, zero beyond (IGG III,
    Yang 1994)."""

    scale: ScalarLike = 1.5
    last: ScalarLike = 4.5

    def weight(self, s):
        r = jnp.sqrt(jnp.maximum(s, self.scale**2))
        left = jnp.maximum(self.last - r, 0.0)
        width = jnp.subtract(self.last, self.scale)
        return self.scale / r * (left / width) ** 2
