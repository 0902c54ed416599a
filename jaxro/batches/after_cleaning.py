"""How good a procedure is on a pair it has cleaned, by simulation: how often it keeps
just the right points, and how often the true pose lies in the region it promises.

The pose that was found is taken for the truth, and the points kept are moved onto its
condition by their corrections. In every repetition all coordinates get normal errors,
and as many points as were rejected, drawn anew, get a wrong partner. The same procedure
then cleans the pair, and its points and pose are compared with the truth. Where the
errors of neighbours agree, those of the repetitions do, and deviations are those that
allow for it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from ..adjustment import critical_values
from ..adjustment.normal_equations import solve
from ..assessment.correlated import allow_for_neighbours
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.mock_pairs import draw_points, plant
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.result import Orientation
from ..orientation.results import is_usable
from ..rejection import AbstractProcedure, Rejection
from ..xla.passes import count
from .batch import clean_batch


class AfterCleaning(NamedTuple):
    """Shares of the `repetitions`, from 0 to 1.

    `answered`: cleaned, with a usable orientation. Of those: `exactly_right`: just the
    wrong points rejected; `without_wrong`: no wrong point kept; `alike`: as many points
    rejected as of the pair itself.

    Of those alike, after the same decision, that is (NaN where there are none):
    `coverage`: the true pose in the region promised at the `confidence`, a posteriori;
    `coverage_known`: a priori, by the given sigma; `intervals` and `intervals_known`:
    the same of the interval of each element; `inflation`: root mean square of the pose's
    errors over the promised ones (1 where they are honest).

    A share p of n pairs has the standard deviation sqrt(p (1 - p) / n).
    """

    answered: Float[Array, ""]
    exactly_right: Float[Array, ""]
    without_wrong: Float[Array, ""]
    alike: Float[Array, ""]
    coverage: Float[Array, ""]
    coverage_known: Float[Array, ""]
    intervals: Float[Array, "element"]
    intervals_known: Float[Array, "element"]
    inflation: Float[Array, ""]
    confidence: float
    repetitions: int


Tell = Callable[[Pair, Orientation], tuple[Array, Array]]
"""What is promised of an orientation: the errors of some elements against the truth, and
their standard deviations."""


class Agreement(NamedTuple):
    """Of the errors of a coordinate at two points of a photo, d apart: the correlation
    rho exp(-(d/length)²) (`assessment.neighbours`)."""

    rho: Float[Any, ""]
    length: Float[Any, ""]

    def roots(self, pair: Pair) -> Float[Array, "2 point point"]:
        """The roots of the correlations of all points on the left and the right photo."""
        each = []
        for x, y in (pair.coordinates[:2], pair.coordinates[2:]):
            at = np.stack([np.asarray(x), np.asarray(y)], axis=1)
            squared = np.sum((at[:, None] - at[None]) ** 2, axis=2)
            agree = float(self.rho) * np.exp(-squared / float(self.length) ** 2)
            np.fill_diagonal(agree, 1.0)
            values, vectors = np.linalg.eigh(agree)
            each.append(vectors * np.sqrt(np.maximum(values, 0.0)))
        return jnp.asarray(np.stack(each))


class Found(NamedTuple):
    """The results of a procedure that are compared with the truth; `errors` and
    `deviations` of the elements."""

    pose: RelativePose
    usable: Bool[Array, "..."]
    mask: Bool[Array, "*repetition point"]
    cofactor: Float[Array, "*repetition 5 5"]
    sigma0: Float[Array, "..."]
    degrees_of_freedom: Int[Array, "..."]
    errors: Float[Array, "*repetition element"]
    deviations: Float[Array, "*repetition element"]


class Trial(NamedTuple):
    """One repetition compared with the truth, with the fields of `AfterCleaning`;
    `ratio`: the mean square of the pose's errors over the promised ones."""

    answered: Bool[Array, "..."]
    exactly_right: Bool[Array, "..."]
    without_wrong: Bool[Array, "..."]
    inside: Bool[Array, "..."]
    inside_known: Bool[Array, "..."]
    intervals: Bool[Array, "*repetition element"]
    intervals_known: Bool[Array, "*repetition element"]
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
    return repeat_cleaning(
        pair,
        rejection.orientation.pose,
        rejection.mask,
        procedure,
        key,
        repetitions=repetitions,
        sigma0=sigma0,
        largest=largest,
        confidence=confidence,
    )


