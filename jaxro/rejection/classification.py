"""What the orientation of an image pair from its automatic matches is worth.

Pose, matches kept and whether they are believed are those of the procedure
`recommended`, which decides here as it does everywhere. This module only gives its
verdict the names that programs for images use, with what they want to know besides: the
rotation where there is no base, and the plane nearest to the matches.
"""

import enum
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..adjustment import critical_values
from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation import planes
from ..orientation.results import RESULTS, is_usable
from ..orientation.starts.general import rotation_only, vectors
from ..xla.passes import count, total
from . import OUTCOMES, Recommended, Rejection
from .agreement import points_within, squares
from .masked import choose

ENGINE = Recommended()
"""The procedure that decides on pose and matches; the standard deviations are those of
the matches."""


PLANE = 0.8
"""If at least this share of the matches that agree with a pose lies in one plane, it is
that of a plane scene."""


class Kind(enum.IntEnum):
    """How the orientation of a pair from its matches ended; `two_poses`: of a plane, both
    of which explain the matches; `several`: other matches agree with another pose."""

    oriented = 0
    plane = 1
    two_poses = 2
    rotation = 3
    weak = 4
    no_consensus = 5
    too_few = 6
    several = 7


class Found(eqx.Module):
    """Matches kept, the pose by them (quaternion w, x, y, z; R; unit base), the normal n
    of the plane n · λ p1 / f1 = 1 nearest to them, sigma0, and the number of a
    `Kind`. Of `several` poses the matches of all are kept, and the pose is that of the
    first."""

    kept: Bool[Array, "*pairs match"]
    quaternion: Float[Array, "*pairs 4"]
    rotation: Float[Array, "*pairs 3 3"]
    base: Float[Array, "*pairs 3"]
    normal: Float[Array, "*pairs 3"]
    sigma0: Float[Array, "*pairs"]
    kind: Int[Array, "*pairs"]


class Verdict(NamedTuple):
    """What the engine says of a pair: matches kept, those of other consensuses, the pose
    by those kept and how that ended, and the outcome."""

    mask: Bool[Array, "*pairs match"]
    others: Bool[Array, "*pairs match"]
    pose: RelativePose
    result: RESULTS
    outcome: OUTCOMES


def verdict(_: Pair, rejection: Rejection) -> Verdict:
    """The part of a rejection that is needed here."""
    solved = rejection.orientation
    return Verdict(
        mask=rejection.mask,
        others=jnp.any(rejection.rivals.mask, axis=0),
        pose=solved.pose,
        result=solved.result,
        outcome=rejection.outcome,
    )


def classify(pair: Pair, verdict: Verdict) -> Found:
    """The kind of a pair, from the verdict of the engine on it."""
    pair = mask_unusable(pair)[0]
    result, outcome, use = verdict.result, verdict.outcome, verdict.mask
    believed = (
        (outcome == OUTCOMES.finished)
        | (outcome == OUTCOMES.undecided)
        | (outcome == OUTCOMES.not_oriented)
    )
    plane = _plane(pair, verdict.pose, use)
    turned = result == RESULTS.zero_base
    weak = (result == RESULTS.weakly_determined) | (result == RESULTS.carried_by_few)
    several = result == RESULTS.several_solutions
    usable = is_usable(result)
    kind = jnp.where(usable, int(Kind.oriented), int(Kind.no_consensus))
    for holds, other in (
        (usable & (plane.share >= PLANE), Kind.plane),
        (result == RESULTS.two_solutions, Kind.two_poses),
        (weak, Kind.weak),
        (turned, Kind.rotation),
        (several, Kind.several),
        (~believed, Kind.no_consensus),
        (count(pair.mask) < 6, Kind.too_few),
    ):
        kind = jnp.where(holds, int(other), kind)
    rotation, _ = rotation_only(*vectors(pair), use)
    pose = choose(turned, rotation, verdict.pose)
    kept = use & (kind < int(Kind.no_consensus))
    return Found(
        kept=jnp.where(kind == int(Kind.several), use | verdict.others, kept),
        quaternion=pose.quaternion,
        rotation=rot.as_array(pose.relative()[0]),
        base=pose.base,
        normal=plane.normal,
        sigma0=sigma0(pair, pose, use),
        kind=kind,
    )


def _plane(pair: Pair, pose: RelativePose, use: Bool[Array, "match"]) -> planes.Plane:
    """The plane nearest to the matches that agree with a pose, be they in use or not."""
    each = lambda n: critical_values.normal(ENGINE.level / np.maximum(n, 1.0))
    limit = critical_values.by_count(each, pair.x_left.shape[0], count(pair.mask))
    return planes.plane(pair, pose, use | points_within(pair, pose, limit), limit)


def sigma0(
    pair: Pair, pose: RelativePose, use: Bool[Array, "match"]
) -> Float[Array, ""]:
    """The estimated standard deviation of unit weight, every kept match with its full
    weight: the weights of the engine's solution fade, which makes its sigma0 too
    small."""
    freedom = count(use) - 5
    square = total(jnp.where(use, squares(pair, pose), 0.0)) / jnp.maximum(freedom, 1.0)
    return jnp.where(freedom > 0, jnp.sqrt(square), 0.0)
