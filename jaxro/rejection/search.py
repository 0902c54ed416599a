"""A search for the orientation that most points agree with, photos in any position,
most points wrong if need be.

Random subsets of five points are solved; each of their orientations is scored by the
truncated cost

    Σ log(1 + min((r / sigma)², limit²) / FINE²),

first on some of the points, the `judges`, the best on all. Each halving of |r| lowers
it by about the same amount, down to FINE. So it tells the right orientation also where
sigma is several times too large and more points agree with another one. A cost that
grows with r² (MSAC, Torr and Zisserman 2000) does not tell it there. The best of each
block of subsets is improved on the points near it (Chum, Matas and Kittler 2003) and
replaces the best so far if it costs less. The search ends when a better orientation, of
a larger share p of the points, would have been met with the probability `confidence`:
after k subsets with 1 - (1 - p⁵ / LUCK)^k >= confidence.

Right matches that lie near each other in one photo lie near each other in the other
one. Every second block therefore draws from the points whose neighbours agree best.
This changes only the order in which orientations are met: the score knows nothing of
it, and these blocks do not count for the confidence.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.linear import linearised
from ..geometry.pairs import Pair
from ..xla.kernels import while_loop
from ..xla.passes import count, total
from . import five_points
from .hypotheses import moved_up, squares, subsets
from .robust import seen, stepped

LUCK = 2.0
"""Subsets of right points alone for one that leads to the right orientation: others are
weak, or lose their root."""

FORWARD = 128.0
"""Subsets, at least, where the base points into a photo."""

PER_SUBSET = 2
"""Orientations that are scored, at most, for each subset on the average of a block."""

GUIDED = 24
"""Blocks of which every second one is drawn from the points whose neighbours agree."""

FINE = 0.25
"""Multiple of sigma within which points are about equally near."""

FRONTS = 5
"""Halvings of the points to those whose neighbours agree best."""

SMALLEST_FRONT = 12
NEIGHBOURLY = 40
"""Points from which their neighbours say something."""

NEIGHBOURS = 1024
"""Points that are looked at as neighbours, at most."""

CLOSE = 1.5
"""Distance of a neighbour in units of the mean distance between points."""


class Found(NamedTuple):
    """The best orientation and its score; blocks of subsets so far, subsets that count,
    and how many are enough.

    `agreed` and `asked`: of the orientations that lost clearly, how many points agreed
    with them, of how many.
    """

    pose: RelativePose
    score: Float[Array, ""]
    blocks: Int[Array, ""]
    counted: Float[Array, ""]
    enough: Float[Array, ""]
    agreed: Float[Array, ""]
    asked: Float[Array, ""]


class Search(eqx.Module):
    """How to search. `limit`: multiple of sigma up to which a point agrees; `margin`:
    the factor of it for orientations of five points, which carry the errors of these.
    `block` subsets are solved together, at most `count`; `judges` points score them
    first, and the `finalists` best are scored by all points. `steps` of Gauss-Newton
    improve the best of a block, the first on points within `margin` times the limit."""

    count: int = 1 << 17
    block: int = 64
    confidence: float = 0.99
    limit: float = 3.3
    margin: float = math.sqrt(2)
    judges: int = 96
    finalists: int = 4
    steps: int = 3
    seed: int = 0

    def begin(self, pair: Pair, pose: RelativePose) -> Found:
        """A search that knows one orientation."""
        zero = jnp.zeros_like(pair.focal_left)
        return Found(
            pose=pose,
            score=score(pair, pose, self.limit),
            blocks=zero.astype(int),
            counted=zero,
            enough=self.enough(pair, pose),
            agreed=zero,
            asked=zero,
        )

    def run(
        self, pair: Pair, found: Found, worth: Float[Array, ""] | float = math.inf
    ) -> Found:
        """The search, continued until it is enough, or more subsets than it is `worth`
        have been searched."""
        most = -(-self.count // self.block)
        rows = moved_up(pair)
        order = (
            neighbourly(rows, count(pair.mask))
            if most > 1 and len(rows) >= NEIGHBOURLY
            else None
        )

        def more(found: Found) -> Bool[Array, ""]:
            return (found.blocks < most) & (
                found.counted < jnp.minimum(found.enough, worth)
            )

        return while_loop(
            more,
            lambda found: self._searched(pair, rows, order, found),
            found,
            pair.focal_left,
        )

    def enough(self, pair: Pair, pose: RelativePose) -> Float[Array, ""]:
        """How many subsets are enough, if the share of points that agree with this pose
        is that of the right ones."""
        subsets = self.enough_for(
            count(pair.mask & (squares(pair, pose) <= self.limit**2)), count(pair.mask)
        )
        return jnp.where(forward(pose), jnp.maximum(subsets, FORWARD), subsets)

    def enough_for(
        self, agree: Float[Array, ""], of: Float[Array, ""]
    ) -> Float[Array, ""]:
        """How many subsets are enough to meet the orientation of so many right
        points."""
        share = math.prod(
            jnp.maximum(agree - k, 0.0) / jnp.maximum(of - k, 1.0) for k in range(5)
        )
        share = jnp.clip(share / LUCK, 1e-12, 1 - 1e-12)
        return jnp.where(of >= 6, math.log1p(-self.confidence) / jnp.log1p(-share), 0.0)

    def _searched(
        self, pair: Pair, rows: Float[Array, "point 4"], order, found: Found
    ) -> Found:
        """After one more block."""
        of = count(pair.mask)
        poses, exist = self._hypotheses(pair, rows, order, found.blocks)
        first = _judged(pair, rows, of, poses, self.judges, self.limit * self.margin)
        first_score = jnp.where(exist, first.cost, jnp.inf)
        lost = exist & (first.agree < 0.5 * jnp.max(jnp.where(exist, first.agree, 0.0)))
        _, chosen = lax.top_k(
            -first_score.astype(jnp.float32), min(self.finalists, first_score.shape[0])
        )
        finalists = jax.tree.map(lambda a: a[chosen], poses)
        scores = jax.vmap(lambda pose: score(pair, pose, self.limit * self.margin))(
            finalists
        )
        scores = jnp.where(exist[chosen], scores, jnp.inf)
        best = jax.tree.map(lambda a: a[jnp.argmin(scores)], finalists)
        new = self._improved(pair, best)
        new_score = jnp.where(jnp.any(exist), score(pair, new, self.limit), jnp.inf)
        better = new_score < found.score
        pose = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, found.pose)
        counts = jnp.where(self._guided(found.blocks) & (order is not None), 0.0, 1.0)
        return Found(
            pose=pose,
            score=jnp.where(better, new_score, found.score),
            blocks=found.blocks + 1,
            counted=found.counted + counts * self.block,
            enough=self.enough(pair, pose),
            agreed=found.agreed
            + total(
                jnp.where(
                    lost, first.agree - 5 * first.asked / jnp.maximum(of, 1.0), 0.0
                )
            ),
            asked=found.asked + total(jnp.where(lost, first.asked, 0.0)),
        )

    def _guided(self, block: Int[Array, ""]) -> Bool[Array, ""]:
        return (block < GUIDED) & (block % 2 == 1)

    def _hypotheses(
        self, pair: Pair, rows, order, block
    ) -> tuple[RelativePose, Bool[Array, "hypothesis"]]:
        """The orientations of a block of subsets."""
        of = count(pair.mask)
        uniform = jax.random.uniform(
            jax.random.fold_in(jax.random.key(self.seed), block),
            (5, self.block),
            jnp.float32,
        )
        if order is None:
            places = subsets(uniform, of)
        else:
            front = jnp.maximum(
                of * 0.5 ** (1 + (block // 2) % FRONTS).astype(of.dtype),
                float(SMALLEST_FRONT),
            )
            guided = self._guided(block)
            places = subsets(
                uniform, jnp.where(guided, jnp.minimum(jnp.ceil(front), of), of)
            )
            places = jnp.where(
                guided, order.at[places].get(mode="clip").astype(places.dtype), places
            )
        few = rows.at[places].get(mode="clip")
        x1, y1, x2, y2 = (few[..., k] for k in range(4))
        minus = -jnp.ones_like(x1)
        left = jnp.stack([x1 / pair.focal_left, y1 / pair.focal_left, minus], axis=1)
        right = jnp.stack([x2 / pair.focal_right, y2 / pair.focal_right, minus], axis=1)
        return _gathered(five_points.solve(left, right), PER_SUBSET * self.block)

    def _improved(self, pair: Pair, pose: RelativePose) -> RelativePose:
        """Gauss-Newton on the points within a limit that narrows."""

        def step(k, pose):
            wide = self.limit * jnp.where(k < self.steps - 1, self.margin, 1.0)
            linear = linearised(pair, pose)
            return stepped(
                pose, linear, jnp.where(linear.squares <= wide**2, linear.weight, 0.0)
            )

        return lax.fori_loop(0, self.steps, step, pose)


def forward(pose: RelativePose) -> Bool[Array, ""]:
    """Whether the base points into a photo: it is nearer to the axis of the left photo
    than to its plane.

    Small turns and small shifts of the base then look alike. There are other minima,
    with nearly all points near them, and orientations of five points scatter among
    these.
    """
    _, (x, y, z) = pose.relative()
    return z**2 > x**2 + y**2


class Judgement(NamedTuple):
    """Of each orientation the truncated cost of some points, how many of them agree,
    and of how many."""

    cost: Float[Array, "hypothesis"]
    agree: Float[Array, "hypothesis"]
    asked: Float[Array, "hypothesis"]


def _gathered(
    solutions: five_points.Solutions, most: int
) -> tuple[RelativePose, Bool[Array, "hypothesis"]]:
    """The solutions that exist, one behind the other on `most` places, as poses."""
    exist = solutions.exist.reshape(-1)
    place = jnp.where(exist, jnp.cumsum(exist.astype(int)) - 1, most)
    source = jnp.zeros(most, int).at[place].set(jnp.arange(exist.shape[0]), mode="drop")
    flat = lambda a: a.reshape(*a.shape[:-2], -1)
    rotation = flat(jnp.moveaxis(solutions.rotation, 0, 2))
    base = flat(jnp.moveaxis(solutions.base, 0, 1))
    rotation, base = rotation[:, :, source], base[:, source]
    pose = jax.vmap(_pose, (2, 1))(rotation, base)
    there = jnp.arange(most) < jnp.sum(exist.astype(int))
    fine = there & jnp.isfinite(sum(jax.tree.leaves(pose)))
    one = jnp.ones_like(pose.qw)
    pose = jax.tree.map(lambda a: jnp.where(fine, a, one), pose)
    return jax.vmap(lambda pose: pose.normalise())(pose), fine


def _pose(rotation: Float[Array, "3 3"], base: Float[Array, "3"]) -> RelativePose:
    return RelativePose(
        *rot.to_quaternion(rot.as_matrix(rotation)), base[0], base[1], base[2]
    )


def _judged(
    pair: Pair, rows, of, poses: RelativePose, judges: int, limit: float
) -> Judgement:
    """What points evenly taken of all say of every orientation, in single precision."""
    size = min(judges, rows.shape[0])
    number = jnp.arange(size)
    place = jnp.where(
        of > size, jnp.floor(number.astype(of.dtype) * (of / size)).astype(int), number
    )
    there = (number.astype(of.dtype) < of).astype(jnp.float32)[:, None]
    single = lambda a: a.astype(jnp.float32)
    points = single(rows.at[place].get(mode="clip"))
    sigma = moved_up_sigma(pair).at[place].get(mode="clip")
    bound = single((limit * sigma) ** 2)[:, None]
    fundamental = lambda pose: coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    f = jax.tree.map(single, jax.vmap(fundamental)(poses))

    def one(f, point, use):
        g, square, _ = coplanarity.linearise(f, point, use)
        return g * g / square

    each = jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, 0))
    r2 = each(f, tuple(points[:, k] for k in range(4)), there[:, 0] > 0)
    costs = cost(r2 / bound * limit**2, limit)
    agree = jnp.where(r2 <= bound, there, 0.0)
    double = lambda a: a.astype(pair.focal_left.dtype)
    asked = jnp.broadcast_to(jnp.sum(there), costs.shape[1:])
    return Judgement(
        *map(double, (jnp.sum(costs * there, axis=0), jnp.sum(agree, axis=0), asked))
    )


def neighbourly(
    rows: Float[Array, "point 4"], of: Float[Array, ""]
) -> Int[Array, "point"]:
    """The places of the points, first those whose neighbours in the left photo are
    neighbours in the right one, too."""
    size = rows.shape[0]
    single = rows.astype(jnp.float32)
    there = (jnp.arange(size, dtype=of.dtype) < of).astype(jnp.float32)
    step = -(-size // NEIGHBOURS)
    others, taken = single[::step], there[::step]

    def spread(x, y):
        mean = lambda a: jnp.sum(a * there) / jnp.maximum(jnp.sum(there), 1.0)
        variance = mean(x * x) - mean(x) ** 2 + mean(y * y) - mean(y) ** 2
        return jnp.maximum(variance, 1e-12) * 4 / jnp.maximum(jnp.sum(taken), 1.0)

    near_left, near_right = (
        CLOSE**2 * spread(single[:, k], single[:, k + 1]) for k in (0, 2)
    )

    def agreement(row):
        left = (others[:, 0] - row[0]) ** 2 + (others[:, 1] - row[1]) ** 2
        right = (others[:, 2] - row[2]) ** 2 + (others[:, 3] - row[3]) ** 2
        near = taken / (1 + left / near_left) ** 2
        both = near / (1 + right / near_right) ** 2
        return jnp.sum(both) / jnp.maximum(jnp.sum(near), 1e-6)

    value = jnp.where(there > 0, jax.vmap(agreement)(single), -1.0)
    return jnp.argsort(-value)


def moved_up_sigma(pair: Pair) -> Float[Array, "point"]:
    """The standard deviations of the points that take part, moved before all others."""
    place = jnp.where(pair.mask, jnp.cumsum(pair.mask) - 1, pair.mask.shape[0])
    return jnp.ones_like(pair.sigma).at[place].set(pair.sigma, mode="drop")


def score(pair: Pair, pose: RelativePose, limit: float) -> Float[Array, ""]:
    """The cost of all points, the most of one that cannot be seen from there; infinite
    where it is no number."""
    found = jnp.where(seen(pair, pose, limit), squares(pair, pose), limit**2)
    value = total(jnp.where(pair.mask, cost(found, limit), 0.0))
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


def cost(square: Float[Array, "*points"], limit: float) -> Float[Array, "*points"]:
    """log(1 + min((r / sigma)², limit²) / FINE²) of (r / sigma)²."""
    return jnp.log1p(jnp.minimum(square, limit**2) / FINE**2)