def repeat_cleaning(
    pair: Pair,
    pose: RelativePose,
    kept: Bool[Array, "point"],
    procedure: AbstractProcedure,
    key: PRNGKeyArray,
    *,
    repetitions: int = 1000,
    sigma0: ArrayLike | None = None,
    largest: float | None = None,
    confidence: float = 0.95,
    tell: Tell | None = None,
    agreement: Agreement | None = None,
) -> AfterCleaning:
    """`after_cleaning` of a pair that a procedure oriented like this, with these points
    kept. `tell`: the elements whose intervals are looked at; the five local ones of the
    pose if not given. `agreement`: of the errors of neighbours; deviations then allow
    for it."""
    pair, _ = mask_unusable(pair)
    pairs, wrong = simulate(
        pair,
        pose,
        kept,
        key,
        repetitions,
        sigma0=sigma0,
        largest=largest,
        agreement=agreement,
    )
    tell = _OfPose(pose) if tell is None else tell
    told = None if agreement is None else Agreement(*map(jnp.asarray, agreement))
    found = clean_batch(pairs, procedure, read=_Read(tell, told))
    each = compare(pair, pose, wrong, found, sigma0, confidence)
    number = jnp.sum(pair.mask & ~kept)
    same = jnp.sum(pair.mask[None, :] & ~found.mask, axis=1) == number
    alike = each.answered & same
    answered, of_those = (_share_of(chosen) for chosen in (each.answered, alike))
    of_each = jax.vmap(of_those, in_axes=1)
    ratio = jnp.sum(jnp.where(alike, each.ratio, 0.0)) / count(alike)
    return AfterCleaning(
        answered=count(each.answered) / repetitions,
        exactly_right=answered(each.exactly_right),
        without_wrong=answered(each.without_wrong),
        alike=answered(same),
        coverage=of_those(each.inside),
        coverage_known=of_those(each.inside_known),
        intervals=of_each(each.intervals),
        intervals_known=of_each(each.intervals_known),
        inflation=jnp.sqrt(ratio),
        confidence=confidence,
        repetitions=repetitions,
    )


def _share_of(
    chosen: Bool[Array, "repetition"],
) -> Callable[[Bool[Array, "repetition"]], Float[Array, ""]]:
    """The share of the chosen repetitions in which something holds."""
    return lambda held: count(held & chosen) / count(chosen)


def simulate(
    pair: Pair,
    pose: RelativePose,
    kept: Bool[Array, "point"],
    key: PRNGKeyArray,
    repetitions: int,
    *,
    sigma0: ArrayLike | None = None,
    largest: float | None = None,
    agreement: Agreement | None = None,
) -> tuple[Pair, Bool[Array, "repetition point"]]:
    """Simulated pairs like the cleaned one, (repetition point) a coordinate, and which
    of their points are wrong.

    A rejected point stands where it was measured in the left photo; its true partner
    lies on the ray that a kept point of similar place suggests: the model point at the
    mean depth of those kept.
    """
    kept, rejected = pair.mask & kept, pair.mask & ~kept
    unit = jnp.asarray(1.0 if sigma0 is None else sigma0, pair.sigma.dtype)
    most = largest
    if largest is None:
        most = _largest_error(pair, pose, rejected, unit)
    x_left, y_left, x_right, y_right = (
        jnp.where(pair.mask, c, 0.0) for c in errorless(pair, pose, kept)
    )
    exact = dataclasses.replace(
        pair, x_left=x_left, y_left=y_left, x_right=x_right, y_right=y_right
    )
    most = jnp.asarray(most, pair.sigma.dtype)
    roots = None if agreement is None else agreement.roots(exact)
    repeat = lambda key: _repeat(exact, jnp.sum(rejected), unit, most, roots, key)
    return jax.vmap(repeat)(jax.random.split(key, repetitions))


