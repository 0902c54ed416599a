"""What the orientation of an image pair from its automatic matches is worth.

Pose and kept matches come from the procedure `recommended` and stay unchanged if the
pair is `oriented`. Here they are classified:

1. Where most matches lie in one plane, they have a second pose (`planes`), which
   replaces the first one if it has more of them in front of both photos.
2. Where the rotation alone explains the matches, there is no base, and whatever base
   was found is an accident.
3. Matches that repeat others are no evidence, and of automatic matches some are wrong
   from the start: that all of them fit proves nothing if they are few. The kept set is
   believed if sets as good are not expected by accident (`rejection.evidence`), by the
   share of matches that agree when every point is given the partner of another one.
"""

import enum
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values
from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import planes
from ..orientation.results import RESULTS, is_usable
from ..orientation.starts.general import rotation_only, vectors
from ..xla.kernels import while_loop
from ..xla.passes import count, total
from . import OUTCOMES, Recommended, Rejection, evidence
from .agreement import keep_agreeing, squares
from .visibility import look, seen

ENGINE = Recommended()
"""The procedure that decides on pose and matches; the standard deviations are those of
the matches."""

ACCIDENTS = 1e-3
"""Sets as good that may be expected by accident: as many as the engine allows."""

ROUNDS = 10
"""Largest number of turns (solve, judge every match) for the second pose of a plane
scene."""

TURNS = 3
"""Turns to find the rotation without a base: each one uses the matches that the last
rotation explains."""

ALIKE, CHANCE = 3.0, 0.05
"""Where there is no base: number of wrong matches that agree on any base, and the share
of the other wrong matches that agree with it by chance."""

PLANE = 0.8
"""If at least this share of the matches that agree with a pose lies in one plane, only
the plane determines the pose."""


class Kind(enum.IntEnum):
    """How the orientation of a pair from its matches ended."""

    oriented = 0
    plane = 1
    rotation = 2
    weak = 3
    no_consensus = 4
    too_few = 5


class Found(eqx.Module):
    """Matches kept, the pose by them (quaternion w, x, y, z; R; unit base), the normal n
    of the plane n · λ p1 / f1 = 1 nearest to them, sigma0, and the number of a
    `Kind`."""

    kept: Bool[Array, "*pairs match"]
    quaternion: Float[Array, "*pairs 4"]
    rotation: Float[Array, "*pairs 3 3"]
    base: Float[Array, "*pairs 3"]
    normal: Float[Array, "*pairs 3"]
    sigma0: Float[Array, "*pairs"]
    kind: Int[Array, "*pairs"]


class Verdict(NamedTuple):
    """What the engine says of a pair: matches kept, the pose by them and how that
    ended, and the outcome."""

    mask: Bool[Array, "*pairs match"]
    pose: RelativePose
    result: RESULTS
    outcome: OUTCOMES


class Plane(NamedTuple):
    """The pose of most matches in front of both photos, its matches, the plane nearest
    to them, and whether that plane alone determines the pose."""

    pose: RelativePose
    use: Bool[Array, "match"]
    normal: Float[Array, "3"]
    alone: Bool[Array, ""]


def verdict(rejection: Rejection) -> Verdict:
    """The part of a rejection that is needed here."""
    solved = rejection.orientation
    return Verdict(rejection.mask, solved.pose, solved.result, rejection.outcome)


def classify(pair: Pair, verdict: Verdict) -> Found:
    """The kind of a pair, from the verdict of the engine on it."""
    pair = mask_unusable(pair)[0]
    each = lambda n: critical_values.normal(ENGINE.level / np.maximum(n, 1.0))
    limit = critical_values.by_count(each, pair.x_left.shape[0], count(pair.mask))
    plane = in_plane(pair, verdict.pose, verdict.mask, limit)
    pose, use, turned = without_base(pair, plane.pose, plane.use, verdict.result, limit)
    weak = (verdict.result == RESULTS.weakly_determined) | (
        verdict.result == RESULTS.carried_by_few
    )
    # the other pose of a plane, which explains the matches as well
    either = plane.alone | (verdict.result == RESULTS.two_solutions)
    # matches behind a photo are here infinitely far within their errors
    fair = (
        is_usable(verdict.result)
        | weak
        | (verdict.result == RESULTS.points_behind_camera)
    )
    # without a base any base is as good as another one, so that the engine may doubt
    # the base that it found
    convinced = turned | (fair & (verdict.outcome != OUTCOMES.no_consensus))
    kind = jnp.where(either, int(Kind.plane), int(Kind.oriented))
    for holds, other in (
        (weak & ~either, Kind.weak),
        (turned, Kind.rotation),
        (~convinced | ~certain(pair, pose, use, limit), Kind.no_consensus),
        (count(pair.mask) < 6, Kind.too_few),
    ):
        kind = jnp.where(holds, int(other), kind)
    return Found(
        kept=use & (kind < int(Kind.no_consensus)),
        quaternion=pose.quaternion,
        rotation=rot.as_array(pose.relative()[0]),
        base=pose.base,
        normal=plane.normal,
        sigma0=sigma0(pair, pose, use),
        kind=kind,
    )


