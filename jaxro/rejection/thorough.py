"""The search for pairs that nothing quicker decides: hypotheses in any position, and
the evidence for the best."""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import planes
from ..xla.kernels import if_needed, while_loop
from ..xla.passes import count, total
from . import evidence
from .graduated_non_convexity import GraduatedNonConvexity
from .hypotheses import Newton, squares
from .noise import noise_of
from .ransac import Ransac
from .robust import reweighted
from .search import Found, Search, score
from .stages import (
    DEVIATIONS,
    AbstractStage,
    Decision,
    Use,
    believed_if_it_fits,
    from_vertical,
    on_a_plane,
    rescaled,
    settled,
)

OVERWHELMING = math.log(1e-9)
"""Logarithm of an expected number of accidents at which a search that came to its end
is believed in any case."""

PLENTY = 64.0
"""Points up to which `accidents` holds as it is. For more, n, it is raised to the power
of n / PLENTY: the more points there are, the larger are the groups of repeated
structure, which agree with many orientations."""

TURNS = 2
"""Searches, the second one with the noise that the first one found."""

APART = 0.6
"""Ratio of the noise found to that taken, or of that taken to that found, below which a
search begins again."""

MAJORITY = 0.4
"""Part of the points that agreed before that the noise has to be that of: a few points
may agree by accident."""

SURE = 30.0
"""Redundancy of the noise found from which it may contradict the sigma stated: of fewer
points some fit by accident."""

NARROWER, NARROWINGS = 0.7, 12
"""By how much the limit narrows in two steps, and how many steps: down to an eighth."""

MOST = 20.0
"""How many times larger or smaller than that taken at first the noise may be."""


class Thorough(AbstractStage):
    """Random subsets in any position until a better orientation would have been met,
    and the evidence for what is found.

    It begins with the best of all points from the vertical, the graduated search, and
    for at most `few` points many subsets solved from the vertical: of few points that
    finds what a search in any position takes long for. What is found is believed if it
    fits as `Quick` asks, with `accidents_at_once`; or if the subsets were enough to
    have met a set of `better` times as many points, and sets as good are not expected
    by accident more than `accidents` times (of many points more seldom), by the chance
    of agreement that partners shifted among the points and the orientations that lost
    have on this scene. Points that repeat others count once. Of a plane with other
    points beside it both poses are compared. The search ends when no set that it could
    still find would be believed, after at least `least` subsets, so that the pose is as
    good as it can be where nothing is believed.

    Where the residuals leave no doubt that sigma is much too large, the search begins
    again with the noise that they show, by which the points are then judged, too; where
    sigma is not `known` they always are.
    """

    graduated: GraduatedNonConvexity = GraduatedNonConvexity()
    near: Ransac = Ransac(hypotheses=Newton(block=64), count=1024, limit=5.0)
    few: int = 32
    search: Search = Search()
    share: float = 0.4
    accidents_at_once: float = 0.02
    accidents: float = 1e-3
    better: float = 1.5
    least: int = 256
    known: bool = True

    def __call__(self, pair: Pair, limit: Float[Array, ""]) -> Decision:
        again, key = evidence.repeats(pair)
        once = mask_unusable(pair.with_mask(pair.mask & ~again))[0]
        found, scale = self._searched(once, self._near_vertical(once), limit)
        once = rescaled(once, scale)
        pose, use = _of_both_poses(once, *settled(once, found.pose, limit), limit)

        chance = jnp.maximum(
            _chance(once, pose, use, limit),
            found.agreed / jnp.maximum(found.asked, 1.0),
        )
        of = count(once.mask)
        expected = evidence.least_accidents(squares(once, pose), use, chance, of, limit)
        enough = self.search.enough_for(jnp.minimum(self.better * count(use), of), of)
        thorough = (found.counted >= enough) | (expected <= OVERWHELMING)
        certain = (expected <= self._most(of)) & thorough
        at_once = (
            believed_if_it_fits(
                once, pose, use, limit, self.share, self.accidents_at_once
            ).believed
            & self.known
        )
        return Decision(
            pose, evidence.with_repeats(use, again, key), certain | at_once, scale
        )

    def _searched(
        self, pair: Pair, first: RelativePose, limit: Float[Array, ""]
    ) -> tuple[Found, Float[Array, ""]]:
        """The search from a first pose, and the noise to judge by, as a multiple of
        that stated."""

        def turn(state):
            k, _, scale, found = state
            own = rescaled(pair, scale)
            found = self.search.run(
                own,
                self.search.begin(own, found.pose),
                self._worth(own, found.pose, limit),
            )
            narrowed = _narrowed(own, found.pose, self.search.limit)
            noise = noise_of(squares(pair, narrowed), pair.mask)
            upper = noise.sigma * (
                1 + DEVIATIONS / jnp.sqrt(2 * jnp.maximum(noise.redundancy, 0.5))
            )
            agreed = count(squares(own, found.pose) <= self.search.limit**2)
            of_most = noise.redundancy >= MAJORITY * agreed
            too_large = (upper < APART * scale) & (noise.redundancy >= SURE)
            taken = noise.known & of_most & (too_large | (not self.known))
            new = jnp.where(taken, jnp.clip(noise.sigma, 1 / MOST, MOST), scale)
            apart = (new < APART * scale) | (scale < APART * new)
            pose = jax.tree.map(
                lambda a, b: jnp.where(apart, a, b), narrowed, found.pose
            )
            return k + 1, apart, new, found._replace(pose=pose)

        one = jnp.ones_like(limit)
        start = (
            jnp.zeros((), int),
            count(pair.mask) > 0,
            one,
            self.search.begin(pair, first),
        )
        _, _, scale, found = while_loop(
            lambda state: state[1] & (state[0] < TURNS), turn, start, pair.focal_left
        )
        return found, scale

    def _worth(
        self, pair: Pair, pose: RelativePose, limit: Float[Array, ""]
    ) -> Float[Array, ""]:
        """How many subsets are worth it: enough to meet the smallest set that would be
        believed."""
        of = count(pair.mask)
        use = pair.mask & (squares(pair, pose) <= limit**2)
        fewest = evidence.fewest(
            _chance(pair, pose, use, limit), of, self._most(of), pair.mask.shape[0]
        )
        return jnp.maximum(self.search.enough_for(fewest, of), float(self.least))

    def _most(self, of: Float[Array, ""]) -> Float[Array, ""]:
        """Logarithm of the expected number of accidents up to which a set of so many
        points is believed."""
        return math.log(self.accidents) * jnp.maximum(of / PLENTY, 1.0)

    def _near_vertical(self, pair: Pair) -> RelativePose:
        """The best orientation of those that begin at the vertical."""
        small = mask_unusable(
            pair.with_mask(pair.mask & (count(pair.mask) <= self.few))
        )[0]
        best = from_vertical(pair, 8)
        for other in (self.graduated.search(pair), self.near.search(small)):
            better = score(pair, other, self.search.limit) < score(
                pair, best, self.search.limit
            )
            best = jax.tree.map(
                lambda a, b, better=better: jnp.where(better, a, b), other, best
            )
        return best