def _repeat(
    exact: Pair,
    number: Int[Array, ""],
    unit: Float[Array, ""],
    most: Float[Array, ""],
    roots: Float[Array, "2 point point"] | None,
    key: PRNGKeyArray,
) -> tuple[Pair, Bool[Array, "point"]]:
    """A pair with normal errors and so many wrong points, and which they are. `roots`
    of the correlations of the errors on each photo, if there are any."""
    points = exact.mask.shape
    which, noise, size = jax.random.split(key, 3)
    wrong = draw_points(which, exact.mask, number)
    errors = jax.random.normal(noise, (4, *points))
    if roots is not None:
        of_photos = errors.reshape(2, 2, *points)
        errors = jnp.einsum("pij,pcj->pci", roots, of_photos).reshape(4, *points)
    errors = (unit * exact.sigma)[None, :] * errors
    if exact.roots is not None:
        errors = jnp.stack(exact.roots.displace(tuple(errors)))
    partners = jnp.where(wrong[None, :], _wrong_partners(size, most, points), 0.0)
    x_right, y_right = errors[2:] + partners
    measured = plant(
        exact, x_left=errors[0], y_left=errors[1], x_right=x_right, y_right=y_right
    )
    return measured, wrong


def _wrong_partners(
    key: PRNGKeyArray, most: Float[Array, ""], points: tuple[int, ...]
) -> Float[Array, "2 point"]:
    """Errors of both right coordinates, between the half and all of the largest, of any
    sign."""
    size, sign = jax.random.split(key)
    shape = (2, *points)
    errors = most * jax.random.uniform(size, shape, minval=0.5, maxval=1.0)
    return errors * jax.random.rademacher(sign, shape, errors.dtype)


def _largest_error(
    pair: Pair,
    pose: RelativePose,
    rejected: Bool[Array, "point"],
    unit: Float[Array, ""],
) -> Float[Array, ""]:
    """Twice the largest correction of a rejected point, at least ten sigma."""
    f = coplanarity.fundamental_matrix(
        *pose.relative(), pair.focal_left, pair.focal_right
    )
    correct = lambda point, use, roots: coplanarity.corrections(f, point, use, roots)
    corrections = jax.vmap(correct)(pair.coordinates, rejected, pair.roots)
    size = jnp.max(jnp.abs(jnp.stack(corrections)))
    sigma = jnp.max(jnp.where(pair.mask, pair.sigma, 0.0))
    return jnp.maximum(2 * size, 10 * sigma * unit)


def errorless(
    pair: Pair, pose: RelativePose, kept: Bool[Array, "point"]
) -> tuple[Float[Array, "point"], ...]:
    """Coordinates that satisfy the pose: of kept points the measured ones with their
    corrections, of others the left one and its partner at the mean depth of those
    kept."""
    rotation, base = pose.relative()
    focal_left, focal_right = pair.focal_left, pair.focal_right
    f = coplanarity.fundamental_matrix(rotation, base, focal_left, focal_right)
    back = rot.transpose(rotation)
    nearness = _mean_nearness(pair, pose, kept)

    def partner(x, y):
        level = rot.add_scaled((x, y, -focal_left), base, -nearness)
        x, y, z = rot.apply(back, level)
        z = jnp.where(z < 0, z, -focal_left)
        return -focal_right * x / z, -focal_right * y / z

    def move(point, use, roots):
        moved = point
        for _ in range(2):  # the correction is of first order
            v = coplanarity.corrections(f, moved, use, roots)
            moved = tuple(c + e for c, e in zip(moved, v, strict=True))
        x, y, *_ = point
        other = (x, y, *partner(x, y))
        return tuple(jnp.where(use, a, b) for a, b in zip(moved, other, strict=True))

    return jax.vmap(move)(pair.coordinates, kept, pair.roots)


def _mean_nearness(
    pair: Pair, pose: RelativePose, kept: Bool[Array, "point"]
) -> Float[Array, ""]:
    """The mean of 1 / λ of the kept points, λ p1 the model point."""
    rotation, base = pose.relative()

    def nearness(point):
        *_, square, depth, _ = coplanarity.rays(
            None, rotation, base, point, pair.focal_left, pair.focal_right
        )
        in_front = jnp.where(depth > 0, depth, jnp.inf)
        return jnp.where(square > 0, square / in_front, 0.0)

    each = jnp.where(kept, jax.vmap(nearness)(pair.coordinates), 0.0)
    return jnp.sum(each) / jnp.maximum(count(kept), 1.0)


