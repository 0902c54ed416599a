"""By what the points of a pair are judged: sigma, and the limit of |w|."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, ScalarLike

from ..geometry.pairs import Pair, mask_unusable
from ..xla.passes import count
from .agreement import familywise_limit, scale_sigma, state_sigma
from .judgement import Decision, Judgement

UNKNOWN = 3000.0
"""Where nothing is said of the noise, a search begins with this part of the focal
length."""


class Level(eqx.Module):
    """By what points are judged: `sigma`, `level` and `known` of `Recommended`."""

    sigma: ScalarLike | None
    level: ScalarLike
    known: bool

    def state(self, pair: Pair) -> Pair:
        """The pair without unusable points, with this sigma."""
        return state_sigma(mask_unusable(pair)[0], self.sigma)

    def first_sigma(self, pair: Pair) -> Float[Array, ""]:
        """The factor of the standard deviations with which a search begins."""
        if self.known:
            return jnp.ones_like(pair.focal_left)
        if pair.roots is not None:
            return jnp.ones_like(pair.focal_left)
        stated = count(pair.mask & (pair.sigma != 1)) > 0
        return jnp.where(stated, 1.0, pair.focal_left / UNKNOWN)

    def judged_by(self, pair: Pair, scale: Float[Array, ""]) -> Pair:
        """The pair without unusable points, with the sigma that a decision found, of
        which nothing is differentiated."""
        fixed = lax.stop_gradient(self.state(pair))
        return scale_sigma(fixed, scale * self.first_sigma(fixed))

    def first(self, pair: Pair) -> Pair:
        """The same with the sigma with which a search begins."""
        return self.judged_by(pair, jnp.ones_like(pair.focal_left))

    def decide(self, pair: Pair, known: Judgement, decision: Decision) -> Judgement:
        """What is known of a pair with another decision about it."""
        return known.decided(self.judged_by(pair, decision.scale), decision)

    def limit(self, pair: Pair) -> Float[Array, ""]:
        """The limit of |w|."""
        return familywise_limit(self.level, pair)
