"""Whether many points carry the base of a cleaned pair, or a few that may be wrong.

Right points of photos that only turn, of a scene far away, or of one plane say little
or nothing of the base. One or two wrong points that are kept with them say it exactly,
and fit exactly: their redundancy is nearly zero. So each base is held against the
hypothesis that the points that it needs are wrong ones, which agree with it by chance:

* without a base: a rotation explains all other points;
* without its carriers: when the points with the largest influence on the worst
  determined direction are taken away, one after the other, the rest determines the pose
  no more than points that determine nothing;
* off a plane: all other points lie in one plane, whose pose then is that of these points
  alone;
* by the other pose of a plane: it explains all other points.

With s such points among w that the others do not vouch for, and the chance p that a
wrong point agrees, sets as good are expected C(w, s) C(s, d) p^(s-d) times by accident,
where d of the points choose the base freely (compare `evidence.log_accidents`).
"""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import dense, inverse
from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import degeneracy, planes
from ..orientation.orient import Orientation
from ..orientation.results import RESULTS
from ..orientation.starts.general import rotation_only, vectors
from ..orientation.verdict import WEAK, largest_variance
from ..xla.kernels import if_needed, while_loop
from ..xla.passes import count
from .agreement import keep_agreeing, points_within, squares
from .evidence import chance_of_agreement
from .homographies import points_in_plane
from .judgement import OF_DECISION, AbstractStep, Judgement, Witnesses
from .level import Level
from .masked import Use, choose, sum_of
from .stages import FLAT, ROUNDS
from .steps import narrow, normal_equations
from .subsets import choose_places, draw, move_up
from .visibility import look, seen

ACCIDENTS = math.log(1e-3)
"""Logarithm of the expected number of accidents from which a base is not believed."""

FEW = 3
"""So many points carry nothing, whatever their chance."""

MARGIN = 2.5
"""Multiple of sigma0 below which the `margin` of a layout is that of points that
determine nothing; unless the deviations are so small, as those of a base that points
into the photo may be, that they do."""

MOST = 16
"""Carriers that are looked for, at most."""

TURNS = 6
"""Turns to find a rotation, each by the points that the last one explains."""

WIDE = 4.0
"""Multiple of the limit from which the points around the other pose of a plane are
narrowed down."""

SUBSETS, TINY = 128, 1e-24
"""Rotations by two points that are compared; square of the length of no direction."""

PARALLEL = 3.5
"""Standard deviations of the angle between two rays up to which they are parallel."""


class IsCarried(AbstractStep):
    """Whether a rotation explains all points but few, which then is the pose, with all
    points that it explains; or else whether few points carry the base, and whether all
    but few lie in one plane, which then alone give the pose."""

    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision",)
    changes: ClassVar[tuple[str, ...]] = (*OF_DECISION, "base", "unchecked")

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return known.decision.believed

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With what is said of the base but for the other pose of a plane."""
        pose, use, _, scale = known.decision
        pair, limit = self.level.judged_by(pair, scale), self.level.limit(pair)
        freedom = count(use) - 5
        square = sum_of(squares(pair, pose), use) / jnp.maximum(freedom, 1.0)
        sigma0 = jnp.where(freedom > degeneracy.FEW, jnp.sqrt(square), 1.0)
        # of so many points a chance is not known to be less than that of one of them
        least = 1 / jnp.maximum(count(pair.mask), 1.0)
        chance = jnp.maximum(chance_of_agreement(pair, pose, use, limit), least)
        out = pair.mask & ~use
        any_out = count(out) > 0

        rotation, still = turn_only(pair, use)
        explained = count(use & still)
        apart = _by_accident(count(use & ~still), count(pair.mask & ~still), chance, 2)
        turned = apart & (explained >= 0.5 * count(use)) & (explained > FEW)

        needed, found = carriers(pair, pose, use, sigma0)
        few = found & _by_accident(count(needed), count(needed | out), chance, 2)

        plane = planes.plane(pair, pose, use, limit)
        off = use & ~points_in_plane(pair, use, limit)
        some_off = (count(off) > 0) & (count(off) <= FEW) & any_out & ~turned

        def in_plane(needed: Bool[Array, ""]) -> tuple[RelativePose, Use]:
            others = pair.with_mask(pair.mask & ~off & needed)
            return keep_agreeing(others, pose, use & ~off, limit, ROUNDS)

        base = Witnesses(
            turned=turned,
            few=few & any_out & ~turned,
            flat=some_off | ((plane.share >= FLAT) & any_out & ~turned),
            second=any_out & False,
            chance=chance,
        )
        pose, use = if_needed(some_off, in_plane, (pose, use))
        decision = known.decision._replace(
            pose=choose(turned, rotation, pose), use=jnp.where(turned, still, use)
        )
        known = known.decided(pair, decision)
        return known._replace(base=base, unchecked=off & some_off)


class HasSecond(AbstractStep):
    """Whether the other pose of the plane of the points explains all but few."""

    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision", "base")
    changes: ClassVar[tuple[str, ...]] = ("base",)

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        return known.decision.believed & known.base.flat

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the word on the other pose."""
        pose, use, _, scale = known.decision
        pair, limit = self.level.judged_by(pair, scale), self.level.limit(pair)
        others, fits = _points_of_other_pose(pair, pose, use, limit)
        agree, of = count(use & ~others), count(pair.mask & ~others)
        chosen = _by_accident(agree, of, known.base.chance, 0)
        return known._replace(base=known.base._replace(second=fits & chosen))