def compare(
    pair: Pair,
    truth: RelativePose,
    wrong: Bool[Array, "repetition point"],
    found: Found,
    known: ArrayLike | None,
    confidence: float,
) -> Trial:
    """`Trial` of all repetitions, from the results of the procedure in each; `known`:
    sigma0 of the simulation."""
    away = jax.vmap(lambda pose: difference(pose, truth))(found.pose)
    squared = jax.vmap(_mahalanobis)(found.cofactor, away)
    unit = jnp.asarray(1.0 if known is None else known, squared.dtype)
    freedom = found.degrees_of_freedom
    fine = found.usable & (freedom > 0)
    variance = jnp.where(fine, found.sigma0, 1.0) ** 2
    quantile = lambda f: critical_values.radius(confidence, 5, f) ** 2
    most = max(pair.mask.shape[0] - 5, 0)
    limit_of = lambda f: critical_values.by_count(quantile, most, f)
    limit = jax.vmap(limit_of)(freedom.astype(squared.dtype))
    limit_known = critical_values.chi_squared(1 - confidence, 5)
    right_kept = found.mask ^ wrong
    half = lambda f: critical_values.half_width(confidence, f)
    factor = jax.vmap(lambda f: critical_values.by_count(half, most, f))
    width = found.deviations * factor(freedom.astype(squared.dtype))[:, None]
    sigma0 = jnp.where(fine, found.sigma0, 1.0)
    known_width = critical_values.normal(1 - confidence) * unit / sigma0
    errors = jnp.abs(found.errors)
    return Trial(
        answered=fine,
        exactly_right=jnp.all(right_kept | ~pair.mask[None, :], axis=1),
        without_wrong=~jnp.any(found.mask & wrong, axis=1),
        inside=squared <= limit * variance,
        inside_known=squared <= limit_known * unit**2,
        intervals=errors <= width,
        intervals_known=errors <= found.deviations * known_width[:, None],
        ratio=squared / (5 * variance),
    )


def difference(pose: RelativePose, other: RelativePose) -> list[Array]:
    """The local parameters by which `other` differs from a pose: exact of the rotation,
    to second order of the base, and infinite of a base on the other side."""
    w, x, y, z = pose.qw, -pose.qx, -pose.qy, -pose.qz
    a, b, c, d = other.qw, other.qx, other.qy, other.qz
    real = w * a - x * b - y * c - z * d
    real = jnp.where(real == 0, jnp.finfo(real.dtype).tiny, real)
    imaginary = (
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    turn = [2 * entry / real for entry in imaginary]
    base, there = (pose.bx, pose.by, pose.bz), (other.bx, other.by, other.bz)
    same_side = rot.dot(base, there) > 0
    shift = [rot.dot(tangent, there) for tangent in rot.tangents(base)]
    return [*turn, *(jnp.where(same_side, s, jnp.inf) for s in shift)]


def _mahalanobis(cofactor: Float[Array, "5 5"], away: list[Array]) -> Float[Array, ""]:
    """xᵀ Q⁻¹ x"""
    lower = [[cofactor[i, j] for j in range(i + 1)] for i in range(len(away))]
    products = [a * b for a, b in zip(away, solve(lower, away), strict=True)]
    return sum(products[1:], products[0])


class _OfPose(eqx.Module):
    """What is promised of the five local elements of a pose."""

    truth: RelativePose

    def __call__(self, pair: Pair, orientation: Orientation) -> tuple[Array, Array]:
        del pair
        away = difference(self.truth, orientation.pose)
        return jnp.stack(away), orientation.deviations


class _Read(eqx.Module):
    """The results of a procedure that are compared with the truth."""

    tell: Tell
    agreement: Agreement | None = None

    def __call__(self, pair: Pair, rejection: Rejection) -> Found:
        orientation = rejection.orientation
        kept = pair.with_mask(rejection.mask)
        if self.agreement is not None:
            used = pair.with_mask(rejection.in_use)
            orientation = allow_for_neighbours(used, orientation, *self.agreement)
        errors, deviations = self.tell(kept, orientation)
        return Found(
            pose=orientation.pose,
            usable=is_usable(orientation.result),
            mask=rejection.mask,
            cofactor=orientation.cofactor,
            sigma0=orientation.sigma0,
            degrees_of_freedom=orientation.degrees_of_freedom,
            errors=errors,
            deviations=deviations,
        )
