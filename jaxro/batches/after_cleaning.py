"""What a cleaned pair is worth: how often its procedure keeps the right points, and
holds the promised region.

Simulated at the pose that was found. The points kept are moved onto the condition by
their corrections and taken for the truth; in every repetition all coordinates get
normal errors, and as many points as were rejected, drawn anew, get a wrong partner. The
same procedure then judges, and its set and pose are held against the truth.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from ..adjustment import critical_values
from ..adjustment.normal_equations import solve
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.results import is_usable
from ..rejection import AbstractProcedure, Rejection
from ..xla.passes import count
from .batch import map_batch


class AfterCleaning(NamedTuple):
    """Shares of the `repetitions`, all but the first of those that were `answered`:
    cleaned, and usable.

    `exactly_right`: the wrong points rejected and no other. `without_wrong`: no wrong
    point kept. `coverage`: the true pose in the region promised at the `confidence`, a
    posteriori; `coverage_known`: a priori, by the given sigma. `inflation`: root mean
    square of the pose's errors over the promised ones (1 where they are honest). A
    share p has the standard deviation sqrt(p (1 - p) / repetitions).
    """

    answered: Float[Array, ""]
    exactly_right: Float[Array, ""]
    without_wrong: Float[Array, ""]
    coverage: Float[Array, ""]
    coverage_known: Float[Array, ""]
    inflation: Float[Array, ""]
    confidence: float
    repetitions: int


class Found(NamedTuple):
    """What is held against the truth of what a procedure found."""

    pose: RelativePose
    usable: Bool[Array, "..."]
    mask: Bool[Array, "*repetition point"]
    cofactor: Float[Array, "*repetition 5 5"]
    sigma0: Float[Array, "..."]
    degrees_of_freedom: Int[Array, "..."]


class Trial(NamedTuple):
    """What one repetition tells; the errors squared, over the cofactors and over sigma0
    = 1."""

    answered: Bool[Array, "..."]
    exactly_right: Bool[Array, "..."]
    without_wrong: Bool[Array, "..."]
    inside: Bool[Array, "..."]
    inside_known: Bool[Array, "..."]
    ratio: Float[Array, "..."]


def after_cleaning(
    pair: Pair,
    rejection: Rejection,
    procedure: AbstractProcedure,
    key: PRNGKeyArray,
    *,
    repetitions: int = 1000,
    sigma0: ArrayLike | None = None,
    largest: float | None = None,
    confidence: float = 0.95,
) -> AfterCleaning:
    """`AfterCleaning` of one pair, the `rejection` that `procedure` found for it, and
    any procedure.

    `sigma0`: standard deviation of unit weight in the simulation; 1 if not given, that
    is, the sigma of the pair hold, by which procedures judge. `largest`: of the errors
    planted in the right photo, of both coordinates between the half and all of it, of
    any sign; if not given twice the largest correction of a rejected point, at least
    ten sigma. Smaller errors are harder to find: the shares hold for errors of this
    size.
    """
    pair, _ = mask_unusable(pair)
    pairs, wrong = trials(
        pair, rejection, key, repetitions, sigma0=sigma0, largest=largest
    )
    found = map_batch(_Judged(procedure), pairs)
    measured = judged(
        pair, rejection.orientation.pose, wrong, found, sigma0, confidence
    )
    answered = count(measured.answered)
    share = lambda held: count(held & measured.answered) / jnp.maximum(answered, 1.0)
    ratio = jnp.sum(jnp.where(measured.answered, measured.ratio, 0.0)) / jnp.maximum(
        answered, 1.0
    )
    return AfterCleaning(
        answered=answered / repetitions,
        exactly_right=share(measured.exactly_right),
        without_wrong=share(measured.without_wrong),
        coverage=share(measured.inside),
        coverage_known=share(measured.inside_known),
        inflation=jnp.sqrt(ratio),
        confidence=confidence,
        repetitions=repetitions,
    )


def trials(
    pair: Pair,
    rejection: Rejection,
    key: PRNGKeyArray,
    repetitions: int,
    *,
    sigma0: ArrayLike | None = None,
    largest: float | None = None,
) -> tuple[Pair, Bool[Array, "repetition point"]]:
    """Simulated pairs like the cleaned one, (repetition point) a coordinate, and which
    of their points are wrong.

    A rejected point stands where it was measured in the left photo; its true partner
    lies on the ray that a kept point of similar place suggests: the model point at the
    mean depth of those kept.
    """
    pose, kept = rejection.orientation.pose, rejection.mask & pair.mask
    ideal = errorless(pair, pose, kept)
    number = jnp.sum(pair.mask & ~rejection.mask)
    unit = jnp.asarray(1.0 if sigma0 is None else sigma0, pair.sigma.dtype)
    if largest is None:
        f = coplanarity.fundamental_matrix(
            *pose.relative(), pair.focal_left, pair.focal_right
        )
        v = jax.vmap(lambda point, use: coplanarity.corrections(f, point, use))(
            pair.coordinates, pair.mask & ~kept
        )
        size = jnp.max(jnp.stack([jnp.max(jnp.abs(c)) for c in v]))
        most = jnp.maximum(
            2 * size, 10 * jnp.max(jnp.where(pair.mask, pair.sigma, 0.0)) * unit
        )
    else:
        most = jnp.asarray(largest, pair.sigma.dtype)

    def one(key):
        which, errors, moved = jax.random.split(key, 3)
        rank = jnp.argsort(
            jnp.argsort(
                jnp.where(pair.mask, jax.random.uniform(which, pair.mask.shape), 2.0)
            )
        )
        wrong = (rank < number) & pair.mask
        noise = (unit * pair.sigma)[None, :] * jax.random.normal(
            errors, (4, *pair.mask.shape)
        )
        size, sign = jax.random.split(moved)
        planted = most * jax.random.uniform(
            size, (2, *pair.mask.shape), minval=0.5, maxval=1.0
        )
        planted = planted * jax.random.rademacher(sign, planted.shape, planted.dtype)
        planted = jnp.where(wrong[None, :], planted, 0.0)
        shifts = (noise[0], noise[1], noise[2] + planted[0], noise[3] + planted[1])
        new = [
            jnp.where(pair.mask, c + s, 0.0) for c, s in zip(ideal, shifts, strict=True)
        ]
        return Pair(
            *new, pair.sigma, pair.mask, pair.focal_left, pair.focal_right
        ), wrong

    return jax.vmap(one)(jax.random.split(key, repetitions))


def errorless(pair: Pair, pose: RelativePose, kept: Bool[Array, "point"]):
    """Coordinates that satisfy the pose: of kept points the measured ones with their
    corrections, of others the left one and its partner at the mean depth of those
    kept."""
    rotation, base = pose.relative()
    f = coplanarity.fundamental_matrix(
        rotation, base, pair.focal_left, pair.focal_right
    )
    back = rot.transpose(rotation)

    def depth(point):
        *_, w2, lam, _ = coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )
        return jnp.where(w2 > 0, w2 / jnp.where(lam > 0, lam, jnp.inf), 0.0)

    nearness = jax.vmap(depth)(pair.coordinates)
    mean = jnp.sum(jnp.where(kept, nearness, 0.0)) / jnp.maximum(count(kept), 1.0)

    def one(point, use):
        moved = point
        for _ in range(2):  # the correction is of first order
            v = coplanarity.corrections(f, moved, use)
            moved = tuple(c + e for c, e in zip(moved, v, strict=True))
        ray = (point[0], point[1], -pair.focal_left)
        level = rot.add_scaled(ray, base, -mean)
        x, y, z = rot.apply(back, level)
        z = jnp.where(z < 0, z, -pair.focal_left)
        partner = (
            point[0],
            point[1],
            -pair.focal_right * x / z,
            -pair.focal_right * y / z,
        )
        return tuple(jnp.where(use, a, b) for a, b in zip(moved, partner, strict=True))

    return jax.vmap(one)(pair.coordinates, kept)


def judged(
    pair: Pair,
    truth: RelativePose,
    wrong: Bool[Array, "repetition point"],
    found: Found,
    known,
    confidence: float,
) -> Trial:
    """`Trial` of all repetitions, from what the procedure found in each."""
    pose, usable, mask, cofactor, sigma0, freedom = found
    away = jax.vmap(lambda found: difference(found, truth))(pose)
    squared = jax.vmap(_mahalanobis)(cofactor, away)
    unit = jnp.asarray(1.0 if known is None else known, squared.dtype)
    quantile = lambda f: critical_values.radius(confidence, 5, f) ** 2
    most = max(pair.mask.shape[0] - 5, 0)
    limit = jax.vmap(lambda f: critical_values.by_count(quantile, most, f))(
        freedom.astype(squared.dtype)
    )
    fine = usable & (freedom > 0)
    checked = jnp.where(fine, sigma0, 1.0)
    return Trial(
        answered=fine,
        exactly_right=jnp.all((mask ^ wrong) | ~pair.mask[None, :], axis=1),
        without_wrong=~jnp.any(mask & wrong, axis=1),
        inside=squared <= limit * checked**2,
        inside_known=squared
        <= critical_values.chi_squared(1 - confidence, 5) * unit**2,
        ratio=squared / (5 * checked**2),
    )


def difference(pose: RelativePose, other: RelativePose) -> list[Array]:
    """The local parameters by which `other` differs from a pose: exact of the rotation,
    to second order of the base, and infinite of a base on the other side."""
    w, x, y, z = pose.qw, -pose.qx, -pose.qy, -pose.qz
    a, b, c, d = other.qw, other.qx, other.qy, other.qz
    real = w * a - x * b - y * c - z * d
    real = jnp.where(real == 0, jnp.finfo(real.dtype).tiny, real)
    turn = (
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    base, there = (pose.bx, pose.by, pose.bz), (other.bx, other.by, other.bz)
    shifts = [
        jnp.where(rot.dot(base, there) > 0, rot.dot(t, there), jnp.inf)
        for t in rot.tangents(base)
    ]
    return [*(2 * entry / real for entry in turn), *shifts]


def _mahalanobis(cofactor: Float[Array, "5 5"], away: list[Array]) -> Float[Array, ""]:
    lower = [[cofactor[i, j] for j in range(i + 1)] for i in range(len(away))]
    return sum(
        (a * b for a, b in zip(away, solve(lower, away), strict=True)),
        jnp.zeros_like(away[0]),
    )


class _Judged(eqx.Module):
    """A procedure as a function of one pair that returns what is held against the
    truth."""

    procedure: AbstractProcedure

    def __call__(self, pair: Pair) -> Found:
        rejection = self.procedure(pair)
        o = rejection.orientation
        return Found(
            o.pose,
            is_usable(o.result),
            rejection.mask,
            o.cofactor,
            o.sigma0,
            o.degrees_of_freedom,
        )
