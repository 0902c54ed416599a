"""Points in a plane: the plane nearest to the points, and the second orientation that
such a scene has.

A plane n · λ p1/f1 = 1 (λ p1/f1 the point seen from the left photo, n in units of 1 /
base) is seen in the right photo through the homography p2 ~ Rᵀ A p1, A = I - b nᵀ.
Because

    AᵀA = I + n wᵀ + w nᵀ,    w = n |b|²/2 - b,

is the same for n and w exchanged, a second orientation with the plane n' = w has the
same homography, so that points in the plane cannot tell the two apart (Longuet-Higgins
1986):

    b' = β w / 2 - n,    β chosen so that det A' = det A,    R' = (A A'⁻¹)ᵀ R.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, ScalarLike

from ..adjustment.normal_equations import accumulate, solve, steps
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, mask_unusable
from ..xla.kernels import while_loop
from ..xla.passes import count
from .inspection import inspect

TURNS = 2
"""In which points off the plane lose their weight."""

STEPS = 6
"""Gauss-Newton steps from the closed form of the second orientation to its minimum."""

BEHIND = 0.25
"""Share of points behind a photo up to which an orientation may be the right one."""

ROUNDING = 1e-18
"""Mean square distance over f² that is rounding."""

DIFFERENT = 0.05
"""Angle (rad) between rotations or bases from which two orientations are different."""

LEAST = 1e-6
"""Of det A, |w| and |b'|, in units of the base: below it the closed form does not
exist."""


class Plane(NamedTuple):
    """n, in units of 1 / base; the points in the plane within the limit; the share of
    the points that they are."""

    normal: Float[Array, "3"]
    within: Bool[Array, "point"]
    share: Float[Array, ""]


class InverseDepths(NamedTuple):
    """Of every point the coordinates of p1, the inverse depth n · p1, and its weight |c
    x b|²."""

    columns: tuple[Array, Array, Array]
    target: Float[Array, "point"]
    weight: Float[Array, "point"]


class Twin(NamedTuple):
    """The other orientation of a plane scene, the normal of its plane, and whether it
    exists."""

    pose: RelativePose
    normal: Float[Array, "3"]
    exists: Bool[Array, ""]


@runtime_checkable
class Oriented(Protocol):
    """What `poses` needs of an `Orientation`."""

    pose: RelativePose
    sigma0: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]


class PlanePoses(NamedTuple):
    """Both orientations of a plane scene, each refined on all points, first the one
    that was given.

    `poses` and `normals`: of the two; the plane is normal · X = 1 for model points X of
    the unit base in the frame of the left photo. `squares`: Σ r² of each; `behind`: the
    share of points behind a photo; `share`: of the points that lie in the plane within
    the limit. Where the second does not `exist` it is the first one again.
    """

    poses: tuple[RelativePose, RelativePose]
    normals: tuple[Float[Array, "*pairs 3"], Float[Array, "*pairs 3"]]
    squares: tuple[Float[Array, "*pairs"], Float[Array, "*pairs"]]
    behind: tuple[Float[Array, "*pairs"], Float[Array, "*pairs"]]
    share: Float[Array, "*pairs"]
    exists: Bool[Array, "*pairs"]


def poses(pair: Pair, orientation: Oriented, *, limit: ScalarLike = 4.0) -> PlanePoses:
    """Both orientations of points in a plane, of one pair (`jax.vmap` for batches).

    `orientation`: the one that was found. `limit`: distance from the plane, in units of
    sigma0 (of sigma without redundancy), up to which a point counts as lying in it.
    Judge by `squares`: where those of the second are as small as those of the first
    within the errors, and `behind` is zero for both, the points do not say which is
    right.
    """
    pair, _ = mask_unusable(pair)
    unit = limit * jnp.where(
        orientation.degrees_of_freedom > 0, orientation.sigma0, 1.0
    )
    pose = orientation.pose
    normal, _, share = plane(pair, pose, pair.mask, unit)
    other, exists = second(pair, pose, normal)
    return PlanePoses(
        poses=(pose, other),
        normals=(normal, plane(pair, other, pair.mask, unit).normal),
        squares=(squares(pair, pose), squares(pair, other)),
        behind=(inspect(pair, pose).behind, inspect(pair, other).behind),
        share=share,
        exists=exists,
    )


def second(
    pair: Pair, pose: RelativePose, normal: Float[Array, "3"]
) -> tuple[RelativePose, Bool[Array, ""]]:
    """The `twin` moved to the minimum of Σ r² of all points, its base on their side,
    and whether it exists and is another orientation; else the pose itself."""
    found = twin(pose, normal)
    other = facing(pair, refined(pair, found.pose, pair.mask))
    exists = found.exists & ~similar(pose, other)
    return jax.tree.map(
        lambda new, old: jnp.where(exists, new, old), other, pose
    ), exists


def second_squares(
    pair: Pair, pose: RelativePose, needed: Bool[Array, ""]
) -> Float[Array, ""]:
    """Σ r² of the second orientation of the scene, where most points lie in front of
    both photos; infinite where it does not exist, or is not `needed`: a loop of one
    round at most, entered if some pair of a batch needs it."""

    def once(state):
        needed, _ = state
        # depends on the round, or it would not wait for it
        inside = mask_unusable(pair.with_mask(pair.mask & needed))[0]
        normal = nearest_normal(inside, pose, inside.mask)
        other, exists = second(inside, pose, normal)
        fine = needed & exists & (inspect(inside, other).behind <= BEHIND)
        return needed & False, jnp.where(fine, squares(inside, other), jnp.inf)

    start = (needed, jnp.full_like(pair.focal_left, jnp.inf))
    return while_loop(lambda state: state[0], once, start, pair.focal_left)[1]


def similar(one: RelativePose, other: RelativePose) -> Bool[Array, ""]:
    """Whether rotation and base agree within DIFFERENT."""
    q = one.qw * other.qw + one.qx * other.qx + one.qy * other.qy + one.qz * other.qz
    b = one.bx * other.bx + one.by * other.by + one.bz * other.bz
    return (jnp.abs(q) > float(np.cos(DIFFERENT / 2))) & (b > float(np.cos(DIFFERENT)))


def plane(
    pair: Pair, pose: RelativePose, use: Bool[Array, "point"], limit: ArrayLike
) -> Plane:
    """The plane nearest to the points in use: n of c x p1 = (c x b) (n · p1), c = R p2,
    linear, in turns in which points off it lose their weight. A point lies in it if the
    homography takes p1 to p2 within `limit` standard deviations."""
    depths = _inverse_depths(pair, pose)
    transfer_errors = _transfer_errors(pair, pose)
    square = jnp.asarray(limit, pair.sigma.dtype) ** 2

    def turn(_, normal):
        s = transfer_errors(normal) / square
        return _fit(depths, use, 1 / (1 + jnp.minimum(s, 1e6)))

    normal = lax.fori_loop(0, TURNS, turn, _fit(depths, use))
    within = use & (transfer_errors(normal) <= square)
    share = count(within) / jnp.maximum(count(use), 1.0)
    return Plane(_finite(normal), within, share)


def nearest_normal(
    pair: Pair, pose: RelativePose, use: Bool[Array, "point"]
) -> Float[Array, "3"]:
    """The normal of the plane nearest to the points in use, as if all lay in one."""
    return _finite(_fit(_inverse_depths(pair, pose), use))


def _fit(depths: InverseDepths, use: Bool[Array, "point"], factor: ArrayLike = 1.0):
    """The normal with the inverse depths of the points in use, their weights times a
    factor."""
    weights = [jnp.where(use, depths.weight * factor, 0.0)]
    columns = [[column] for column in depths.columns]
    n, h, _ = accumulate([depths.target], columns, weights)
    return tuple(solve(n, h))


def _finite(normal: Sequence[Array]) -> Float[Array, "3"]:
    return jnp.stack([jnp.where(jnp.isfinite(c), c, 0.0) for c in normal])


def _plus_outer(m: rot.Matrix, a: rot.Vector, b: rot.Vector) -> rot.Matrix:
    """M + a bᵀ"""
    row = lambda i: rot.add_scaled(m[i], b, a[i])
    return row(0), row(1), row(2)


def _rays(pair: Pair, point: coplanarity.Point) -> tuple[rot.Vector, rot.Vector]:
    """p1 and p2 over their focal lengths."""
    x1, y1, x2, y2 = point
    left = (x1 / pair.focal_left, y1 / pair.focal_left, -jnp.ones_like(x1))
    right = (x2 / pair.focal_right, y2 / pair.focal_right, -jnp.ones_like(x2))
    return left, right


def _inverse_depths(pair: Pair, pose: RelativePose) -> InverseDepths:
    """`InverseDepths` at a pose."""
    rotation, base = pose.relative()

    def of_point(point):
        left, right = _rays(pair, point)
        c = rot.apply(rotation, right)
        across = rot.cross(c, base)
        squared = rot.dot(across, across)
        safe = jnp.where(squared > 0, squared, 1.0)
        return left, rot.dot(across, rot.cross(c, left)) / safe, squared

    return InverseDepths(*jax.vmap(of_point)(pair.coordinates))


def _transfer_errors(pair: Pair, pose: RelativePose) -> Callable:
    """A function of the normal: the squared distance of every point from where the
    homography takes p1, over 2 sigma²."""
    rotation, base = pose.relative()
    back = rot.transpose(rotation)

    def of_point(point, sigma, normal):
        left, _ = _rays(pair, point)
        nearness = rot.dot(normal, left)
        x, y, z = rot.apply(back, rot.add_scaled(left, base, -nearness))
        safe = jnp.where(z < 0, z, -1.0)
        dx = pair.focal_right * x / -safe - point[2]
        dy = pair.focal_right * y / -safe - point[3]
        return jnp.where(z < 0, (dx**2 + dy**2) / (2 * sigma**2), jnp.inf)

    of_points = jax.vmap(of_point, in_axes=(0, 0, None))
    return lambda normal: of_points(pair.coordinates, pair.sigma, normal)


def twin(pose: RelativePose, normal: Float[Array, "3"]) -> Twin:
    """The other orientation with the same homography, in closed form; the pose itself
    where there is none, as of a plane that is seen at right angles to the base, whose
    two orientations are one."""
    rotation, b = pose.relative()
    n = (normal[0], normal[1], normal[2])
    w = rot.add_scaled(rot.scale(n, 0.5), b, -1.0)
    det, square = 1 - rot.dot(b, n), rot.dot(w, w)
    there = (jnp.abs(det) > LEAST) & (square > LEAST**2)
    det, square = jnp.where(there, det, 1.0), jnp.where(there, square, 1.0)
    beta = 2 * (1 + rot.dot(n, w) - det) / square
    other = rot.add_scaled(rot.scale(w, beta / 2), n, -1.0)
    homography = _plus_outer(rot.identity(det), rot.scale(b, -1.0), n)
    inverse = _plus_outer(rot.identity(det), rot.scale(other, 1 / det), w)
    turned = rot.product(rot.transpose(rot.product(homography, inverse)), rotation)
    length = jnp.sqrt(rot.dot(other, other))
    there = there & (length > LEAST)
    length = jnp.where(there, length, 1.0)
    found = RelativePose(
        *rot.to_quaternion(turned), *(c / length for c in other)
    ).normalise()
    exists = there & jnp.isfinite(sum(jax.tree.leaves(found)))
    found = jax.tree.map(lambda a, b: jnp.where(exists, a, b), found, pose)
    return Twin(found, jnp.where(exists, jnp.stack(w) * length, normal), exists)


def refined(
    pair: Pair, pose: RelativePose, use: Bool[Array, "point"], count: int = STEPS
) -> RelativePose:
    """The pose after some Gauss-Newton steps on the points in use, or unchanged where
    they fail."""
    residuals = coplanarity.residuals(pair.with_mask(pair.mask & use), pose)
    moved = pose.move(steps(residuals, pose.origin, count, 0.3)).normalise()
    fine = squares(pair.with_mask(use), moved) <= squares(pair.with_mask(use), pose)
    return jax.tree.map(lambda new, old: jnp.where(fine, new, old), moved, pose)


def squares(pair: Pair, pose: RelativePose) -> Float[Array, ""]:
    """Σ r² of the points at a pose."""
    r = coplanarity.residuals(pair, pose)()
    return jnp.sum(jnp.where(pair.mask, r * r, 0.0))


def facing(pair: Pair, pose: RelativePose) -> RelativePose:
    """The pose with the base on the side on which most points lie in front of both
    photos."""
    sign = jnp.where(inspect(pair, pose).in_front < 0, -1.0, 1.0)
    return pose.turn_base(sign)
