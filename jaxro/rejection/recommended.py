"""The procedure to begin with: hypotheses that are compared, and verdicts that are held
against chance.

1. `Plain`: all points, from the vertical. If they pass the global test and no |w|
   exceeds its limit, nothing is searched and nothing rejected.
2. `Quick`: graduated weights from the vertical. Believed only if the points kept pass
   the global test with the given standard deviation and are no accident.
3. `Thorough`: the best of what begins at the vertical, held against random subsets in
   any position until a better orientation would have been met.

Every orientation is compared by the same truncated cost. What is found is solved by
least squares, and every point, in use or not, judged anew by its normalised residual
|w| at the familywise level, in turns: a good point that a search lost comes back. Where
few points are out, the same is done point by point from all points, by which few and
small errors are found best.
"""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment import critical_values
from ..assessment.undecided import undecided
from ..geometry.elements import RelativePose, vertical
from ..geometry.linear import linearised
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import if_needed
from ..xla.passes import count, total
from . import evidence
from .base import OUTCOMES, AbstractProcedure, Rejection
from .fading import faded
from .graduated_non_convexity import GraduatedNonConvexity
from .robust import judged, normalised, scaled, seen
from .search import forward
from .stages import (
    DEVIATIONS,
    FEW,
    AbstractStage,
    Decision,
    Use,
    believed_if_it_fits,
    from_vertical,
    on_a_plane,
    rescaled,
    settled,
)
from .thorough import Thorough

UNKNOWN = 3000.0
"""Where nothing is said of the noise, a search begins with this part of the focal
length."""

LEAST = 0.4
"""Share of the points below which a set of them is not believed without a search."""


class Plain(AbstractStage):
    """All points, in `steps` of least squares from the vertical. Believed if they pass
    the global test, and every |w| its limit."""

    steps: int = 5

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        pose = from_vertical(pair, self.steps)
        return Decision(
            pose, pair.mask, _untouched(pair, pose, limit), jnp.ones_like(limit)
        )


class Quick(AbstractStage):
    """The graduated search. Believed if at least `share` of the points are kept, or
    `many`, these pass the global test, and sets as good are not expected by accident
    more than `accidents` times. A small part of a regular field of targets may fit a
    wrong pose. A plane has two poses, and a base that points into a photo several
    minima, which `Thorough` compares."""

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    share: float = 0.6
    many: int = 60
    accidents: float = 1e-4

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        decision = settled(pair, self.graduated.search(pair), limit)
        decision = believed_if_it_fits(pair, *decision, limit, LEAST, self.accidents)
        kept = count(decision.use)
        enough = (kept >= self.share * count(pair.mask)) | (kept >= self.many)
        _, _, alone = on_a_plane(pair, decision.pose, decision.use, limit)
        return decision._replace(
            believed=decision.believed & enough & ~alone & ~forward(decision.pose)
        )


class Recommended(AbstractProcedure):
    """The stages in turn, each where the one before was not believed; `no_consensus`
    where the last is not.

    Where another point could be the wrong one as well, the outcome is `undecided`: all
    these points are named and none of them rejected; the orientation is that without
    the one that is most likely wrong.

    `sigma`: the standard deviation of a coordinate; if None that of the pair. `level`:
    the probability that a pair without errors loses a point. `known`: whether sigma is
    known. If not, it is only where the search begins (the focal length / UNKNOWN for a
    pair whose sigma are all 1, as those that state none), and the points are judged by
    the noise that is found: sigma0 of the orientation, as a multiple of the sigma of
    the pair.
    """

    sigma: float | None = None
    level: float = 0.0025
    stages: tuple[AbstractStage, ...] = (Plain(), Quick(), Thorough())
    known: bool = True

    def __call__(self, pair: Pair) -> Rejection:
        pair = scaled(mask_unusable(pair)[0], self.sigma)
        fixed = lax.stop_gradient(pair)  # a decision has no derivative
        begin = jnp.ones_like(pair.focal_left) if self.known else _unit(fixed)
        fixed = rescaled(fixed, begin)
        limit = critical_values.by_count(
            lambda n: critical_values.normal(self.level / jnp.maximum(n, 1.0)),
            pair.x_left.shape[0],
            count(pair.mask),
        )
        zero = jnp.zeros_like(limit)
        decision = Decision(vertical(zero), fixed.mask & False, zero > 0, zero + 1)
        for stage in self.deciding:
            decision = _where_open(stage, fixed, limit, decision)
        pose, use, believed, scale = decision
        fixed = rescaled(fixed, scale)
        w = normalised(linearised(fixed, pose), use)
        weighted = faded(rescaled(pair, begin * scale), pose, use & believed)
        weighted = rescaled(weighted, 1 / (begin * scale))
        rejection = judged(weighted, pose, use, limit, w).only_if(
            believed, OUTCOMES.no_consensus
        )
        return rejection.taking_back(_in_doubt(fixed, pose, use, believed))

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

    def separate(self, points: int) -> list["Recommended"]:
        """Two procedures for batches: the first stages, which are quick for any number
        of pairs at once, and the search for the pairs that these left open."""
        if not self.known:
            return [self]
        parts = self.stages[:2], self.stages[2:]
        return [dataclasses.replace(self, stages=stages) for stages in parts if stages]


def _in_doubt(
    pair: Pair, pose: RelativePose, use: Use, believed: Bool[Array, ""]
) -> Use:
    """The points of which some are wrong, though nothing tells which; of pairs with few
    points out."""
    out = pair.mask & ~use
    asked = believed & (count(out) > 0) & (count(out) <= FEW)

    def found(asked):
        own = pair.with_mask(pair.mask & asked)
        return undecided(own, pose, use & asked, out & asked & seen(own, pose, 0.0))

    return if_needed(asked, found, jnp.zeros_like(use))


def _unit(pair: Pair) -> Float[Array, ""]:
    """By what the standard deviations of a pair are to be multiplied where all are 1,
    as in one that states none."""
    stated = count(pair.mask & (pair.sigma != 1)) > 0
    return jnp.where(stated, 1.0, pair.focal_left / UNKNOWN)


def _untouched(
    pair: Pair, pose: RelativePose, limit: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether all points agree: the global test, every |w|, and every point in front of
    both photos."""
    linear = linearised(pair, pose)
    within = normalised(linear, pair.mask) <= limit
    agree = count(pair.mask & within & seen(pair, pose, limit)) == count(pair.mask)
    misfit = total(jnp.where(pair.mask, linear.squares, 0.0))
    return agree & (
        misfit <= evidence.chi_squared_limit(DEVIATIONS, count(pair.mask) - 5)
    )


def _where_open(
    stage: AbstractStage, pair: Pair, limit: Float[Array, ""], before: Decision
) -> Decision:
    """The decision of a stage where there is none yet."""
    decide = lambda open_: stage(
        mask_unusable(pair.with_mask(pair.mask & open_))[0], limit
    )
    return if_needed(~before.believed, decide, before)
