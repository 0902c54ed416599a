"""The last stage of `recommended`: a search in any position, and the evidence for what
it finds."""

import math
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import planes
from ..xla.kernels import if_needed, while_loop
from ..xla.passes import count
from . import evidence
from .agreement import points_within, scale_sigma, squares
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import Newton, best
from .judgement import (
    OF_DECISION,
    AbstractStep,
    Decision,
    Judgement,
    Sought,
    nothing_known,
)
from .level import Level
from .masked import Use, choose, sum_of
from .noise import noise_of
from .ransac import Ransac
from .search import Found, Search, cost_of, nothing_found
from .stages import (
    AbstractStage,
    believe_if_it_fits,
    on_a_plane,
    settle,
)
from .steps import from_vertical, narrow

STEPS = 8
"""Steps of least squares from the vertical."""

OVERWHELMING = math.log(1e-9)
"""Logarithm of an expected number of accidents at which a search that came to its end
is believed in any case."""

PLENTY = 64.0
"""Points up to which `accidents` holds as it is. For more, n, it is raised to the power
of n / PLENTY: the more points there are, the larger are the groups of repeated
structure, which agree with many orientations."""

ALIKE = 2
"""Pieces that look alike, without whose points the search begins again."""

TURNS = 2
"""Searches, the second one with the noise that the first one found."""

APART = 0.6
"""Ratio of the noise found to the noise assumed, or of the assumed to the found one,
below which a search begins again."""

MAJORITY = 0.4
"""Part of the points that agreed before that the noise has to come from: a few points
may agree by accident."""

SCORED = 4.0
"""Standard deviations by which the scores of the points kept are higher than those of the
others, from which they are evidence: a structure that repeats itself has none of it, as a
match with one window is no better than with the next."""

SURE = 30.0
"""Redundancy of the noise found from which it may contradict the sigma stated: of fewer
points some fit by accident."""

MOST = 20.0
"""How many times larger or smaller than the stated noise the noise found may be."""


class Turn(NamedTuple):
    """The state between two searches: how many there were, whether another one is
    needed, the noise to judge by as a multiple of the stated one, and the search."""

    number: Int[Array, ""]
    again: Bool[Array, ""]
    scale: Float[Array, ""]
    found: Found


