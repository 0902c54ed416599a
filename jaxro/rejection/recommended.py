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

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..assessment.undecided import undecided_points
from ..geometry.elements import RelativePose, vertical
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import if_needed
from ..xla.passes import count
from .agreement import familywise_limit, normalised_residuals, state_sigma
from .base import OUTCOMES, AbstractProcedure, Rejection
from .fading import fade
from .masked import Use
from .quick import Plain, Quick
from .stages import FEW, AbstractStage, Decision, scale_sigma
from .thorough import Thorough
from .verdict import verdict
from .visibility import seen

UNKNOWN = 3000.0
"""Where nothing is said of the noise, a search begins with this part of the focal
length."""


class Recommended(AbstractProcedure):
    """The stages in turn, each for the pairs that the one before did not believe; the
    outcome is `no_consensus` where the last one does not.

    Where another point could be the wrong one as well, the outcome is `undecided`: all
    these points are named and none of them is rejected; the orientation is the one
    without the point that is most likely wrong.

    `sigma`: the standard deviation of a coordinate; if None the one of the pair.
    `level`: the probability that a pair without errors loses a point. `known`: whether
    sigma is known. If not, it only says where the search begins (at the focal length /
    UNKNOWN for a pair whose sigma are all 1, as in pairs that state none), and the
    points are judged by the noise that is found: sigma0 of the orientation, as a
    multiple of the sigma of the pair.
    """

    sigma: float | None = None
    level: float = 0.0025
    stages: tuple[AbstractStage, ...] = (Plain(), Quick(), Thorough())
    known: bool = True

    def clean(self, pair: Pair) -> Rejection:
        pair = state_sigma(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        begin = jnp.ones_like(pair.focal_left) if self.known else _first_sigma(fixed)
        fixed = scale_sigma(fixed, begin)
        limit = familywise_limit(self.level, pair)
        pose, use, believed, scale = self._decide(fixed, limit)
        fixed = scale_sigma(fixed, scale)
        w = normalised_residuals(linearise(fixed, pose), use)
        judged = scale_sigma(pair, begin * scale)
        weighted = fade(judged, pose, use & believed)
        weighted = scale_sigma(weighted, 1 / (begin * scale))
        result = verdict(weighted, pose, use, limit, w)
        result = result.only_if(believed, OUTCOMES.no_consensus)
        return result.take_back(_in_doubt(fixed, pose, use, believed))

    def _decide(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        """The decision of the first stage that is believed, or else of the last."""
        zero = jnp.zeros_like(limit)
        decision = Decision(
            pose=vertical(zero),
            use=pair.mask & False,
            believed=zero > 0,
            scale=zero + 1,
        )
        for stage in self.deciding:
            decision = _decide_where_open(stage, pair, limit, decision)
        return decision

    @property
    def deciding(self) -> tuple[AbstractStage, ...]:
        """The stages that decide: where sigma is not known only those that find the
        noise themselves."""
        if self.known:
            return self.stages
        return tuple(
            dataclasses.replace(stage, known=False)
            for stage in self.stages
            if isinstance(stage, Thorough)
        )

    def separate(self, points: int) -> list[AbstractProcedure]:
        """Two procedures for batches: the first stages, which are quick for any number
        of pairs at once, and the search for the pairs that these left open."""
        if not self.known:
            return [self]
        parts = self.stages[:2], self.stages[2:]
        return [dataclasses.replace(self, stages=stages) for stages in parts if stages]


def _decide_where_open(
    stage: AbstractStage, pair: Pair, limit: Float[Array, ""], before: Decision
) -> Decision:
    """The decision of a stage where none was believed yet."""

    def decide(is_open: Bool[Array, ""]) -> Decision:
        own = pair.with_mask(pair.mask & is_open)
        return stage(mask_unusable(own)[0], limit)

    return if_needed(~before.believed, decide, before)


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


def _first_sigma(pair: Pair) -> Float[Array, ""]:
    """The factor of the standard deviations with which a search begins that does not
    know them; 1 for a pair that states any."""
    stated = count(pair.mask & (pair.sigma != 1)) > 0
    return jnp.where(stated, 1.0, pair.focal_left / UNKNOWN)
