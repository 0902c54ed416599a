"""The orientation of image pairs from automatic matches, a good part of them wrong, photos in any position.

1. A search by random subsets on at most SEARCHED matches, evenly taken: of eight points, solved linearly.
2. All matches are judged anew by |w| at the familywise LEVEL, in turns with least squares. A match whose rays meet
   behind a photo is wrong, unless they are parallel within their errors.
3. Where the subsets tried do not suffice for the share of matches that is kept, or the pair is not oriented by them
   (eight points of a plane determine nothing), the same with subsets of five points. They suffice when a better pose
   would have been met with the probability `confidence`: many good points agree with wrong poses, too, so that their
   number alone does not prove a pose.
4. The set that is left is believed if sets as good are not expected by accident (Moisan and Stival 2004):

       C(n, k) C(k, 5) p^(k-5) (n - 5) < ACCIDENTS,

   p the share of matches that agree when every point is given the partner of another one.
"""

import enum
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int

from .. import critical_values, rotations as rot
from ..elements import RelativePose
from ..normal_equations import accumulate, solve
from ..orientation import orient
from ..pairs import Pair, cleaned
from ..reductions import count
from ..rejection.hypotheses import EightPoint, FivePoint, moved_up, squares, vectors
from ..rejection.ransac import Ransac
from ..rejection.robust import agreeing, improved, in_front, parallel, seen
from ..results import RESULTS, is_usable
from ..starts.general import rotation_only

SEARCHED = 256
EIGHT = Ransac(EightPoint(block=32), count=128, confidence=0.9, limit=5.0)
FIVE = Ransac(FivePoint(block=16), count=1024, confidence=0.99, limit=5.0)
"""Enough down to a third of right matches."""

LEVEL = 0.3
"""Probability that a pair without wrong matches loses one: there are many, and each wrong one that is kept costs more.
"""

SLACK = 0.1
ROUNDS = 10
STEPS = 3
WIDE = 3.0
SHIFTS, TRIALS = 8, 4096
"""Other partners that each point is given: at least so many, more where there are few points, to make so many trials.
"""

ACCIDENTS = 1e-4
TURNS = 3
"""Of the rotation without a base, each by the matches that the last one takes along."""

ALIKE, CHANCE = 3.0, 0.05
"""Wrong matches that agree on a base chosen for them, and the share of the others that agree by chance."""

PLANE = 0.8
"""Share of the kept matches in a plane from which on that plane alone determines the pose."""


class Kind(enum.IntEnum):
    """How the orientation of a pair from its matches ended."""

    oriented = 0
    plane = 1
    rotation = 2
    weak = 3
    no_consensus = 4
    too_few = 5


class Found(eqx.Module):
    """Matches kept, the pose by them (w, x, y, z; R; unit base), n of the plane n · λ p1 / f1 = 1 nearest to them, and
    what that is worth: sigma0 and the number of a `Kind`."""

    kept: Bool[Array, "*pairs match"]
    quaternion: Float[Array, "*pairs 4"]
    rotation: Float[Array, "*pairs 3 3"]
    base: Float[Array, "*pairs 3"]
    normal: Float[Array, "*pairs 3"]
    sigma0: Float[Array, "*pairs"]
    kind: Int[Array, "*pairs"]


class Plane(NamedTuple):
    """n, the points that lie in the plane, and the share they are."""

    normal: Float[Array, "3"]
    within: Bool[Array, "match"]
    share: Float[Array, ""]


def searched(pair: Pair, search: Ransac) -> tuple[RelativePose, Int[Array, ""]]:
    """The pose of most matches, and the number of subsets tried."""
    found = search.found(cleaned(pair)[0])
    return found.pose, found.blocks * search.hypotheses.block


def suffices(
    search: Ransac, tried: Int[np.ndarray, "pair"], kept: Int[np.ndarray, "pair"], of: Int[np.ndarray, "pair"]
):
    """Whether so many subsets are enough for the share of matches kept, the search having kept up to SLACK more."""
    share = np.clip(kept / np.maximum(of, 1) + SLACK, 1e-3, 1 - 1e-9)
    return tried * np.log1p(-(share**search.hypotheses.size)) <= math.log1p(-search.confidence)