def in_plane(
    pair: Pair, pose: RelativePose, use: Bool[Array, "match"], limit: Float[Array, ""]
) -> Plane:
    """Whether most matches lie in one plane. If they do, a second pose explains them,
    too; it replaces the first pose if it has more matches in front of both photos."""
    # matches that were rejected for lying behind a photo agree, too
    agree = use | (pair.mask & (squares(pair, pose) <= limit**2))
    flat = planes.plane(pair, pose, agree, limit)
    alone = flat.share >= PLANE

    def once(state):
        needed, first = state
        # depends on the round, or it would be computed of every scene
        inside = mask_unusable(pair.with_mask(pair.mask & needed))[0]
        in_it = inside.with_mask(inside.mask & flat.within)
        other, exists = planes.second(in_it, pose, flat.normal)
        in_front = lambda pose: count(flat.within & look(inside, pose).in_front)
        more = in_front(other) > in_front(pose)
        other, others = keep_agreeing(inside, other, in_it.mask, limit, ROUNDS)
        others = others & seen(inside, other, limit)
        normal = planes.plane(inside, other, others, limit).normal
        new = Plane(other, others, normal, alone)
        replace = lambda a, b: jnp.where(needed & exists & more, a, b)
        return needed & False, jax.tree.map(replace, new, first)

    first = Plane(pose, use, flat.normal, alone)
    return while_loop(lambda state: state[0], once, (alone, first), pair.focal_left)[1]


def without_base(
    pair: Pair,
    pose: RelativePose,
    use: Bool[Array, "match"],
    result: RESULTS,
    limit: Float[Array, ""],
) -> tuple[RelativePose, Bool[Array, "match"], Bool[Array, ""]]:
    """The rotation without a base and its matches where it explains the matches in use,
    and whether it does."""
    # a large sigma0 may hide a base, therefore the rays themselves have to be parallel
    # after the rotation. Without a base the engine finds one that some wrong matches
    # agree on: their parallaxes do not prove it
    rotated_by = lambda still: rotation_only(*vectors(pair), use & still)[0]
    turns = lambda _, still: look(pair, rotated_by(still), limit).parallel
    still = lax.fori_loop(0, TURNS, turns, pair.mask)
    rotated = rotated_by(still)
    few = count(use & ~still) <= ALIKE + CHANCE * count(pair.mask & ~still)
    most = count(use & still) >= PLANE * count(use)
    turned = ((result == RESULTS.zero_base) | few) & most
    choose = lambda a, b: jnp.where(turned, a, b)
    return *jax.tree.map(choose, (rotated, still), (pose, use)), turned


def certain(
    pair: Pair, pose: RelativePose, use: Bool[Array, "match"], limit: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether so many matches at different places are not expected to agree by
    accident."""
    once = mask_unusable(pair.with_mask(evidence.apart(pair)))[0]
    agreed, asked = evidence.shifted_agreement(once, pose, limit)
    chance = (agreed + 1) / (asked + 2)
    return evidence.log_accidents(
        chance, count(once.mask), count(use & once.mask)
    ) <= math.log(ACCIDENTS)


def sigma0(
    pair: Pair, pose: RelativePose, use: Bool[Array, "match"]
) -> Float[Array, ""]:
    """The estimated standard deviation of unit weight, every kept match with its full
    weight: the weights of the engine's solution fade, which makes its sigma0 too
    small."""
    freedom = count(use) - 5
    square = total(jnp.where(use, squares(pair, pose), 0.0)) / jnp.maximum(freedom, 1.0)
    return jnp.where(freedom > 0, jnp.sqrt(square), 0.0)
