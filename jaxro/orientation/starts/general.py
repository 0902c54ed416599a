"""The start for photos in any position: candidates from closed forms, chosen by
cheirality and residual.

Candidates are the five-point solutions of several spread subsets, the eight-point
solution and the vertical case. Those with most points in front of both photos and the
smallest distances are refined by Gauss-Newton, each different from the others, so that
a second orientation that fits as well is seen and reported.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ...adjustment.normal_equations import steps
from ...geometry import rotations as rot
from ...geometry.coplanarity import common_focal
from ...geometry.elements import RelativePose, vertical
from ...geometry.pairs import Pair, mask_unusable, pad
from ...xla.programs import compiled
from ...xla.selection import where_needed
from .. import degeneracy, planes
from ..degeneracy import significant
from ..inspection import Inspection, inspect
from .base import AbstractStart, StartingPose, distances
from .decomposition import best_pose
from .eight_point import eight_point
from .five_point import five_point

EXACT = 1e-18
"""Mean square distance over f² that is rounding. Among such solutions, as five points
have them, the first is taken: rounding would choose another one in another program."""

JUDGES = 64
"""Points that are enough to tell candidates apart; only the two best are refined by and
compared over all points."""

FINAL = 2
"""Gauss-Newton steps of these two: what is right for the judges is nearly so for
all."""

BEHIND = 0.25
"""Share of points behind a photo above which a candidate counts as a wrong
decomposition."""

ENOUGH = 10
"""Points that are enough for a start."""

AT_ONCE, ON_DEVICES = 1 << 7, 1 << 17
"""Points that are worked on together under a caller's `vmap`, at 15 kB each: what stays
in the cache of a processor, and what keeps other devices busy."""


class General(AbstractStart):
    """Candidates from `subsets` five-point problems; the `refined` best different ones
    take `steps` Gauss-Newton steps.

    With five points all solutions are candidates; with a plane scene two remain, and
    `ambiguous` says so.
    """

    subsets: int = 6
    refined: int = 4
    steps: int = 6

    def __call__(self, pair: Pair) -> StartingPose:
        no = jnp.zeros_like(pair.focal_left, bool)
        nothing = StartingPose(vertical(pair.focal_left), no, no)
        points = AT_ONCE if jax.default_backend() == "cpu" else ON_DEVICES
        most = max(points // max(pair.x_left.shape[0], 1), 1)
        return where_needed(
            lambda pair: _begin(pair, start=self),
            jnp.any(pair.mask),
            lax.stop_gradient(pair),
            nothing,
            most,
        )

    def begin(self, pair: Pair) -> StartingPose:
        """The pose to begin with, whether it is needed or not."""
        # of no points there are no candidates to choose from
        pair = _accurate(pad(pair, max(pair.x_left.shape[0], 1)))
        best, exist = self._two_best(pair)
        inspected = jax.vmap(lambda pose: inspect(pair, pose))(best)
        first, second = (jax.tree.map(lambda a, i=i: a[i], inspected) for i in (0, 1))
        turn, parallax = rotation_only(*vectors(pair), pair.mask)
        freedom = jnp.maximum(pair.count - 5, 1.0)
        noise = first.distance * jnp.sqrt(pair.count / freedom)
        focal = common_focal(pair.focal_left, pair.focal_right)
        noise = noise * pair.focal_left / focal
        pure = parallax < significant(pair.count - 5) * noise + 1e-9
        fits = (second.behind <= BEHIND) & _fits_as_well(pair, first, second)
        pose = jax.tree.map(lambda a, b: jnp.where(pure, a, b[0]), turn, best)
        return StartingPose(pose, exist[1] & fits & ~pure, pure)

    def _two_best(self, pair: Pair) -> tuple[RelativePose, Bool[Array, "2"]]:
        """The best candidate and the best other one, and which of them exist."""
        judges = _spread(pair, JUDGES)
        poses, real = self._candidates(pair, judges)
        chosen, found = _best_different(judges, poses, real, self.refined)
        chosen = jax.vmap(lambda pose: _refine(judges, pose, self.steps))(chosen)
        best, exist = _best_different(judges, chosen, found, 2)
        if judges is not pair:
            best = jax.vmap(lambda pose: _refine(pair, pose, FINAL))(best)
            best, exist = _best_different(pair, best, exist, 2)
        return _with_twin(pair, best, exist)

    def _candidates(
        self, pair: Pair, judges: Pair
    ) -> tuple[RelativePose, Bool[Array, " candidate"]]:
        """Poses, each with the base on whose side the judges see most points, and which
        of them are solutions."""
        seen = *vectors(judges), judges.mask
        pick = _subsets(judges.mask, self.subsets)
        gather = lambda vectors: jnp.sum(
            pick[:, :, :, None] * vectors[None, None, :, :], axis=2
        )
        essentials, real = jax.vmap(five_point)(*map(gather, seen[:2]))
        linear = eight_point(*vectors(pair), pair.mask.astype(pair.x_left.dtype))
        essentials = jnp.concatenate([essentials.reshape(-1, 3, 3), linear[None]])
        real = jnp.concatenate([real.reshape(-1), (pair.count >= 8)[None]])
        real = real & jnp.all(jnp.isfinite(essentials), axis=(1, 2))
        essentials = jnp.where(real[:, None, None], essentials, jnp.eye(3))
        poses, _ = jax.vmap(lambda e: best_pose(e, *seen))(essentials)
        normal_case = jax.tree.map(lambda a: a[None], vertical(pair.focal_left))
        poses = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), poses, normal_case)
        return poses, jnp.concatenate([real, jnp.ones(1, bool)])


@compiled
def _begin(pair: Pair, *, start: General) -> StartingPose:
    """`General.begin` as a part of the programs that hold it, traced once for all."""
    return start.begin(pair)


def _fits_as_well(pair: Pair, first: Inspection, second: Inspection) -> Bool[Array, ""]:
    """Whether the second pose fits as well as the first, for the measuring errors."""
    squares = first.distance**2
    freedom = pair.count - 5
    # distances over f in place of residuals: sigma over f is their unit
    unit = jnp.where(first.sigma > 0, first.sigma, 1.0) / pair.focal_left
    weight = pair.count / unit**2
    sigma0 = jnp.sqrt(squares * weight / jnp.maximum(freedom, 1.0))
    noise = degeneracy.noise(sigma0, freedom, first.sigma, pair.focal_left)
    return second.distance**2 < noise.tolerance(squares * weight) / weight + EXACT


def _spread(pair: Pair, count: int) -> Pair:
    """At most so many of the points, evenly spread over the numbering."""
    if pair.x_left.shape[0] <= count:
        return pair
    number = jnp.cumsum(pair.mask)
    total = number[-1]
    rank = jnp.arange(count)
    rank = jnp.where(total > count, rank * total // count, rank)
    use = rank < total
    place = jnp.searchsorted(number, rank + 1)
    of_points = *pair.coordinates, pair.sigma, pair.roots
    chosen = jax.tree.map(lambda a: a.at[place].get(mode="clip"), of_points)
    *coordinates, sigma, roots = chosen
    return Pair(
        *(jnp.where(use, c, 0.0) for c in coordinates),
        jnp.where(use, sigma, 1.0),
        use,
        pair.focal_left,
        pair.focal_right,
        roots,
    )


def _accurate(pair: Pair) -> Pair:
    """The pair without its coarse points, of which a start has nothing to learn, if
    enough are left."""
    good = pair.mask & ~pair.coarse
    return mask_unusable(
        pair.with_mask(jnp.where(jnp.sum(good) >= ENOUGH, good, pair.mask))
    )[0]


def vectors(pair: Pair) -> tuple[Float[Array, "point 3"], Float[Array, "point 3"]]:
    """Image vectors p / f."""
    of = lambda x, y, f: jnp.stack([x / f, y / f, -jnp.ones_like(x)], axis=-1)
    return of(pair.x_left, pair.y_left, pair.focal_left), of(
        pair.x_right, pair.y_right, pair.focal_right
    )


def _subsets(mask: Bool[Array, " point"], count: int) -> Float[Array, "subset 5 point"]:
    """Five points each, spread over the numbering, no two subsets the same where there
    are more than five points.

    As selection matrices. The points in the order of Fibonacci hashing, in which those
    that follow one another are far apart, are a ring, of which the subsets are pieces
    that begin evenly spaced.
    """
    number = (jnp.cumsum(mask) - 1).astype(jnp.uint32)
    total = jnp.maximum(jnp.sum(mask), 1)
    hashed = number * jnp.uint32(2654435769)  # 2³² over the golden ratio
    ring = jnp.argsort(jnp.where(mask, hashed >> 1, jnp.uint32(1 << 31)))
    begin = jnp.arange(count)[:, None] * jnp.maximum(total // count, 1)
    pick = ring[(begin + jnp.arange(5)[None, :]) % total]
    return (
        (pick[:, :, None] == jnp.arange(mask.size)[None, None, :]) & mask[None, None, :]
    ).astype(jnp.result_type(float))


def _scores(pair: Pair, poses: RelativePose) -> Float[Array, " candidate"]:
    """Mean square distance over f², plus one where too many points lie behind a
    photo."""

    def one(pose):
        inspected = inspect(pair, pose)
        wrong = jnp.where(inspected.behind > BEHIND, 1.0, 0.0)
        score = jnp.maximum(inspected.distance**2, EXACT) + wrong
        return jnp.where(jnp.isfinite(score), score, jnp.inf)

    return jax.vmap(one)(poses)


def _best_different(
    pair: Pair, poses: RelativePose, real: Bool[Array, " candidate"], count: int
):
    """The `count` best of the real candidates that differ from one another, best first,
    and which of them exist."""
    score = jnp.where(real, _scores(pair, poses), jnp.inf)

    def body(k, state):
        chosen, found, score = state
        best = jnp.arange(score.shape[0]) == jnp.argmin(score)
        pose = jax.tree.map(lambda a: jnp.sum(jnp.where(best, a, 0.0)), poses)
        there = jnp.isfinite(jnp.min(score))
        here = jnp.arange(count) == k
        chosen = jax.tree.map(lambda a, b: jnp.where(here, b, a), chosen, pose)
        found = jnp.where(here, there, found)
        near = jax.vmap(lambda other: planes.similar(pose, other))(poses)
        return chosen, found, jnp.where(near | best, jnp.inf, score)

    empty = jax.tree.map(lambda a: jnp.zeros(count, a.dtype), poses)
    chosen, found, _ = lax.fori_loop(
        0, count, body, (empty, jnp.zeros(count, bool), score)
    )
    return chosen, found


def _with_twin(pair: Pair, best: RelativePose, alone: Bool[Array, "2"]):
    """The two best of these two and of the second orientation that the first has if the
    points lie in a plane."""
    first = jax.tree.map(lambda a: a[0], best)
    normal = planes.nearest_normal(pair, first, pair.mask)
    twin, exists = planes.second(pair, first, normal)
    three = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), best, twin)
    return _best_different(pair, three, jnp.concatenate([alone, exists[None]]), 2)


def _refine(pair: Pair, pose: RelativePose, count: int) -> RelativePose:
    """The pose after some Gauss-Newton steps, or unchanged where they fail."""
    step = steps(distances(pair, pose), pose.origin, count, 0.3)
    moved = pose.move(step).normalise()
    better = inspect(pair, moved).distance <= inspect(pair, pose).distance
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), moved, pose)


def rotation_only(left, right, mask) -> tuple[RelativePose, Float[Array, ""]]:
    """The rotation that best turns the right directions into the left ones, and the
    parallax (rad) it leaves.

    The quaternion is the eigenvector of Davenport's 4x4 matrix of the largest
    eigenvalue, found by repeated squaring.
    """
    unit = lambda v: v / jnp.sqrt(jnp.sum(v * v, axis=-1, keepdims=True))
    p, r = unit(left), unit(right)
    weight = jnp.where(mask, 1.0, 0.0)
    s = jnp.sum(weight[:, None, None] * p[:, :, None] * r[:, None, :], axis=0)
    z = (s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1])
    trace = s[0, 0] + s[1, 1] + s[2, 2]
    corner = s + s.T - trace * jnp.eye(3)
    side = jnp.stack(z)
    k = jnp.concatenate(
        [
            jnp.concatenate([trace[None], side])[None],
            jnp.concatenate([side[:, None], corner], axis=1),
        ]
    )
    # all eigenvalues positive, so that squaring favours the largest
    k = k + jnp.sum(weight) * jnp.eye(4)

    def square(_, k):
        k = k / jnp.sqrt(jnp.sum(k * k))
        return jnp.sum(k[:, :, None] * k[None, :, :], axis=1)

    k = lax.fori_loop(0, 40, square, k / jnp.maximum(jnp.sum(weight), 1.0))
    longest = jnp.arange(4) == jnp.argmax(jnp.diagonal(k))
    q = jnp.sum(jnp.where(longest[None, :], k, 0.0), axis=1)
    q = q / jnp.sqrt(jnp.sum(q * q))
    zero = jnp.zeros_like(q[0])
    pose = RelativePose(*q, *(zero + 1, zero, zero)).normalise()
    rotation, _ = pose.relative()
    turned = jax.vmap(lambda v: rot.as_array(rot.apply(rotation, (v[0], v[1], v[2]))))(
        r
    )
    chord = jnp.sum((turned - p) ** 2, axis=1)
    return pose, jnp.sqrt(jnp.sum(weight * chord) / jnp.maximum(jnp.sum(weight), 1.0))
