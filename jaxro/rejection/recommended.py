"""The procedure to begin with: hypotheses that are compared, and verdicts that are held
against chance.

1. `Plain`: all points, from the vertical. If they pass the global test and no |w|
   exceeds its limit, nothing is searched and nothing rejected.
2. `Quick`: graduated weights from the vertical. Believed only if the points kept pass
   the global test with the given standard deviation and are no accident.
3. `Thorough`: the best of what begins at the vertical, held against random subsets in
   any position until a better orientation would have been met.

Every orientation is compared by the same truncated cost. The points of the one that is
found are solved by least squares, and every point, in use or not, is judged anew by its
normalised residual |w| at the familywise level, in turns: a good point that a search
lost comes back. Where few points are out, the same is done point by point from all
points, which finds few and small errors best.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, ScalarLike

from ..assessment.undecided import undecided_points
from ..geometry.elements import RelativePose, vertical
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import if_needed
from ..xla.passes import count
from .agreement import familywise_limit, normalised_residuals, state_sigma
from .base import OUTCOMES, AbstractDecider, AbstractProcedure, Decision, Rejection
from .carried import witnesses
from .fading import fade
from .masked import Use, choose
from .quick import Plain, Quick
from .stages import FEW, AbstractStage, scale_sigma
from .thorough import Thorough
from .unchecked import without_unchecked
from .verdict import verdict
from .visibility import seen

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

    def limit(self, pair: Pair) -> Float[Array, ""]:
        """The limit of |w|."""
        return familywise_limit(self.level, pair)


class Stages(AbstractDecider):
    """Stages in turn, each for the pairs that the one before did not believe."""

    stages: tuple[AbstractStage, ...]
    level: Level

    def decide(self, pair: Pair) -> Decision:
        """The decision of the first stage that is believed, or else of the last."""
        pair = lax.stop_gradient(self.level.state(pair))  # it has no derivative
        pair = scale_sigma(pair, self.level.first_sigma(pair))
        limit = self.level.limit(pair)
        zero = jnp.zeros_like(limit)
        decision = Decision(
            pose=vertical(zero),
            use=pair.mask & False,
            believed=zero > 0,
            scale=zero + 1,
        )
        for stage in self.stages:
            decision = _decide_where_open(stage, pair, limit, decision)
        return decision


def _decide_where_open(
    stage: AbstractStage, pair: Pair, limit: Float[Array, ""], before: Decision
) -> Decision:
    """The decision of a stage where none was believed yet."""

    def decide(is_open: Bool[Array, ""]) -> Decision:
        own = pair.with_mask(pair.mask & is_open)
        return stage(mask_unusable(own)[0], limit)

    return if_needed(~before.believed, decide, before)


class Recommended(AbstractProcedure):
    """The stages in turn, each for the pairs that the one before did not believe; the
    outcome is `no_consensus` where the last one does not.

    Where another point could be the wrong one as well, the outcome is `undecided`: all
    these points are named and none of them is rejected; the orientation is the one
    without the point that is most likely wrong.

    `sigma`: the standard deviation of a coordinate; if None the one of the pair.
    `level`: the probability that a pair without errors loses a point. `known`: whether
    sigma is known. If not, it only says where the search begins (at the focal length /
    UNKNOWN for a pair whose sigma are all 1, as in pairs that state none), only stages
    that find the noise themselves decide, and the points are judged by the noise that
    is found: sigma0 of the orientation, as a multiple of the sigma of the pair.
    """

    sigma: ScalarLike | None = None
    level: ScalarLike = 0.0025
    stages: tuple[AbstractStage, ...] = (Plain(), Quick(), Thorough())
    known: bool = True

    def clean(self, pair: Pair) -> Rejection:
        every = Stages(self._deciding, self._level)
        return self.conclude(pair, every.decide(pair))

    def separate(self) -> list[AbstractDecider]:
        """Every stage by itself."""
        parts = [(stage,) for stage in self._deciding] or [()]
        return [Stages(part, self._level) for part in parts]

    def conclude(self, pair: Pair, decision: Decision) -> Rejection:
        """The result that follows from a decision."""
        pose, use, believed, scale = decision
        pair = self._level.state(pair)
        fixed = lax.stop_gradient(pair)
        scale = scale * self._level.first_sigma(fixed)
        fixed = scale_sigma(fixed, scale)
        limit = self._level.limit(pair)
        base = witnesses(fixed, pose, use, believed, limit)
        use = jnp.where(base.turned, base.still, use)
        pose = choose(base.turned, base.rotation, pose)
        pose, use = without_unchecked(
            fixed, pose, use, limit, base.chance, believed & base.carried
        )
        w = normalised_residuals(linearise(fixed, pose), use)
        fading = fade(scale_sigma(pair, scale), pose, use & believed)
        fading = fading._replace(noise=fading.noise * scale)
        judge = lambda solved: base.judge(fading.spread(pair, use, solved))
        result = verdict(fading.weaken(pair), pose, use, limit, w, judge)
        result = result.only_if(believed, OUTCOMES.no_consensus)
        carried = believed & ~base.turned
        return result.take_back(_in_doubt(fixed, pose, use, carried))

    @property
    def _level(self) -> Level:
        return Level(self.sigma, self.level, self.known)

    @property
    def _deciding(self) -> tuple[AbstractStage, ...]:
        """The stages that decide."""
        if self.known:
            return self.stages
        searches = (stage for stage in self.stages if isinstance(stage, Thorough))
        return tuple(dataclasses.replace(stage, known=False) for stage in searches)


def _in_doubt(
    pair: Pair, pose: RelativePose, use: Use, believed: Bool[Array, ""]
) -> Use:
    """The points of which some are wrong, though nothing tells which; only of pairs
    with few points out."""
    out = pair.mask & ~use
    asked = believed & (count(out) > 0) & (count(out) <= FEW)

    def find(asked: Bool[Array, ""]) -> Use:
        own = pair.with_mask(pair.mask & asked)
        wrong = out & asked & seen(own, pose, 0.0)
        return undecided_points(own, pose, use & asked, wrong)

    return if_needed(asked, find, jnp.zeros_like(use))
