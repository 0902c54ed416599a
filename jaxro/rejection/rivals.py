"""Whether another consensus, of points that the one believed leaves out, is no accident
either.

Something moves through the scene, a facade looks alike at two places, or two scenes are in
one photo: then two poses explain some of the points each, neither by accident, and
nothing in the photos says which of them is that of the photos. So what is left out is
searched again. A consensus among it is a rival

* if it is no accident by the rule of `Thorough`, one witness for each place, none of which
  lies beside a point of what is believed, and
* if it is another pose, and not what larger errors make of the same one: most points of
  what is believed are far from it.

What is believed stands out among its rivals if it has STANDS_OUT times as many witnesses
as each of them. Else none is to be used.

Nobody can afford to look for every small consensus among many wrong points. What is left
out is searched only where it has witnesses enough for a rival that would count, for a PART
of the blocks of subsets that the first consensus took, and one at least. One block meets
what agrees on two thirds of the points left out in nearly every case, and on half of them
in three cases of five.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import planes
from ..orientation.orient import Orientation
from ..orientation.results import RESULTS, is_usable
from ..xla.kernels import while_loop
from ..xla.passes import count
from . import evidence
from .agreement import keep_agreeing, points_within, squares
from .base import Rivals
from .judgement import RIVALS, AbstractStep, Contest, Judgement
from .level import Level
from .masked import Use, choose
from .search import Found
from .stages import ROUNDS
from .thorough import PLENTY, SCORED, Seeks, Thorough
from .visibility import seen

STANDS_OUT = 2.0
"""How many times the witnesses of each rival those of what is believed are, if it stands
out. Nothing but their number speaks for one of two consensuses of which neither is an
accident; so it takes two thirds of the witnesses of both."""

PART = 10
"""The search for a rival may take one block of subsets for so many that the first
consensus took."""

LEAST = 8
"""Points left out from which they may hold a rival: fewer are an accident whatever they
agree with."""

WIDE = 4.0
"""Multiple of the limit of |w| within which points belong to a pose that larger errors, or
a lens, have moved a little."""

SAME = 0.5
"""Share of the points of what is believed above which a consensus near them all is the
same one."""


class Rival(NamedTuple):
    """Another consensus: its pose and points, and the logarithm of the expected number of
    accidents as good."""

    pose: RelativePose
    use: Use
    accidents: Float[Array, ""]


class AsksForRivals(AbstractStep):
    """Whether the points left out can hold a rival, which then is to be sought."""

    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision", "sought")
    changes: ClassVar[tuple[str, ...]] = ("sought",)

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        carried = known.base.turned | known.base.few
        return known.decision.believed & ~carried & (known.out >= LEAST)

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With what is to be sought."""
        pose, use, _, scale = known.decision
        pair, limit = self.level.judged_by(pair, scale), self.level.limit(pair)
        cell = evidence.cells(pair)
        far = squares(pair, pose) > (WIDE * limit) ** 2
        taken = evidence.held_by(cell, use)
        among = pair.mask & ~use & far & ~taken[cell]
        own, left = count(taken), _witnesses(cell, among)
        before = known.sought
        sought = before._replace(
            number=before.number * 0,
            again=(left >= LEAST) & (left * STANDS_OUT > own),
            among=among,
            found=before.found._replace(pose=pose),
            scale=scale,
            fewest=jnp.maximum(own / (2 * STANDS_OUT), LEAST),
            blocks=jnp.maximum(before.found.blocks // PART, 1),
        )
        return known._replace(sought=sought)


class SettlesRival(AbstractStep):
    """What becomes of a search for a rival; where it is one, there may be another."""

    stage: Thorough
    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision", "sought", "base", "contest")
    changes: ClassVar[tuple[str, ...]] = ("sought", "contest")

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        sought = known.sought
        return known.decision.believed & sought.for_rival & sought.again

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the rival, and whether another one is to be sought."""
        pose, use, _, scale = known.decision
        pair, limit = self.level.judged_by(pair, scale), self.level.limit(pair)
        sought, cell = known.sought, evidence.cells(pair)
        rest = mask_unusable(pair.with_mask(pair.mask & sought.among))[0]
        found = _settle(rest, sought.found, limit, cell)
        near = points_within(pair, found.pose, WIDE * limit)
        another = count(use & near) <= SAME * count(use)
        plenty = jnp.maximum(_witnesses(cell, pair.mask) / PLENTY, 1.0)
        accidents = found.accidents / plenty
        is_one = another & (accidents <= jnp.log(self.stage.accidents))

        # all that agree with it, those near what is believed as well
        agree = pair.mask & ~use & points_within(pair, found.pose, limit)
        agree = agree & seen(pair, found.pose, limit, found.use)
        stands = _witnesses(cell, use) >= STANDS_OUT * _witnesses(cell, agree)
        if pair.score is not None:
            z = evidence.z_of_scores(pair.score, use, agree)
            stands = stands | (z >= SCORED)
        own = _log_accidents(pair, pose, use, known.base.chance, limit, cell) / plenty
        rival = Rival(found.pose, agree, accidents)
        entered = _enter(known.contest, rival, sought.number, own, ~stands)

        among = sought.among & ~agree
        more = _witnesses(cell, among) > sought.fewest
        sought = sought._replace(
            number=sought.number + 1,
            again=is_one & more & (sought.number + 1 < RIVALS),
            among=among,
            found=sought.found._replace(pose=pose),
        )
        contest = choose(is_one, entered, known.contest)
        return known._replace(sought=sought, contest=contest)


def _enter(
    contest: Contest,
    rival: Rival,
    number: Int[Array, ""],
    own: Float[Array, ""],
    contested: Bool[Array, ""],
) -> Contest:
    """The contest with the rival of this number; `own`: the accidents of what is
    believed."""
    here = jnp.arange(RIVALS) == number
    numbers = jnp.stack(jax.tree.leaves(rival.pose))
    return Contest(
        own=own,
        contested=contest.contested | contested,
        accidents=jnp.where(here, rival.accidents, contest.accidents),
        pose=jnp.where(here[:, None], numbers, contest.pose),
        use=tuple(
            jnp.where(here[k], rival.use, before)
            for k, before in enumerate(contest.use)
        ),
    )


def _settle(
    rest: Pair, found: Found, limit: Float[Array, ""], cell: evidence.Cells
) -> Rival:
    """The consensus near what was found among what is left out."""
    near = points_within(rest, found.pose, limit)
    pose, use = keep_agreeing(rest, found.pose, near, limit, ROUNDS)
    use = use & seen(rest, pose, limit, use)
    pose = planes.facing(rest.with_mask(use), pose)
    one = evidence.one_of_each(cell, rest.mask)
    witnesses = mask_unusable(rest.with_mask(one))[0]
    chance = evidence.chance_of_agreement(witnesses, pose, use & one, limit)
    by_losers = found.agreed / jnp.maximum(found.asked, 1.0)
    chance = jnp.maximum(chance, by_losers)
    return Rival(pose, use, _log_accidents(rest, pose, use, chance, limit, cell))


def _log_accidents(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    chance: Float[Array, ""],
    limit: Float[Array, ""],
    cell: evidence.Cells,
) -> Float[Array, ""]:
    """`log_least_accidents` of the points in use, one witness of each cell."""
    one = evidence.one_of_each(cell, pair.mask)
    square = squares(pair, pose)
    return evidence.log_least_accidents(square, use & one, chance, count(one), limit)


def _witnesses(cell: evidence.Cells, among: Use) -> Float[Array, ""]:
    """How many cells these points are in."""
    return count(evidence.held_by(cell, among))


class LooksForRivals(AbstractStep):
    """The rivals of what is believed, as one step."""

    stage: Thorough
    level: Level
    reads: ClassVar[tuple[str, ...]] = SettlesRival.reads
    changes: ClassVar[tuple[str, ...]] = ("sought", "contest")

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return AsksForRivals(self.level).is_open(known)

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the consensuses in contest."""
        asks, seeks, settles = steps_of(self.stage, self.level)[:3]

        def turn(known: Judgement) -> Judgement:
            found = seeks.judge(pair, known)
            settled = settles.judge(pair, found)
            return choose(found.sought.again, settled, found)

        more = lambda known: known.sought.again
        return while_loop(more, turn, asks.judge(pair, known), pair.focal_left)


def steps_of(stage: Thorough, level: Level) -> tuple[AbstractStep, ...]:
    """The search for rivals by programs of their own: the search is that of `Thorough`,
    so that it is compiled once."""
    return AsksForRivals(level), *(
        Seeks(stage, level),
        SettlesRival(stage, level),
    ) * RIVALS


def judge_contest(contest: Contest, orientation: Orientation) -> Orientation:
    """The orientation with the result `several_solutions`, where it is else usable but does
    not stand out among its rivals."""
    contested = contest.contested & is_usable(orientation.result)
    result = RESULTS.where(contested, RESULTS.several_solutions, orientation.result)
    return dataclasses.replace(orientation, result=result)


def tell_rivals(contest: Contest) -> Rivals:
    """The rivals as they are told, the strongest first."""
    order = jnp.argsort(contest.accidents, stable=True)
    probability = lambda accidents: jnp.minimum(jnp.exp(accidents), 1.0)
    return Rivals(
        mask=jnp.stack(contest.use)[order],
        pose=RelativePose(*contest.pose[order].T),
        probability=probability(contest.accidents[order]),
        own=probability(contest.own),
    )