def judged(pair: Pair, pose: RelativePose) -> Found:
    """All matches of a pair judged by the pose of a search."""
    pair = cleaned(pair)[0]
    each = lambda n: critical_values.normal(LEVEL / jnp.maximum(n, 1.0))
    limit = critical_values.by_count(each, pair.x_left.shape[0], count(pair.mask))
    within = lambda pose, factor: pair.mask & (squares(pair, pose) <= (factor * limit) ** 2)
    # a subset's pose is the worse the weaker the layout: it moves on points from further away before it judges them
    nearer = lambda k, pose: improved(pair, pose, within(pose, WIDE - k * (WIDE - 1) / STEPS))
    pose = lax.fori_loop(0, STEPS, nearer, pose)
    pose = visible(pair, pose, within(pose, 1.0), limit)
    pose, use = agreeing(pair, pose, within(pose, 1.0), limit, ROUNDS)
    use = use & seen(pair, pose, limit)
    solved = orient(pair.with_mask(use), start=pose)
    pose, result = solved.pose, solved.result
    normal, _, share = plane(pair, pose, use, limit)
    kind = jnp.where(share < PLANE, int(Kind.oriented), int(Kind.plane))
    weak = result == RESULTS.weakly_determined
    # what lies behind a photo here is infinitely far for its errors
    fair = is_usable(result) | weak | (result == RESULTS.points_behind_camera)
    # a large sigma0 hides a base, too: the rays themselves have to be parallel, by the rotation alone. Without a base
    # any will do, and then it is one that some wrong matches agree on: their parallaxes are no proof of it
    turns = lambda _, still: parallel(pair, rotation_only(*vectors(pair), use & still)[0], limit)
    still = lax.fori_loop(0, TURNS, turns, pair.mask)
    rotated = rotation_only(*vectors(pair), use & still)[0]
    few = count(use & ~still) <= ALIKE + CHANCE * count(pair.mask & ~still)
    turned = ((result == RESULTS.zero_base) | few) & (count(use & still) >= PLANE * count(use))
    pose = jax.tree.map(lambda a, b: jnp.where(turned, a, b), rotated, pose)
    use = jnp.where(turned, still, use)
    believed = accidents(pair, pose, use, limit) < math.log(ACCIDENTS)
    for holds, other in (
        (~fair | ~believed, Kind.no_consensus),
        (believed & weak & (share < PLANE), Kind.weak),
        (believed & turned, Kind.rotation),
        (count(pair.mask) < 6, Kind.too_few),
    ):
        kind = jnp.where(holds, int(other), kind)
    rotation = rot.as_array(pose.relative()[0])
    kept = use & (kind < int(Kind.no_consensus))
    return Found(kept, pose.quaternion, rotation, pose.base, normal, solved.sigma0, kind)


def plane(pair: Pair, pose: RelativePose, use: Bool[Array, "match"], limit) -> Plane:
    """The plane nearest to the points in use: n of c x p1 = (c x b) (n · p1), c = R p2, linear, in three turns in which
    points off it lose their weight. A point lies in it if the homography p2 ~ Rᵀ (p1 - b (n · p1)) takes p1 to p2
    within the limit."""
    rotation, base = pose.relative()
    back = rot.transpose(rotation)

    def inverse_depth(point):
        x1, y1, x2, y2 = point
        p = (x1 / pair.focal_left, y1 / pair.focal_left, -jnp.ones_like(x1))
        c = rot.apply(rotation, (x2 / pair.focal_right, y2 / pair.focal_right, -jnp.ones_like(x2)))
        across = rot.cross(c, base)
        squared = rot.dot(across, across)
        return *p, rot.dot(across, rot.cross(c, p)) / jnp.where(squared > 0, squared, 1.0), squared

    def squared(point, sigma, normal):
        x1, y1, x2, y2 = point
        p = (x1 / pair.focal_left, y1 / pair.focal_left, -jnp.ones_like(x1))
        nearness = rot.dot(normal, p)
        x, y, z = rot.apply(back, (p[0] - base[0] * nearness, p[1] - base[1] * nearness, p[2] - base[2] * nearness))
        safe = jnp.where(z < 0, z, -1.0)
        off = (pair.focal_right * x / -safe - x2) ** 2 + (pair.focal_right * y / -safe - y2) ** 2
        return jnp.where(z < 0, off / (2 * sigma**2), jnp.inf)

    *columns, target, sure = jax.vmap(inverse_depth)(pair.coordinates)
    errors = jax.vmap(squared, in_axes=(0, 0, None))

    def turn(_, normal):
        s = errors(pair.coordinates, pair.sigma, normal) / limit**2
        weight = jnp.where(use, sure / (1 + jnp.minimum(s, 1e6)), 0.0)
        n, h, _ = accumulate([target], [[c] for c in columns], [weight])
        return tuple(solve(n, h))

    zero = jnp.zeros_like(pair.focal_left)
    n, h, _ = accumulate([target], [[c] for c in columns], [jnp.where(use, sure, 0.0)])
    normal = lax.fori_loop(0, 2, turn, tuple(solve(n, h)))
    within = use & (errors(pair.coordinates, pair.sigma, normal) <= limit**2)
    finite = jnp.stack([jnp.where(jnp.isfinite(c), c, zero) for c in normal])
    return Plane(finite, within, count(within) / jnp.maximum(count(use), 1.0))


