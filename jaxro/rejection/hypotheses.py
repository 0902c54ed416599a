"""Random subsets of a few points and the orientations they have: what `Ransac` and
`LeastMedian` choose from."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..adjustment.normal_equations import solve
from ..geometry import coplanarity, rotations as rot
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

Poses = tuple[RelativePose, Bool[Array, "..."]]
"""Orientations on a leading axis, and which of them exist."""


class AbstractHypotheses(eqx.Module):
    """A way to orient a pair by `size` of its points; `block` subsets are solved
    together."""

    size: eqx.AbstractClassVar[int]
    block: eqx.AbstractVar[int]

    @abc.abstractmethod
    def begin(self, pair: Pair) -> RelativePose | None:
        """What all subsets of a pair begin with."""

    @abc.abstractmethod
    def __call__(self, subset: Pair, begin: RelativePose | None) -> Poses:
        """The orientations of a subset, on the places of a leading axis of fixed
        length."""


class FivePoint(AbstractHypotheses):
    """All real solutions of the five-point problem that have the points in front of
    both photos: any position."""

    size: ClassVar[int] = 5
    block: int = 4

    def begin(self, pair: Pair) -> None:
        return None

    def __call__(self, subset: Pair, begin: None) -> Poses:
        left, right = vectors(subset)
        essentials, real = five_point(left, right, polished=False)
        poses, front = jax.vmap(lambda e: best_pose(e, left, right, subset.mask))(
            essentials
        )
        return poses, real & (front == self.size)


class EightPoint(AbstractHypotheses):
    """The linear solution of eight points and `steps` Gauss-Newton steps on their
    conditions: any position.

    A fifteenth of the work of `FivePoint`, which outweighs that a subset of eight more
    often holds a wrong point. Where all points lie near a plane it fails.
    """

    size: ClassVar[int] = 8
    steps: int = 2
    block: int = 4

    def begin(self, pair: Pair) -> None:
        return None

    def __call__(self, subset: Pair, begin: None) -> Poses:
        left, right = vectors(subset)
        pose, front = best_pose(
            eight_point(left, right, jnp.ones_like(subset.x_left)),
            left,
            right,
            subset.mask,
        )
        pose, fine = refined(subset, pose, self.steps)
        return jax.tree.map(lambda a: a[None], pose), (fine & (front == self.size))[
            None
        ]


class Newton(AbstractHypotheses):
    """`steps` of Newton's method on the conditions of five points, from `start`: one
    orientation.

    A fiftieth of the work of `FivePoint`. From the vertical it reaches near-vertical
    photos; from `General()` photos in any position, if the wrong points leave that
    start within some 20° of the solution.
    """

    size: ClassVar[int] = 5
    start: AbstractStart = Vertical(steps=0)
    steps: int = 4
    block: int = 32

    def begin(self, pair: Pair) -> RelativePose:
        return self.start(pair).pose  # pyright: ignore[reportReturnType]

    def __call__(self, subset: Pair, begin: RelativePose) -> Poses:
        pose, fine = refined(subset, begin, self.steps)
        return jax.tree.map(lambda a: a[None], pose), fine[None]


def refined(
    subset: Pair, pose: RelativePose, steps: int
) -> tuple[RelativePose, Bool[Array, ""]]:
    """The pose after Gauss-Newton steps on g of a few points, in single precision, and
    whether it is finite."""
    single = lambda a: a.astype(jnp.float32)
    left, right = single(subset.focal_left), single(subset.focal_right)
    points = [
        tuple(single(c[i]) for c in subset.coordinates)
        for i in range(subset.x_left.shape[0])
    ]
    zero, one = jnp.zeros_like(left), jnp.ones_like(left)

    def condition(turn: Vector, base: Vector, rotation: Matrix, point) -> Array:
        """g with the right photo turned about its own axes: one gradient, where
        `pose.moved` takes five slopes."""
        x1, y1, x2, y2 = point
        p2 = (x2, y2, -right)
        turned = tuple(a + b for a, b in zip(p2, rot.cross(turn, p2), strict=True))
        return rot.dot(base, rot.cross((x1, y1, -left), rot.apply(rotation, turned)))  # pyright: ignore[reportArgumentType]

    def rows(pose: RelativePose):
        rotation, base = pose.relative()
        tangents = rot.tangents(base)
        each = []
        for point in points:
            g, (turn, n) = jax.value_and_grad(condition, argnums=(0, 1))(
                (zero,) * 3, base, rotation, point
            )
            each.append([*turn, *(rot.dot(t, n) for t in tangents), g])
        return each

    def normal(rows):
        return [
            [sum(row[i] * row[j] for row in rows) for j in range(i + 1)]
            for i in range(6)
        ]

    def step(_, pose: RelativePose):
        *n, (*h, _) = computed_once(normal)(computed_once(rows)(pose))
        return pose.move(tuple(-d for d in solve(n, h)))

    pose = lax.fori_loop(0, steps, step, jax.tree.map(single, pose))
    fine = jnp.isfinite(sum(jax.tree.leaves(pose)))
    return jax.tree.map(
        lambda a: jnp.where(fine, a, one).astype(subset.focal_left.dtype), pose
    ).normalise(), fine


def draws(
    hypotheses: AbstractHypotheses, count: int, seed: int
) -> Float[Array, "block place subset"]:
    """Uniform random numbers for `count` subsets, the same for every pair."""
    shape = -(-count // hypotheses.block), hypotheses.size, hypotheses.block
    return jnp.asarray(np.random.default_rng(seed).random(shape, np.float32))


def subsets(
    uniform: Float[Array, "place subset"], of: Float[Array, ""]
) -> Int[Array, "place subset"]:
    """Different numbers below `of`, as many as there are places, every choice equally
    likely (Floyd's algorithm: each is drawn from one number more than the one before,
    and is the new one where it would repeat another)."""
    taken: list = []
    for j in reversed(range(uniform.shape[0])):
        last = jnp.maximum(of.astype(uniform.dtype) - j, 1.0) - 1
        number = jnp.minimum(jnp.floor(uniform[j] * (last + 1)), last)
        again = sum(
            (number == other for other in taken), start=jnp.zeros(number.shape, bool)
        )
        taken.append(jnp.where(again, last, number))
    return jnp.stack(taken).astype(jnp.int32)


def moved_up(pair: Pair) -> Float[Array, "point 4"]:
    """The coordinates of the points that take part, moved before all others, so that
    padding changes no subset."""
    rows = jnp.stack(pair.coordinates, axis=-1)
    place = jnp.where(pair.mask, jnp.cumsum(pair.mask) - 1, len(rows))
    return jnp.zeros_like(rows).at[place].set(rows, mode="drop")


def chosen(
    pair: Pair, points: Float[Array, "point 4"], places: Int[Array, "place subset"]
) -> Pair:
    """The subsets as pairs of a few points, of unit weight."""
    few = points.at[places.T].get(mode="clip")
    focal = lambda f: jnp.broadcast_to(f, few.shape[:1])
    return Pair(
        *(few[:, :, k] for k in range(4)),
        jnp.ones_like(few[:, :, 0]),
        jnp.ones(few.shape[:2], bool),
        focal(pair.focal_left),
        focal(pair.focal_right),
    )


def solutions(
    hypotheses: AbstractHypotheses, pair: Pair, points, begin, uniform
) -> Poses:
    """The orientations of a block of subsets, one after another on the leading axis."""
    few = chosen(pair, points, subsets(uniform, count(pair.mask)))
    found = jax.vmap(lambda subset: hypotheses(subset, begin))(few)
    return jax.tree.map(lambda a: a.reshape(-1), found)


def squares(pair: Pair, pose: RelativePose) -> Float[Array, "point"]:
    """(r / sigma)² of every point."""
    residuals = coplanarity.residuals(pair, pose)
    one = lambda g, d, use: jnp.where(use, g[0] ** 2 / d[0][0], 0.0)
    return residuals.groups(
        one, residuals.shared(*(jnp.zeros_like(pair.focal_left),) * 5)
    )


def best(poses: RelativePose, score: Float[Array, "hypothesis"]) -> RelativePose:
    """The pose with the lowest score."""
    first = jnp.argmin(score)
    return jax.tree.map(lambda a: a[first], poses)