class Thorough(AbstractStage):
    """Random subsets in any position until a better orientation would have been met,
    and the evidence for what is found.

    The search begins with the best of all points from the vertical, the graduated
    search, and for at most `few` points many subsets solved from the vertical, which
    for few points is quicker than a search in any position. What is found is believed
    if `believe_if_it_fits`, with at least `share` of the points and
    `accidents_at_once`. Else it is believed if the subsets were enough to have met a
    set of `better` times as many points, and sets as good are not expected by accident
    more than `accidents` times (for many points more seldom), one witness
    of each place (`evidence.apart`), or all points where their scores are higher than those
    of the others by SCORED standard deviations. The chance of agreement is measured on this scene:
    by partners shifted among the points, and by the orientations that lost. Of a plane with other
    points beside it both poses are compared. The search ends when no set that it could
    still find would be believed, after at least `least` subsets, so that the pose is as
    good as it can be where nothing is believed.

    Where the residuals leave no doubt that sigma is much too large, the search begins
    again with the noise that they show, and the points are then judged by it. Where
    sigma is not `known` they always are.
    """

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    near: Ransac = Ransac(hypotheses=Newton(block=64), count=1024, limit=5.0)
    few: int = 32
    search: Search = Search()
    share: ScalarLike = 0.4
    accidents_at_once: ScalarLike = 0.02
    accidents: ScalarLike = 1e-3
    better: ScalarLike = 1.5
    least: int = 256
    known: bool = True

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        known = nothing_known(pair.focal_left, pair.mask)
        sought = known.sought._replace(again=count(pair.mask) > 0)

        def turn(state: tuple[Decision, Sought]) -> tuple[Decision, Sought]:
            decision, sought = state
            return self.settle(pair, decision, self.seek(pair, sought, limit), limit)

        more = lambda state: state[1].again
        start = known.decision, sought
        return while_loop(more, turn, start, pair.focal_left)[0]

    def as_steps(self, level: Level) -> tuple[AbstractStep, ...]:
        """The search and what becomes of it, by programs of their own."""
        return (Seeks(self, level), Settles(self, level)) * (1 + ALIKE)

    def seek(self, pair: Pair, sought: Sought, limit: Float[Array, ""]) -> Sought:
        """What is found among the points that are left to search."""
        own = mask_unusable(pair.with_mask(pair.mask & sought.among))[0]

        near = lambda needed: self._near_vertical(_if(needed, own))
        first = if_needed(~sought.for_rival, near, sought.found.pose)
        found, scale = self._search(own, first, sought, limit)
        agree = count(points_within(scale_sigma(own, scale), found.pose, limit))
        again = sought.again & (agree >= sought.fewest)
        return sought._replace(found=found, scale=scale, again=again)

    def settle(
        self, pair: Pair, before: Decision, sought: Sought, limit: Float[Array, ""]
    ) -> tuple[Decision, Sought]:
        """The decision by what was found, or that of before where this is not believed;
        and where to search again: where what was found is no accident but for what its
        points have in common, that they lie at few places, among all others."""
        found, scale = sought.found, sought.scale
        own = scale_sigma(pair, scale)
        pose, use = _settle_better_pose(own, found.pose, limit)
        at_once = self.known & believe_if_it_fits(
            own, pose, use, limit, self.share, self.accidents_at_once
        )
        # one after the other, so that it is compiled once
        judge = lambda among: self._is_certain(own, pose, use, among, found, limit)
        sets = jnp.stack([evidence.apart(own), own.mask])
        certain, by_points = lax.map(judge, sets)
        believed = at_once | certain
        if own.score is not None:
            z = evidence.z_of_scores(own.score, use, own.mask & ~use)
            believed = believed | (by_points & (z >= SCORED))
        decision = Decision(pose=pose, use=use, believed=believed, scale=scale)
        first = sought.number == 0
        alike = by_points & ~believed
        sought = sought._replace(
            number=sought.number + 1,
            again=alike & (sought.number < ALIKE),
            among=sought.among & ~use,
        )
        return choose(first | believed, decision, before), sought

    def _is_certain(
        self,
        pair: Pair,
        pose: RelativePose,
        use: Use,
        among: Use,
        found: Found,
        limit: Float[Array, ""],
    ) -> Bool[Array, ""]:
        """Whether the search was thorough enough, and the points in use `among` these
        are no accident."""
        better = jnp.minimum(self.better * count(use), count(pair.mask))
        met = found.counted >= self.search.enough_for(better, count(pair.mask))
        pair = mask_unusable(pair.with_mask(among))[0]
        use = use & pair.mask
        of = count(pair.mask)
        chance = evidence.chance_of_agreement(pair, pose, use, limit)
        by_losers = found.agreed / jnp.maximum(found.asked, 1.0)
        chance = jnp.maximum(chance, by_losers)
        s = squares(pair, pose)
        accidents = evidence.log_least_accidents(s, use, chance, of, limit)
        thorough = met | (accidents <= OVERWHELMING)
        return (accidents <= self._most_accidents(of)) & thorough

    def _search(
        self,
        pair: Pair,
        first: RelativePose,
        sought: Sought,
        limit: Float[Array, ""],
    ) -> tuple[Found, Float[Array, ""]]:
        """The search from a first pose, and the noise to judge by, as a multiple of the
        stated one: for a rival that of what is believed."""
        first_one = ~sought.for_rival

        def turn(state: Turn) -> Turn:
            scale = state.scale
            own = scale_sigma(pair, scale)
            begin = self.search.begin(own, state.found.pose)

            def worth(needed: Bool[Array, ""]) -> Float[Array, ""]:
                return self._worth(_if(needed, own), state.found.pose, limit)

            def noise(needed: Bool[Array, ""]) -> tuple[RelativePose, Array]:
                narrowed = narrow(_if(needed, own), found.pose, self.search.limit)
                every = _if(needed, pair), _if(needed, own)
                return narrowed, self._new_scale(*every, scale, found.pose, narrowed)

            most = if_needed(first_one, worth, jnp.full_like(scale, jnp.inf))
            found = self.search.run(own, begin, most, sought.blocks)
            narrowed, new = if_needed(first_one, noise, (found.pose, scale))
            again = (new < APART * scale) | (scale < APART * new)
            pose = choose(again, narrowed, found.pose)
            return Turn(
                number=state.number + 1,
                again=again,
                scale=new,
                found=found._replace(pose=pose),
            )

        start = Turn(
            number=jnp.zeros((), int),
            again=count(pair.mask) > 0,
            scale=jnp.where(first_one, 1.0, sought.scale),
            found=nothing_found(first),
        )
        more = lambda state: state.again & (state.number < TURNS)
        end = while_loop(more, turn, start, pair.focal_left)
        return end.found, end.scale

    def _new_scale(
        self,
        pair: Pair,
        own: Pair,
        scale: Float[Array, ""],
        pose: RelativePose,
        narrowed: RelativePose,
    ) -> Float[Array, ""]:
        """The noise that the residuals show, as a multiple of the stated one, if it is
        to be taken in place of the assumed `scale`; `own`: the pair with the assumed
        noise."""
        noise = noise_of(squares(pair, narrowed), pair.mask)
        redundancy = noise.redundancy
        relative = 1 / jnp.sqrt(2 * jnp.maximum(redundancy, 0.5))
        upper = noise.sigma * (1 + evidence.DEVIATIONS * relative)
        too_large = (upper < APART * scale) & (redundancy >= SURE)
        agreed = count(points_within(own, pose, self.search.limit))
        of_most = redundancy >= MAJORITY * agreed
        taken = noise.known & of_most & (too_large | (not self.known))
        return jnp.where(taken, jnp.clip(noise.sigma, 1 / MOST, MOST), scale)

    def _worth(
        self, pair: Pair, pose: RelativePose, limit: Float[Array, ""]
    ) -> Float[Array, ""]:
        """How many subsets are worth it: enough to meet the smallest set that would be
        believed."""
        of = count(pair.mask)
        use = points_within(pair, pose, limit)
        chance = evidence.chance_of_agreement(pair, pose, use, limit)
        most = self._most_accidents(of)
        fewest = evidence.fewest_points(chance, of, most, pair.mask.shape[0])
        return jnp.maximum(self.search.enough_for(fewest, of), float(self.least))

    def _most_accidents(self, of: Float[Array, ""]) -> Float[Array, ""]:
        """Logarithm of the expected number of accidents up to which a set of so many
        points is believed."""
        return jnp.log(self.accidents) * jnp.maximum(of / PLENTY, 1.0)

    def _near_vertical(self, pair: Pair) -> RelativePose:
        """The best orientation of those that begin at the vertical."""
        few = count(pair.mask) <= self.few
        small = mask_unusable(pair.with_mask(pair.mask & few))[0]
        plain = from_vertical(pair, STEPS)
        found = plain, self.graduated.search(pair), self.near.search(small)
        poses = jax.tree.map(lambda *each: jnp.stack(each), *found)
        costs = lax.map(lambda pose: cost_of(pair, pose, self.search.limit), poses)
        return best(poses, costs)


