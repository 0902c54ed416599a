"""A search for the orientation that most points agree with, photos in any position,
most points wrong if need be.

Random subsets of five points are solved; each of their orientations is scored by the
truncated cost

    Σ log(1 + min((r / sigma)², limit²) / FINE²),

first on some of the points, the `judges`, the best on all. Each halving of |r| lowers
it by about the same amount, down to FINE. So it finds the right orientation also where
sigma is several times too large and more points agree with another orientation. A cost
that grows with r² (MSAC, Torr and Zisserman 2000) does not find it there. The best of
each block of subsets is improved on the points near it (Chum, Matas and Kittler 2003)
and replaces the best so far if it costs less. The search ends when a better orientation, of
a larger share p of the points, would have been met with the probability `confidence`:
after k subsets with 1 - (1 - p⁵ / LUCK)^k >= confidence.

Of many points every second block from the third on draws from the points whose
neighbours agree best (`neighbours`), whose order is computed then; or, of matches that
have scores, from those of the highest scores (Chum and Matas 2005), of few points as
well. This changes only the order in which orientations are met: the cost does not depend
on it, and these blocks do not count for the confidence.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..geometry import coplanarity, rotations as rot
from ..geometry.cofactor_roots import CofactorRoots
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..xla.kernels import if_needed, while_loop
from ..xla.passes import count
from . import five_points
from .agreement import points_within, squares
from .hypotheses import Poses, best
from .masked import choose, sum_of
from .neighbours import ENOUGH, order_by_neighbours
from .steps import improve_within, in_single
from .subsets import choose_places, move_up, move_up_coordinates, subsets_enough
from .visibility import seen

LUCK = 2.0
"""Subsets of right points alone for one that leads to the right orientation: others are
weak, or lose their root."""

FORWARD = 128.0
"""Subsets, at least, where the base points into a photo."""

PER_SUBSET = 2
"""Orientations that are compared, at most, for each subset on the average of a
block."""

FIRST_GUIDED, GUIDED = 2, 24
"""The first block that is drawn from the points whose neighbours agree, and the number
of blocks of which every second one then is."""

ALL_BLOCKS = 1 << 30
"""More blocks of subsets than any search solves."""

FINE = 0.25
"""Multiple of sigma within which points are about equally near."""

FRONTS = 5
"""Halvings of the points to those whose neighbours agree best."""

SMALLEST_FRONT = 12
"""Points that a guided block draws from, at least."""

CLEARLY = 0.5
"""An orientation lost clearly if fewer than this part of the points agree that agree
with the best of its block."""


Order = Int[Array, "point"] | None
"""The places of the points, those first whose neighbours agree best or whose scores are
highest; None where neither is asked."""


class Found(NamedTuple):
    """The state of a search.

    The best orientation and its cost; blocks of subsets solved, subsets that count for
    the confidence, and how many are enough. `agreed` and `asked`: of the orientations
    that lost clearly, how many points agreed with them, and of how many.
    """

    pose: RelativePose
    cost: Float[Array, ""]
    blocks: Int[Array, ""]
    counted: Float[Array, ""]
    enough: Float[Array, ""]
    agreed: Float[Array, ""]
    asked: Float[Array, ""]


def nothing_found(pose: RelativePose) -> Found:
    """The state before a search that is to begin with this orientation."""
    zero = jnp.zeros_like(pose.qw)
    none = zero.astype(int)
    return Found(
        pose=pose,
        cost=zero + jnp.inf,
        blocks=none,
        counted=zero,
        enough=zero,
        agreed=zero,
        asked=zero,
    )


class Sample(NamedTuple):
    """The points of a pair for a search: coordinates, sigma, roots and scores of those
    that take part, before all others, and how many they are."""

    rows: Float[Array, "point 4"]
    sigma: Float[Array, "point"]
    of: Float[Array, ""]
    roots: CofactorRoots | None
    score: Float[Array, "point"] | None

    @property
    def has_order(self) -> bool:
        """Whether there are scores, or points enough that neighbours may say
        something."""
        return self.score is not None or len(self.rows) >= ENOUGH

    def update_order(
        self, order: Int[Array, "point"], needed: Bool[Array, ""]
    ) -> Int[Array, "point"]:
        """The order by scores or neighbours where it is needed, else the one there
        is."""

        def rank(needed: Bool[Array, ""]) -> Int[Array, "point"]:
            if self.score is None:
                return order_by_neighbours(self.rows, jnp.where(needed, self.of, 0.0))
            there = jnp.arange(len(self.score), dtype=self.of.dtype) < self.of
            known = there & jnp.isfinite(self.score)
            return jnp.argsort(jnp.where(known, -self.score, jnp.inf))

        return if_needed(needed, rank, order)


class Search(eqx.Module):
    """How to search.

    `limit`: multiple of sigma up to which a point agrees; `margin`: the factor of it
    for orientations of five points, which carry the errors of these. `block` subsets
    are solved together, at most `count`; `judges` points compare their orientations
    first, and all points compare the `finalists`, the best. `steps` of Gauss-Newton
    improve the best of a block.
    """

    count: int = 1 << 17
    block: int = 64
    confidence: ScalarLike = 0.99
    limit: ScalarLike = 3.3
    margin: ScalarLike = math.sqrt(2)
    judges: int = 96
    finalists: int = 4
    steps: int = 3
    seed: int = 0

    def begin(self, pair: Pair, pose: RelativePose) -> Found:
        """The state of a search that knows one orientation."""
        cost, enough = cost_of(pair, pose, self.limit), self._enough(pair, pose)
        return nothing_found(pose)._replace(cost=cost, enough=enough)

    def run(
        self,
        pair: Pair,
        found: Found,
        worth: Float[Array, ""] | float = math.inf,
        blocks: Int[Array, ""] | int = ALL_BLOCKS,
    ) -> Found:
        """The search, continued until it is enough, or until as many subsets as it is
        `worth`, or so many `blocks`, have been solved."""
        most = -(-self.count // self.block)
        sample = _sample(pair)
        guided = sample.has_order and most > FIRST_GUIDED
        most = jnp.minimum(most, blocks)

        def more(state: tuple[Found, Order]) -> Bool[Array, ""]:
            found, _ = state
            wanted = jnp.minimum(found.enough, worth)
            return (found.blocks < most) & (found.counted < wanted)

        def step(state: tuple[Found, Order]) -> tuple[Found, Order]:
            found, order = state
            if order is not None:
                order = sample.update_order(order, found.blocks == FIRST_GUIDED)
            return self._search_block(pair, sample, order, found), order

        order = jnp.arange(len(sample.rows)) if guided else None
        return while_loop(more, step, (found, order), pair.focal_left)[0]

    def enough_for(
        self, agree: Float[Array, ""], of: Float[Array, ""]
    ) -> Float[Array, ""]:
        """How many subsets are enough to meet the orientation of so many right
        points."""
        enough = subsets_enough(agree, of, 5, self.confidence, LUCK)
        return jnp.where(of >= 6, enough, 0.0)

    def _enough(self, pair: Pair, pose: RelativePose) -> Float[Array, ""]:
        """How many subsets are enough, if the share of points that agree with this pose
        is the share of the right ones."""
        agree = count(points_within(pair, pose, self.limit))
        enough = self.enough_for(agree, count(pair.mask))
        return jnp.where(forward(pose), jnp.maximum(enough, FORWARD), enough)

    def _search_block(
        self, pair: Pair, sample: Sample, order: Order, found: Found
    ) -> Found:
        """The state after one more block of subsets."""
        wide = self.limit * self.margin
        poses, exist = self._solve_block(pair, sample, order, found.blocks)
        first = _compare(pair, sample, poses, self.judges, wide)
        new = self._best(pair, poses, exist, first.cost)
        new = improve_within(pair, new, self.limit, self.margin, self.steps)
        new_cost = cost_of(pair, new, self.limit)
        new_cost = jnp.where(jnp.any(exist), new_cost, jnp.inf)
        better = new_cost < found.cost
        pose = choose(better, new, found.pose)

        most = jnp.max(jnp.where(exist, first.agree, 0.0))
        lost = exist & (first.agree < CLEARLY * most)
        # the five points of a subset agree with its orientations in any case
        own = 5 * first.asked / jnp.maximum(sample.of, 1.0)
        guided = self._is_guided(found.blocks) & (order is not None)
        return Found(
            pose=pose,
            cost=jnp.where(better, new_cost, found.cost),
            blocks=found.blocks + 1,
            counted=found.counted + jnp.where(guided, 0.0, 1.0) * self.block,
            enough=self._enough(pair, pose),
            agreed=found.agreed + sum_of(first.agree - own, lost),
            asked=found.asked + sum_of(first.asked, lost),
        )

    def _best(
        self,
        pair: Pair,
        poses: RelativePose,
        exist: Bool[Array, "hypothesis"],
        first: Float[Array, "hypothesis"],
    ) -> RelativePose:
        """The best of a block by all points, of the finalists by their `first` cost."""
        first = jnp.where(exist, first, jnp.inf).astype(jnp.float32)
        finalists = min(self.finalists, len(first))
        _, chosen = lax.top_k(-first, finalists)
        finalists = jax.tree.map(lambda a: a[chosen], poses)
        wide = self.limit * self.margin
        costs = jax.vmap(lambda pose: cost_of(pair, pose, wide))(finalists)
        return best(finalists, jnp.where(exist[chosen], costs, jnp.inf))

    def _is_guided(self, block: Int[Array, ""]) -> Bool[Array, ""]:
        return (block >= FIRST_GUIDED) & (block < GUIDED) & (block % 2 == 0)

    def _solve_block(
        self, pair: Pair, sample: Sample, order: Order, block: Int[Array, ""]
    ) -> Poses:
        """The orientations of a block of subsets."""
        key = jax.random.fold_in(jax.random.key(self.seed), block)
        uniform = jax.random.uniform(key, (5, self.block), jnp.float32)
        of = sample.of
        if order is None:
            places = choose_places(uniform, of)
        else:
            halvings = 1 + (block // 2 - 1) % FRONTS
            front = jnp.maximum(
                of * 0.5 ** halvings.astype(of.dtype), float(SMALLEST_FRONT)
            )
            front = jnp.minimum(jnp.ceil(front), of)
            guided = self._is_guided(block)
            places = choose_places(uniform, jnp.where(guided, front, of))
            in_order = order.at[places].get(mode="clip").astype(places.dtype)
            places = jnp.where(guided, in_order, places)
        few = sample.rows.at[places].get(mode="clip")
        left = _vectors(few[..., 0], few[..., 1], pair.focal_left)
        right = _vectors(few[..., 2], few[..., 3], pair.focal_right)
        return _gather(five_points.solve(left, right), PER_SUBSET * self.block)


def forward(pose: RelativePose) -> Bool[Array, ""]:
    """Whether the base points into a photo: it is nearer to the axis of the left photo
    than to its plane.

    Small turns and small shifts of the base then look alike. There are other minima,
    with nearly all points near them, and orientations of five points scatter among
    these.
    """
    _, (x, y, z) = pose.relative()
    return z**2 > x**2 + y**2


def cost_of(pair: Pair, pose: RelativePose, limit: ScalarLike) -> Float[Array, ""]:
    """The cost of all points, the most for one that cannot be seen from there; infinite
    where it is no number."""
    square = squares(pair, pose)
    near = pair.mask & (square <= limit**2)
    square = jnp.where(seen(pair, pose, limit, near), square, limit**2)
    value = sum_of(_point_cost(square, limit), pair.mask)
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


def _point_cost(
    square: Float[Array, "*points"], limit: ScalarLike
) -> Float[Array, "*points"]:
    """log(1 + min((r / sigma)², limit²) / FINE²) of (r / sigma)²."""
    cut = jnp.minimum(square, limit**2)
    return jnp.log1p(cut / FINE**2)


def _sample(pair: Pair) -> Sample:
    """The points of a pair for a search."""
    return Sample(
        rows=move_up_coordinates(pair),
        sigma=move_up(pair, pair.sigma, fill=1.0),
        of=count(pair.mask),
        roots=jax.tree.map(lambda a: move_up(pair, a, fill=1.0), pair.roots),
        score=jax.tree.map(lambda a: move_up(pair, a, fill=jnp.nan), pair.score),
    )


def _vectors(
    x: Float[Array, "5 subset"], y: Float[Array, "5 subset"], focal: Float[Array, ""]
) -> Float[Array, "5 3 subset"]:
    """The image vectors (x/f, y/f, -1)."""
    minus = -jnp.ones_like(x)
    return jnp.stack([x / focal, y / focal, minus], axis=1)


def _gather(solutions: five_points.Solutions, most: int) -> Poses:
    """The solutions that exist, one behind the other on `most` places, as poses."""
    exist = solutions.exist.reshape(-1)
    reached = jnp.cumsum(exist.astype(int))
    place = jnp.where(exist, reached - 1, most)
    index = jnp.arange(len(exist))
    source = jnp.zeros(most, int).at[place].set(index, mode="drop")

    def gather(a):
        flat = a.reshape(*a.shape[:-2], -1)
        return flat[..., source]

    rotation = gather(jnp.moveaxis(solutions.rotation, 0, 2))
    base = gather(jnp.moveaxis(solutions.base, 0, 1))
    pose = jax.vmap(_pose, (2, 1))(rotation, base)
    there = jnp.arange(most) < reached[-1]
    finite = jnp.isfinite(sum(jax.tree.leaves(pose)))
    fine = there & finite
    one = jnp.ones_like(pose.qw)
    pose = jax.tree.map(lambda a: jnp.where(fine, a, one), pose)
    return jax.vmap(RelativePose.normalise)(pose), fine


def _pose(rotation: Float[Array, "3 3"], base: Float[Array, "3"]) -> RelativePose:
    quaternion = rot.to_quaternion(rot.as_matrix(rotation))
    return RelativePose(*quaternion, base[0], base[1], base[2])


class Comparison(NamedTuple):
    """Of each orientation the cost of some points, how many of them agree, and of how
    many."""

    cost: Float[Array, "hypothesis"]
    agree: Float[Array, "hypothesis"]
    asked: Float[Array, "hypothesis"]


def _compare(
    pair: Pair, sample: Sample, poses: RelativePose, judges: int, limit: ScalarLike
) -> Comparison:
    """The cost of every orientation for points evenly taken of all, in single
    precision."""
    points, sigma, roots, there = _judges(sample, judges)
    bound = ((limit * sigma) ** 2).astype(jnp.float32)[:, None]
    fundamental = lambda pose: coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    matrices = in_single(jax.vmap(fundamental)(poses))
    of_poses = jax.vmap(_square, (0, None, None, None))
    of_points = jax.vmap(of_poses, (None, 0, 0, 0))
    r2 = of_points(matrices, points, there > 0, roots)
    weight = there[:, None]
    costs = _point_cost(r2 / bound * limit**2, limit)
    cost = jnp.sum(costs * weight, axis=0)
    agree = jnp.sum(jnp.where(r2 <= bound, weight, 0.0), axis=0)
    asked = jnp.broadcast_to(jnp.sum(there), cost.shape)
    double = lambda a: a.astype(pair.focal_left.dtype)
    return Comparison(cost=double(cost), agree=double(agree), asked=double(asked))


def _square(
    f: tuple,
    point: Float[Array, "4"],
    use: Bool[Array, ""],
    roots: CofactorRoots | None,
) -> Array:
    """r² of a point under the fundamental matrix F."""
    g, variance, _ = coplanarity.linearise(f, tuple(point), use, roots)
    return g * g / variance


def _judges(
    sample: Sample, judges: int
) -> tuple[Array, Array, CofactorRoots | None, Array]:
    """Coordinates, sigma and roots of points evenly taken of all, and 1 for those that
    exist."""
    size = min(judges, sample.rows.shape[0])
    number = jnp.arange(size)
    exact = number.astype(sample.of.dtype)
    spread = jnp.floor(exact * (sample.of / size)).astype(int)
    place = jnp.where(sample.of > size, spread, number)
    taken = lambda a: a.at[place].get(mode="clip")
    points, roots = in_single(jax.tree.map(taken, (sample.rows, sample.roots)))
    return points, taken(sample.sigma), roots, (exact < sample.of).astype(jnp.float32)