def judge_base(base: Witnesses, orientation: Orientation) -> Orientation:
    """The orientation with what the witnesses say of its base, where it is else
    successful or has no base."""
    result = orientation.result
    fine = result == RESULTS.successful
    result = RESULTS.where(fine & base.second, RESULTS.two_solutions, result)
    result = RESULTS.where(fine & base.few, RESULTS.carried_by_few, result)
    result = RESULTS.where(base.turned, RESULTS.zero_base, result)
    return dataclasses.replace(orientation, result=result)


def _points_of_other_pose(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> tuple[Use, Bool[Array, ""]]:
    """The points that agree with the other pose of the plane of those in use, and
    whether there is one, and those that agree with both fit it as well."""
    plane = planes.plane(pair, pose, use, limit)
    in_plane = mask_unusable(pair.with_mask(plane.within))[0]
    other, exists = planes.second(in_plane, pose, plane.normal)
    other = narrow(pair, other, WIDE * limit)
    near = points_within(pair, other, limit)
    other, agree = keep_agreeing(pair, other, near, limit, ROUNDS)
    agree = agree & seen(pair, other, limit, agree)
    both = use & agree
    here, there = (sum_of(squares(pair, p), both) for p in (pose, other))
    fits = there <= here * degeneracy.excess(count(both) - 5)
    return agree, exists & fits


def turn_only(pair: Pair, use: Use) -> tuple[RelativePose, Use]:
    """The rotation that explains most of the points in use, and all points that it
    explains: the best of those by two points each, then by all that it explains."""
    rays = vectors(pair)
    first, still = _best_of_two(pair, use)

    def turn(_, state):
        _, still = state
        rotation, _ = rotation_only(*rays, use & still)
        return rotation, look(pair, rotation, PARALLEL).parallel

    return lax.fori_loop(0, TURNS, turn, (first, still))


def _best_of_two(pair: Pair, use: Use) -> tuple[RelativePose, Use]:
    """Of rotations by two points in use, which carry their errors, the one that
    explains most of them, and all points that it explains."""
    own = pair.with_mask(use)
    uniform = draw(2, SUBSETS, SUBSETS, seed=0)[0]
    places = choose_places(uniform, count(use))
    left, right = (move_up(own, rays) for rays in vectors(pair))

    def explain(first: Array, second: Array) -> tuple[RelativePose, Use]:
        one, other = (_frame(rays[first], rays[second]) for rays in (left, right))
        turned = rot.product(one, rot.transpose(other))
        along = jnp.ones_like(turned[0][0])
        none = jnp.zeros_like(along)
        pose = RelativePose(*rot.to_quaternion(turned), along, none, none).normalise()
        return pose, look(pair, pose, 2 * PARALLEL).parallel

    found, still = jax.vmap(explain)(*places)
    best = jnp.argmax(jax.vmap(lambda still: count(still & use))(still))
    return jax.tree.map(lambda a: a[best], (found, still))


def _frame(one: Float[Array, "3"], other: Float[Array, "3"]) -> rot.Matrix:
    """The right-handed frame, in columns, of the sum and the difference of two
    directions, of any length."""
    unit = lambda v: v / jnp.sqrt(jnp.maximum(jnp.sum(v * v), TINY))
    one, other = unit(one), unit(other)
    (x1, y1, z1), (x2, y2, z2) = unit(one + other), unit(one - other)
    first, second = (x1, y1, z1), (x2, y2, z2)
    return rot.transpose((first, second, rot.cross(first, second)))


def carriers(
    pair: Pair, pose: RelativePose, use: Use, sigma0: Float[Array, ""]
) -> tuple[Use, Bool[Array, ""]]:
    """The points without which those in use determine nothing, beginning with the
    largest influence on the worst determined direction; and whether that is so, of at
    most MOST of them, with five or more points left.

    Nothing is determined where the layout is one of points that determine nothing but
    by their errors; and, without the first FEW, where a deviation is so large that the
    pair would be called weakly determined.
    """
    linear = linearise(pair, pose)

    def influence(left: Use) -> tuple[Array, Bool[Array, ""]]:
        weight = jnp.where(left, linear.weight, 0.0)
        n, _ = normal_equations(linear, weight)
        cofactor = dense(inverse(n)[0])
        direction, variance = degeneracy.direction_of_worst(pose, cofactor)
        margin = degeneracy.margin_along(
            pair.with_mask(left), pose, direction, variance * sigma0**2
        )
        deviation = sigma0 * jnp.sqrt(largest_variance(pose, cofactor))
        first = count(left) >= count(use) - FEW
        weak = first & (deviation > WEAK)
        nothing = (margin < MARGIN * sigma0) & (deviation > WEAK / 4)
        undetermined = weak | nothing
        return weight * linear.times(direction) ** 2, undetermined

    def turn(state):
        k, _, _, left = state
        share, undetermined = influence(left)
        largest = jnp.arange(left.size) == jnp.argmax(share)
        enough = (k < MOST) & (count(left) > 5)
        more = ~undetermined & enough
        return k + 1, more, undetermined, left & ~(largest & more)

    no = count(use) < 0
    start = jnp.zeros((), int), count(use) > 5, no, use
    more = lambda state: state[1]
    _, _, found, left = while_loop(more, turn, start, pair.focal_left)
    return use & ~left, found


def _by_accident(
    agree: Float[Array, ""],
    of: Float[Array, ""],
    chance: Float[Array, ""],
    free: int,
) -> Bool[Array, ""]:
    """Whether so many points `of` those that may be wrong are to be expected to agree
    by accident, when `free` of them choose what they agree with."""
    choose = lambda n, k: gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    agree = jnp.maximum(agree, free)
    of = jnp.maximum(of, agree)
    expected = choose(of, agree) + choose(agree, float(free))
    expected = expected + (agree - free) * jnp.log(chance)
    return (agree <= FEW) | (expected > ACCIDENTS)