def visible(pair: Pair, pose: RelativePose, use: Bool[Array, "match"], limit) -> RelativePose:
    """Of a plane scene the pose that has more points in front of both photos; of other scenes the pose as it is.

    A homography Rᵀ A, A = I - b nᵀ, belongs to two poses (Longuet-Higgins 1986), because AᵀA = I + n wᵀ + w nᵀ, w =
    n/2 - b, is the same for n and w exchanged: n' = w, b' = β w / 2 - n, R' = (A A'⁻¹)ᵀ R with det A' = det A.
    """
    normal, use, share = plane(pair, pose, use, limit)
    rotation, base = pose.relative()
    n, b = (normal[0], normal[1], normal[2]), base
    w = (n[0] / 2 - b[0], n[1] / 2 - b[1], n[2] / 2 - b[2])
    det = 1 - rot.dot(b, n)
    there = (det > 1e-6) & (rot.dot(w, w) > 1e-12) & (share >= PLANE)
    det, square = jnp.where(there, det, 1.0), jnp.where(there, rot.dot(w, w), 1.0)
    beta = 2 * (1 + rot.dot(n, w) - det) / square
    other = (beta / 2 * w[0] - n[0], beta / 2 * w[1] - n[1], beta / 2 * w[2] - n[2])
    eye = rot.identity(det)
    first = tuple(tuple(e - b[i] * n[j] for j, e in enumerate(row)) for i, row in enumerate(eye))
    second = tuple(tuple(e + other[i] * w[j] / det for j, e in enumerate(row)) for i, row in enumerate(eye))
    turned = rot.product(rot.transpose(rot.product(first, second)), rotation)  # pyright: ignore[reportArgumentType]
    length = jnp.sqrt(rot.dot(other, other))
    there = there & (length > 1e-6)
    unit = (c / jnp.where(there, length, 1.0) for c in other)
    twin = RelativePose(*rot.to_quaternion(turned), *unit).normalised()
    fine = there & jnp.isfinite(sum(jax.tree.leaves(twin)))
    twin = jax.tree.map(lambda a, b: jnp.where(fine, a, b), twin, pose)
    better = count(use & in_front(pair, twin)) > count(use & in_front(pair, pose))
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), improved(pair, twin, use), pose)


def accidents(pair: Pair, pose: RelativePose, use: Bool[Array, "match"], limit) -> Float[Array, ""]:
    """Logarithm of the expected number of sets as good by accident."""
    rows, n, k = moved_up(pair), count(pair.mask), count(use)
    size = rows.shape[0]
    there = jnp.arange(size, dtype=n.dtype) < n
    shifts = max(min(max(SHIFTS, TRIALS // size), size - 1), 1)

    def shifted(i, sums):
        # the places are turned, the empty ones with them: a shift by the number of points would have to gather
        x, y, also = (lax.dynamic_slice_in_dim(a, 1 + i * (size - 1) // shifts, size) for a in twice)
        mixed = Pair(rows[:, 0], rows[:, 1], x, y, pair.sigma, there & also, pair.focal_left, pair.focal_right)
        agree = mixed.mask & (squares(mixed, pose) <= limit**2)
        return tuple(a + count(b) for a, b in zip(sums, (agree, mixed.mask), strict=True))

    twice = [jnp.concatenate([a, a]) for a in (rows[:, 2], rows[:, 3], there)]
    agree, trials = lax.fori_loop(0, shifts, shifted, (n * 0, n * 0))
    p = (agree + 1) / (trials + 2)
    choices = gammaln(n + 1) - gammaln(n - k + 1) - gammaln(6.0) - gammaln(jnp.maximum(k, 5.0) - 4)
    return jnp.where(k > 5, choices + (k - 5) * jnp.log(p) + jnp.log(jnp.maximum(n - 5, 1.0)), jnp.inf)