def _if(needed: Bool[Array, ""], pair: Pair) -> Pair:
    """The pair, without points where it is not needed."""
    return mask_unusable(pair.with_mask(pair.mask & needed))[0]


class AbstractSearching(AbstractStep):
    """A part of `Thorough`, which goes on until it is not to begin again."""

    stage: Thorough
    level: Level

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return ~known.decision.believed & known.sought.again


class Seeks(AbstractSearching):
    """The search of `Thorough`, for a rival of what is believed as well."""

    reads: ClassVar[tuple[str, ...]] = ("sought",)
    changes: ClassVar[tuple[str, ...]] = ("sought",)

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        wanted = ~known.decision.believed | known.sought.for_rival
        return wanted & known.sought.again

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With what is found."""
        own, limit = self.level.first(pair), self.level.limit(pair)
        return known._replace(sought=self.stage.seek(own, known.sought, limit))


class Settles(AbstractSearching):
    """What becomes of the search of `Thorough`."""

    reads: ClassVar[tuple[str, ...]] = ("decision", "sought")
    changes: ClassVar[tuple[str, ...]] = (*OF_DECISION, "sought")

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the decision, and whether the search is to begin again."""
        own, limit = self.level.first(pair), self.level.limit(pair)
        of = known.decision, known.sought
        decision, sought = self.stage.settle(own, *of, limit)
        return self.level.decide(pair, known, decision)._replace(sought=sought)


class Settled(NamedTuple):
    """The state between the poses of a plane: how many were settled, whether another
    one is to be, where it begins, the better pose so far and its points."""

    number: Int[Array, ""]
    again: Bool[Array, ""]
    start: RelativePose
    pose: RelativePose
    use: Use


def _settle_better_pose(
    pair: Pair, pose: RelativePose, limit: Float[Array, ""]
) -> tuple[RelativePose, Use]:
    """The pose and its points, settled; if they are those of a plane, and others are
    out, of the plane's two poses the one that costs less."""

    def cost(pose: RelativePose, use: Use) -> Float[Array, ""]:
        # a point that nothing checks may be in use far from the pose that it pulls
        each = jnp.minimum(squares(pair, pose), limit**2)
        return sum_of(jnp.where(use, each, limit**2), pair.mask)

    def turn(state: Settled) -> Settled:
        new = settle(pair.with_mask(pair.mask & state.again), state.start, limit)
        before = state.pose, state.use
        first = state.number == 0
        better = first | (cost(*new) < cost(*before))
        pose, use = choose(better, new, before)
        other, exists = _other_pose(pair, pose, use, limit, first)
        return Settled(state.number + 1, exists, other, pose, use)

    start = Settled(
        number=jnp.zeros((), int),
        again=count(pair.mask) > 0,
        start=pose,
        pose=pose,
        use=pair.mask & False,
    )
    end = while_loop(lambda state: state.again, turn, start, pair.focal_left)
    return end.pose, end.use


def _other_pose(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: Float[Array, ""],
    asked: Bool[Array, ""],
) -> tuple[RelativePose, Bool[Array, ""]]:
    """The other pose of the plane of the points in use, and whether it is to be
    compared; only where it is asked for, and the plane alone may have chosen."""
    facing, plane, flat = on_a_plane(pair, pose, use, limit)

    def find(needed: Bool[Array, ""]) -> tuple[RelativePose, Bool[Array, ""]]:
        in_plane = pair.with_mask(plane.within & needed)
        return planes.second(in_plane, facing, plane.normal)

    return if_needed(flat & asked, find, (pose, asked & False))
