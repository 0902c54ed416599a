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
from typing import Any, ClassVar

from jaxtyping import Array, Bool, ScalarLike

from ..assessment.undecided import undecided_points
from ..geometry.linear import linearise
from ..geometry.pairs import Pair
from ..orientation.orient import Orientation, orient_from
from ..orientation.verdict import check_plane
from .agreement import normalised_residuals, scale_sigma
from .base import OUTCOMES, AbstractProcedure, Rejection
from .carried import HasSecond, IsCarried, judge_base
from .fading import fade
from .judgement import AbstractStep, Judgement, if_open, nothing_known
from .level import Level
from .quick import Plain, Quick
from .rivals import LooksForRivals, judge_contest, steps_of, tell_rivals
from .stages import FEW, AbstractStage, Decides
from .thorough import Thorough
from .unchecked import IsChecked
from .verdict import testable, verdict_on
from .visibility import seen


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
        known = nothing_known(pair.focal_left, pair.mask)
        decide = [Decides(stage, self._level) for stage in self._deciding]
        look = [LooksForRivals(search, self._level) for search in self._rivals]
        for step in (*decide, *self._checks, *look):
            known = if_open(step, pair, known)
        return self.conclude(pair, known)

    def steps(self) -> list[AbstractStep]:
        """Those of every stage, then what is asked of what they found, then the search
        for rivals."""
        level = self._level
        decide = [step for stage in self._deciding for step in stage.as_steps(level)]
        look = [step for search in self._rivals for step in steps_of(search, level)]
        return [*decide, *self._checks, *look]

    def is_usual(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return ~(known.heavy & known.decision.believed)

    def conclude_usual(
        self, pair: Pair, known: Judgement
    ) -> tuple[Rejection, Bool[Array, ""]]:
        pair, use = self._level.state(pair), known.decision.use
        used = pair.with_mask(testable(pair, use))
        solved, plane = orient_from(used, known.decision.pose)
        return self._tell(pair, known, solved), ~plane

    def conclude(self, pair: Pair, known: Judgement) -> Rejection:
        pose, use, believed, scale = known.decision
        pair = self._level.state(pair)
        scale = scale * self._level.first_sigma(pair)
        fading = fade(scale_sigma(pair, scale), pose, use & believed)
        fading = fading._replace(noise=fading.noise * scale)
        used = fading.weaken(pair).with_mask(testable(pair, use))
        solved = check_plane(used, *orient_from(used, pose))
        return self._tell(pair, known, fading.spread(pair, use, solved))

    def _tell(self, pair: Pair, known: Judgement, solved: Orientation) -> Rejection:
        """The result with this orientation."""
        pose, use, believed, scale = known.decision
        judged_by = self._level.judged_by(pair, scale)
        w = normalised_residuals(linearise(judged_by, pose), use)
        solved = judge_contest(known.contest, judge_base(known.base, solved))
        limit = self._level.limit(pair)
        result = verdict_on(pair, solved, testable(pair, use), limit, w)
        result = result.only_if(believed, OUTCOMES.no_consensus)
        fit = known.unchecked & (result.statistic <= limit)
        rivals = tell_rivals(known.contest)
        result = dataclasses.replace(result, unchecked=fit, rivals=rivals)
        return result.take_back(known.doubtful)

    @property
    def _checks(self) -> tuple[AbstractStep, ...]:
        """What is asked of a decision that is believed."""
        of = self._level
        return IsCarried(of), HasSecond(of), IsChecked(of), IsInDoubt(of)

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

    @property
    def _rivals(self) -> tuple[Thorough, ...]:
        """The last stage that searches in any position, which looks for rivals."""
        stages = self._deciding
        return tuple(stage for stage in stages if isinstance(stage, Thorough))[-1:]


class IsInDoubt(AbstractStep):
    """The points of which some are wrong, though nothing tells which; only of pairs with
    few points out."""

    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision", "unchecked")
    changes: ClassVar[tuple[str, ...]] = ("doubtful",)

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        some = (known.out > 0) & (known.out <= FEW)
        return known.decision.believed & ~known.base.turned & some

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the doubtful points."""
        pose, use, _, scale = known.decision
        pair = self.level.judged_by(pair, scale)
        wrong = pair.mask & ~use & ~known.unchecked & seen(pair, pose, 0.0, use)
        return known._replace(doubtful=undecided_points(pair, pose, use, wrong))
