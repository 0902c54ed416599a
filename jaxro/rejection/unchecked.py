"""Points that are kept but that nothing checks, where others are wrong.

A wrong point near the other station's image, or with a parallax far from that of all
others, pulls the pose to itself where the others leave room. Then it fits exactly, and
its pull counts as information: the deviation is one that the pose does not have. No
test finds it, as its redundancy is nearly zero.

So the points with the largest leverage are taken away, one after the other, until the
variance along some direction has grown by a factor v, and much more by these m points
than by as many next ones. They are held against chance: with w points that the others
do not vouch for,

    C(w, m) p^m √v

sets are expected that agree by accident, where p is the chance of one point; along √v
deviations the pose is free to follow them. Where that is not small, the points are left
out: the deviations of the pose without them are true, whether they are right or wrong.
"""

import math
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import dense, inverse
from ..geometry.elements import RelativePose
from ..geometry.linear import linearise
from ..geometry.pairs import Pair
from ..xla.kernels import while_loop
from ..xla.passes import count
from .agreement import keep_agreeing
from .judgement import OF_DECISION, AbstractStep, Judgement
from .level import Level
from .masked import Use, choose
from .stages import ROUNDS
from .steps import normal_equations
from .visibility import seen

ACCIDENTS = math.log(0.01)
"""Logarithm of the expected number of accidents from which points are not believed."""

GAIN = 2.0
"""How many times more the variance grows without such points than without as many
others."""

PART = 20
"""One in so many points may be unchecked; of fewer than these many points each carries
a good part, whether right or wrong."""

MOST = 8
"""Points that are held against chance together, at most."""

TURNS = 4
"""Poses that are looked at, at most."""


class IsChecked(AbstractStep):
    """The pose of the points in use that the others check, and these points, judged
    anew by |w| <= limit; where points are out."""

    level: Level
    reads: ClassVar[tuple[str, ...]] = ("decision", "base", "unchecked")
    changes: ClassVar[tuple[str, ...]] = (*OF_DECISION, "unchecked")

    def is_open(self, known: Judgement) -> Bool[Any, "*pairs"]:
        carried = ~(known.base.turned | known.base.few)
        some = (known.out > 0) & (known.kept >= PART)
        return known.decision.believed & carried & some

    def judge(self, pair: Pair, known: Judgement) -> Judgement:
        """With the decision that only such points are in use."""
        pose, use, _, scale = known.decision
        pair, limit = self.level.judged_by(pair, scale), self.level.limit(pair)
        # what was left out before, though it fits, does not come back
        others = pair.with_mask(pair.mask & ~known.unchecked)
        found = without_unchecked(others, pose, use, limit, known.base.chance)
        decision = known.decision._replace(pose=found.pose, use=found.use)
        unchecked = known.unchecked | found.unchecked
        return known.decided(pair, decision)._replace(unchecked=unchecked)


class Checked(NamedTuple):
    """A pose, the points in use that the others check, and those that were in use,
    which they do not."""

    pose: RelativePose
    use: Use
    unchecked: Use


def without_unchecked(
    pair: Pair,
    pose: RelativePose,
    use: Use,
    limit: Float[Array, ""],
    chance: Float[Array, ""],
) -> Checked:
    """The pose of the points in use that the others check, these points, judged anew by
    |w| <= limit, and the others.

    `chance`: that of a wrong point to agree with the pose. The pose without a wrong
    point may suit another one, so that it is done again until all are checked.
    """
    most = count(use) / PART

    def turn(state):
        k, _, before = state
        pose, use, doubted = before
        doubtful = find_unchecked(pair, pose, use, chance)
        some = (count(doubtful) > 0) & (count(doubted | doubtful) <= most)
        doubted = doubted | (doubtful & some)
        own = pair.with_mask(pair.mask & ~doubted & some)
        pose, use = keep_agreeing(own, pose, use & own.mask, limit, ROUNDS)
        new = Checked(pose, use & seen(own, pose, limit, use), doubted)
        return k + 1, some, choose(some, new, before)

    start = jnp.zeros((), int), most >= 1, Checked(pose, use, use & False)
    more = lambda state: state[1] & (state[0] < TURNS)
    return while_loop(more, turn, start, pair.focal_left)[-1]


def find_unchecked(
    pair: Pair, pose: RelativePose, use: Use, chance: Float[Array, ""]
) -> Use:
    """The fewest points in use that the others do not check, and that are to be
    expected among the wrong ones by this `chance` to agree."""
    linear = linearise(pair, pose)
    columns = jnp.stack(linear.columns)

    def normal(left: Use) -> tuple[Array, Array]:
        n, _ = normal_equations(linear, jnp.where(left, linear.weight, 0.0))
        return dense(n), dense(inverse(n)[0])

    whole, cofactor = normal(use)

    def take_away(state: tuple[Use, Array], _):
        left, cofactor = state
        leverage = linear.weight * jnp.sum(columns * (cofactor @ columns), axis=0)
        largest = jnp.argmax(jnp.where(left, leverage, -1.0))
        left = left & (jnp.arange(left.size) != largest)
        _, cofactor = normal(left)
        # 1 for each direction but the one that the points carry
        growth = jnp.sum(whole * cofactor) - (len(columns) - 1)
        return (left, cofactor), (largest, growth)

    _, (order, growth) = lax.scan(take_away, (use, cofactor), None, length=2 * MOST)
    m = jnp.arange(1.0, MOST + 1)
    own, with_others = growth[:MOST], growth[1::2]
    carry = own**2 > GAIN * with_others
    doubtful = count(pair.mask & ~use) + m
    by_chance = _log_accidents(doubtful, m, chance, own) > ACCIDENTS
    found = carry & by_chance
    fewest = jnp.where(jnp.any(found), jnp.argmax(found) + 1, 0)
    taken = jnp.arange(2 * MOST) < fewest
    places = jnp.arange(use.size)
    return use & jnp.any((places[:, None] == order[None, :]) & taken[None, :], axis=1)


def _log_accidents(
    doubtful: Float[Array, "m"],
    m: Float[Array, "m"],
    chance: Float[Array, ""],
    growth: Float[Array, "m"],
) -> Float[Array, "m"]:
    """Logarithm of the expected number of sets of m of the doubtful points that agree,
    where the variance grows so much without them: not more than if the first of them
    chose the pose."""
    sets = gammaln(doubtful + 1) - gammaln(m + 1) - gammaln(doubtful - m + 1)
    room = jnp.minimum(jnp.log(jnp.maximum(growth, 1.0)) / 2, -jnp.log(chance))
    return sets + m * jnp.log(chance) + room