def _chance(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> Float[Array, ""]:
    """The chance that a wrong point agrees with a pose."""
    agreed, asked = evidence.shifted_agreement(pair, pose, limit)
    spread = evidence.scattered(squares(pair, pose), pair.mask & ~use, limit) / 2
    return jnp.maximum((agreed + 1) / (asked + 2), spread)


def _of_both_poses(
    pair: Pair, pose: RelativePose, use: Use, limit: Float[Array, ""]
) -> tuple[RelativePose, Use]:
    """Where the points in use are those of a plane, and others are out, the one of its
    two poses that costs less."""
    facing, plane, alone = on_a_plane(pair, pose, use, limit)

    def cost(pose, use):
        return total(
            jnp.where(pair.mask, jnp.where(use, squares(pair, pose), limit**2), 0.0)
        )

    def chosen(needed):
        own = pair.with_mask(pair.mask & needed)
        other, exists = planes.second(
            own.with_mask(plane.within & needed), facing, plane.normal
        )
        other, others = settled(own, other, limit)
        better = exists & (cost(other, others) < cost(pose, use))
        return jax.tree.map(
            lambda a, b: jnp.where(better, a, b), (other, others), (pose, use)
        )

    return if_needed(alone, chosen, (pose, use))


def _narrowed(pair: Pair, pose: RelativePose, limit: float) -> RelativePose:
    """The pose that the points near it lead to, as the limit within which they count
    narrows (graduated weights of Geman and McClure): where sigma is too large, wrong
    points within the limit hide the right pose from a search."""

    def step(k, pose):
        width = limit * NARROWER ** (k / 2)
        return reweighted(pair, pose, lambda s: 1 / (1 + s / width**2) ** 2)

    steps = jnp.arange(NARROWINGS, dtype=pair.focal_left.dtype)
    return lax.scan(lambda pose, k: (step(k, pose), None), pose, steps)[0]
