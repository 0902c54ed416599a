"""External reliability: what an error of given size in one point does to the elements,
to the model height of the point and to m_q.

Everything is of first order. An error that changes the condition g of its point by
`jump` moves the local parameters of the pose by -N⁻¹ aᵀ jump / d, whichever of the four
coordinates it is in. A model height also follows the coordinate itself.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..adjustment.guarded import ratio, root
from ..adjustment.normal_equations import quadratic
from ..geometry import coplanarity, rotations as rot
from ..geometry.elements import (
    DependentElements,
    IndependentElements,
    RelativePose,
    convert,
)
from ..geometry.linear import Linear, Values
from ..geometry.pairs import Coordinates, Pair
from ..orientation.result import Orientation
from ..xla.kernels import computed_once
from ..xla.passes import sums


class Effects(NamedTuple):
    """How much each error changes the five `elements`, `m_q`, and the model `height` Z
    of its point, if it is in x_left, y_left, x_right or y_right; all positive."""

    elements: list[Values]
    m_q: Values
    height: Coordinates


def effects(
    pair: Pair,
    orientation: Orientation,
    linear: Linear,
    shift: list[Values],
    jump: Values,
    redundancy: Values,
) -> Effects:
    """Effects of errors, each in its own point, that change g by `jump` and the local
    parameters by `shift`.

    `redundancy`: the part of the jump that remains in g. A coordinate with dg/dl = 0
    cannot cause the jump; its own term in the height is left out.
    """
    slopes = _slopes(orientation)
    # the rays are brought together again by -Q Bᵀ / d times what is left of the jump
    left = pair.sigma**2 * linear.weight * redundancy * jump
    z, common, by_coordinate = computed_once(_heights)(
        pair, orientation.pose, linear, slopes, shift, left
    )
    scale = _scale(pair, orientation, z)
    height = []
    for slope, b in zip(by_coordinate, linear.gradient, strict=True):
        error = jump / jnp.where(b != 0, b, 1.0)
        height.append(jnp.abs(slope * error + common) * scale)
    project = lambda rows, shift: [jnp.abs(dot(row, shift)) for row in rows]
    return Effects(
        elements=computed_once(project)(slopes.elements, shift),
        m_q=computed_once(_on_m_q)(pair, orientation, linear, shift, jump),
        height=tuple(height),
    )


class _Slopes(NamedTuple):
    """Derivatives by the five local parameters of the pose.

    `elements`: five rows of five numbers. `frame`: base in the scale of the model, and
    third row of the model frame, which heights depend on besides the rays; `by`: five
    trees of its derivatives.
    """

    elements: list[list[Array]]
    frame: tuple
    by: list[tuple]


def _slopes(orientation: Orientation) -> _Slopes:
    elements, pose = orientation.elements, orientation.pose
    system, one = type(elements), jnp.ones_like(pose.bx)
    length = elements.bx if isinstance(elements, DependentElements) else one

    def linearise(pose: RelativePose, length: Array):
        def moved_by(*x):
            moved = pose.move(x)
            chosen = convert(moved, system, length)
            base = moved.relative()[1]
            frame = (
                rot.scale(base, system.scale(base, length)),
                chosen.model_frame()[2],
            )
            return x if system is RelativePose else chosen.values(), frame

        origin = [jnp.zeros_like(length)] * 5
        (_, frame), push = jax.linearize(moved_by, *origin)
        unit = lambda k: [*origin[:k], jnp.ones_like(length), *origin[k + 1 :]]
        return frame, [push(*unit(k)) for k in range(5)]

    frame, slopes = computed_once(linearise)(pose, length)
    rows = [[values[i] for values, _ in slopes] for i in range(5)]
    return _Slopes(elements=rows, frame=frame, by=[slope for _, slope in slopes])


def _scale(pair: Pair, orientation: Orientation, z: Values) -> Array:
    """The scale of the model over the scale of `_slopes`, from the heights z in the
    latter: the base of independent elements is in the model only."""
    if not isinstance(orientation.elements, IndependentElements):
        return jnp.ones_like(orientation.pose.bx)
    z = jnp.where(pair.mask, z, 0.0)
    product, square = sums((z * orientation.model[2], z * z))
    return ratio(product, square, square > 0)


def _heights(
    pair: Pair,
    pose: RelativePose,
    linear: Linear,
    slopes: _Slopes,
    shift: list[Values],
    left: Values,
) -> tuple[Values, Values, Coordinates]:
    """Z of every point, its change by the shifts of the parameters and by the
    corrections that follow, and its derivatives by the four coordinates."""
    rotation = pose.relative()[0]

    def of_point(point, shift):
        x1, y1, x2, y2 = point
        right = x2, y2, -pair.focal_right
        first, second = (x1, y1, -pair.focal_left), rot.apply(rotation, right)
        z, pull = jax.vjp(_height, first, second, *slopes.frame)
        by_first, by_second, *by_frame = pull(jnp.ones_like(z))
        by_right = rot.apply(rot.transpose(rotation), by_second)
        # the first three parameters of a pose turn the right photo about its own axes
        moved = rot.dot(rot.cross(right, by_right), shift[:3])
        for slope, s in zip(slopes.by, shift, strict=True):
            moved += dot(jax.tree.leaves(by_frame), jax.tree.leaves(slope)) * s
        return z, moved, (*by_first[:2], *by_right[:2])

    z, moved, by_coordinate = jax.vmap(of_point)(_corrected(pair, linear), shift)
    return z, moved - dot(by_coordinate, linear.lever) * left, by_coordinate


def _height(first, second, base, third):
    """Z of the point halfway between two rays, in the frame of the elements."""
    squared, lam, mu = coplanarity.meeting(first, second, base)
    point = coplanarity.halfway(first, second, base, lam / squared, mu / squared)
    return rot.dot(third, point)


def _corrected(pair: Pair, linear: Linear) -> Coordinates:
    """The corrected coordinates. Masked points stand where no rays are parallel, so
    that no derivative divides by zero."""
    both = zip(pair.coordinates, linear.corrections(pair), strict=True)
    x, *others = (c + v for c, v in both)
    return jnp.where(pair.mask, x, pair.focal_left), *others


def _on_m_q(
    pair: Pair,
    orientation: Orientation,
    linear: Linear,
    shift: list[Values],
    jump: Values,
) -> Values:
    """How much m_q = sqrt([qq] / (n - 5)) grows, for the worse sign of the error.

    With q = c g every parallax changes by c (a · shift), and the one of the point
    itself by c jump more.
    """
    frames = coplanarity.turn_to_base(*orientation.pose.relative())
    left, right = (frame[2] for frame in frames)

    def ratio(point):
        """c = -f / (Z1 Z2) of the photos turned parallel to the base."""
        x1, y1, x2, y2 = point
        first, second = (x1, y1, -pair.focal_left), (x2, y2, -pair.focal_right)
        return -pair.focal_left / (rot.dot(left, first) * rot.dot(right, second))

    own = jnp.where(pair.mask, jax.vmap(ratio)(pair.coordinates), 0.0) ** 2
    n, h, qq = linear.normal_equations(own)
    along = 2 * linear.times(shift) + jump
    square = quadratic(n, shift) + own * jump * along
    cross = dot(h, shift) + own * linear.g * jump
    freedom = orientation.degrees_of_freedom
    f = jnp.where(freedom > 0, freedom, 1).astype(own.dtype)
    return root((qq + 2 * jnp.abs(cross) + square) / f) - root(qq / f)


def dot(a, b) -> Any:
    """The sum of the products of equally many entries."""
    return sum(x * y for x, y in zip(a, b, strict=True))
