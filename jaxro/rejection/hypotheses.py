"""Orientations of random subsets of a few points: the hypotheses that `Ransac` and
`LeastMedian` choose from.

Another way to orient a subset is another `AbstractHypotheses`.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..adjustment.normal_equations import solve
from ..geometry import rotations as rot
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..geometry.rotations import Matrix, Vector
from ..orientation.starts import AbstractStart, Vertical
from ..orientation.starts.decomposition import best_pose
from ..orientation.starts.eight_point import eight_point
from ..orientation.starts.five_point import five_point
from ..orientation.starts.general import vectors
from ..xla.kernels import computed_once
from ..xla.passes import count
from .steps import in_single
from .subsets import choose_places, take_points

Poses = tuple[RelativePose, Bool[Array, "..."]]
"""Orientations on a leading axis, and which of them exist."""


class AbstractHypotheses(eqx.Module):
    """A way to orient a pair by `size` of its points; `block` subsets are solved
    together."""

    size: eqx.AbstractClassVar[int]
    block: eqx.AbstractVar[int]

    @abc.abstractmethod
    def begin(self, pair: Pair) -> RelativePose | None:
        """The pose from which all subsets of a pair begin, if they need one."""

    @abc.abstractmethod
    def __call__(self, subset: Pair, begin: RelativePose | None) -> Poses:
        """The orientations of a subset, on the places of a leading axis of fixed
        length."""


class FivePoint(AbstractHypotheses):
    """All real solutions of the five-point problem with the points in front of both
    photos, in any position (Nister 2004)."""

    size: ClassVar[int] = 5
    block: int = 4

    def begin(self, pair: Pair) -> None:
        return None

    def __call__(self, subset: Pair, begin: None) -> Poses:
        left, right = vectors(subset)
        essentials, real = five_point(left, right, polished=False)
        pose_of = lambda e: best_pose(e, left, right, subset.mask)
        poses, front = jax.vmap(pose_of)(essentials)
        return poses, real & (front == self.size)


class EightPoint(AbstractHypotheses):
    """The linear solution of eight points, then `steps` Gauss-Newton steps on their
    conditions, in any position.

    It is so much quicker than `FivePoint` that this outweighs the larger share of
    subsets with a wrong point. It fails where all points lie near a plane.
    """

    size: ClassVar[int] = 8
    steps: int = 2
    block: int = 4

    def begin(self, pair: Pair) -> None:
        return None

    def __call__(self, subset: Pair, begin: None) -> Poses:
        left, right = vectors(subset)
        essential = eight_point(left, right, jnp.ones_like(subset.x_left))
        pose, front = best_pose(essential, left, right, subset.mask)
        pose, fine = refine(subset, pose, self.steps)
        return one_place(pose, fine & (front == self.size))


class Newton(AbstractHypotheses):
    """One orientation, by `steps` of Newton's method on the conditions of five points
    from `start`.

    From the vertical it reaches near-vertical photos. From `General()` it reaches
    photos in any position, if the wrong points leave that start within some 20° of the
    solution.
    """

    size: ClassVar[int] = 5
    start: AbstractStart = Vertical(steps=0)
    steps: int = 4
    block: int = 32

    def begin(self, pair: Pair) -> RelativePose:
        return self.start(pair).pose  # pyright: ignore[reportReturnType]

    def __call__(self, subset: Pair, begin: RelativePose) -> Poses:
        return one_place(*refine(subset, begin, self.steps))


def one_place(pose: RelativePose, exists: Bool[Array, ""]) -> Poses:
    """A single orientation on a leading axis."""
    return jax.tree.map(lambda a: a[None], (pose, exists))


def refine(
    subset: Pair, pose: RelativePose, steps: int
) -> tuple[RelativePose, Bool[Array, ""]]:
    """The pose after Gauss-Newton steps on g of a few points, in single precision, and
    whether it is finite."""
    single = in_single(subset)

    def step(_, pose: RelativePose) -> RelativePose:
        equations = computed_once(lambda pose: _condition_rows(single, pose))(pose)
        *normal, (*right_side, _) = computed_once(_normal_sums)(equations)
        delta = solve(normal, right_side)
        return pose.move(tuple(-d for d in delta))

    pose = lax.fori_loop(0, steps, step, in_single(pose))
    fine = jnp.isfinite(sum(jax.tree.leaves(pose)))
    dtype = subset.focal_left.dtype
    safe = lambda a: jnp.where(fine, a, jnp.ones_like(a)).astype(dtype)
    return jax.tree.map(safe, pose).normalise(), fine


def _condition_rows(subset: Pair, pose: RelativePose) -> list[list[Array]]:
    """Of every point dg/dx by the five local parameters of `pose.moved`, and g.

    The gradient by a turn of the right photo about its own axes and by the base is one
    pass, where `pose.moved` would take five.
    """
    rotation, base = pose.relative()
    no_turn = (jnp.zeros_like(base[0]),) * 3
    tangents = rot.tangents(base)
    gradient = jax.value_and_grad(_condition, argnums=(0, 1))
    rows = []
    for x1, y1, x2, y2 in zip(*subset.coordinates, strict=True):
        left = (x1, y1, -subset.focal_left)
        right = (x2, y2, -subset.focal_right)
        g, (by_turn, by_base) = gradient(no_turn, base, rotation, left, right)
        along = [rot.dot(tangent, by_base) for tangent in tangents]
        rows.append([*by_turn, *along, g])
    return rows


def _condition(
    turn: Vector, base: Vector, rotation: Matrix, left: Vector, right: Vector
) -> Array:
    """g = b . (p1 x R p2) with the right photo turned by a small angle about its own
    axes."""
    change = rot.cross(turn, right)
    turned = tuple(a + b for a, b in zip(right, change, strict=True))
    return rot.dot(base, rot.cross(left, rot.apply(rotation, turned)))  # pyright: ignore[reportArgumentType]


def _normal_sums(rows: list[list[Array]]) -> list[list]:
    """The lower triangle of AᵀA, A the matrix of these rows."""
    return [
        [sum(row[i] * row[j] for row in rows) for j in range(i + 1)]
        for i in range(len(rows[0]))
    ]


def solve_block(
    hypotheses: AbstractHypotheses,
    pair: Pair,
    rows: Float[Array, "point 4"],
    begin: RelativePose | None,
    uniform: Float[Array, "n subset"],
) -> Poses:
    """The orientations of a block of subsets, all on one leading axis."""
    places = choose_places(uniform, count(pair.mask))
    few = take_points(pair, rows, places)
    found = jax.vmap(lambda subset: hypotheses(subset, begin))(few)
    return jax.tree.map(lambda a: a.reshape(-1), found)


def best(poses: RelativePose, cost: Float[Array, "hypothesis"]) -> RelativePose:
    """The pose with the lowest cost."""
    first = jnp.argmin(cost)
    return jax.tree.map(lambda a: a[first], poses)
