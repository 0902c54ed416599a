"""External reliability: what an error of given size in one point does to the elements,
the model heights and m_q.

All of first order. An error that changes the condition g of its point by `jump` moves
the local parameters of the pose by -N⁻¹ aᵀ jump / d, whichever of the four coordinates
it is in; a model height also follows the coordinate itself.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..adjustment.guarded import root
from ..adjustment.normal_equations import accumulate, quadratic
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
    """Change of the five elements, of m_q, and of the model height Z of the point, by
    coordinate; magnitudes."""

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
    """Of errors that change g by `jump` and the local parameters by `shift`, each in
    its own point.

    What a coordinate cannot do (jump by it, with dg/dl = 0) is zero here. `redundancy`:
    by which g itself then changes.
    """
    rows, placed, slopes = _of_parameters(orientation)
    # the rays are brought together again by -Q Bᵀ / d times what is left of the jump
    left = pair.sigma**2 * linear.weight * redundancy * jump
    z, common, by_coordinate = computed_once(_heights)(
        pair, orientation.pose, linear, placed, slopes, shift, left
    )
    scale = _length(pair, orientation, z)
    height = tuple(
        jnp.abs(slope * jump / jnp.where(b != 0, b, 1.0) + common) * scale
        for slope, b in zip(by_coordinate, linear.gradient, strict=True)
    )
    on_elements = computed_once(
        lambda rows, shift: [jnp.abs(dot(row, shift)) for row in rows]
    )(rows, shift)
    return Effects(
        on_elements,
        computed_once(_on_m_q)(pair, orientation, linear, shift, jump),
        height,
    )


def _of_parameters(orientation: Orientation):
    """Derivatives of the five elements by the local parameters of the pose (5 rows of 5
    numbers).

    And what heights depend on besides the rays (base in the scale of the model, third
    row of the model frame), and the derivatives of that by the same parameters.
    """
    system = type(orientation.elements)
    elements = orientation.elements
    length = (
        elements.bx
        if isinstance(elements, DependentElements)
        else jnp.ones_like(orientation.pose.bx)
    )

    def linearly(pose: RelativePose, length):
        def shared(*x):
            moved = pose.move(x)
            chosen = convert(moved, system, length)
            base = moved.relative()[1]
            scaled = rot.scale(base, system.scale(base, length))
            return (x if system is RelativePose else chosen.values()), (
                scaled,
                chosen.model_frame()[2],
            )

        origin = (jnp.zeros_like(length),) * 5
        (_, placed), push = jax.linearize(shared, *origin)
        unit = lambda k: tuple(
            jnp.ones_like(o) if i == k else o for i, o in enumerate(origin)
        )
        return placed, [push(*unit(k)) for k in range(5)]

    placed, slopes = computed_once(linearly)(orientation.pose, length)
    return (
        [[values[i] for values, _ in slopes] for i in range(5)],
        placed,
        [slope for _, slope in slopes],
    )


def _length(pair: Pair, orientation: Orientation, z: Values) -> Array:
    """The length of the base of independent elements over that of `_of_parameters`: it
    stands in the model only."""
    if not isinstance(orientation.elements, IndependentElements):
        return jnp.ones_like(orientation.pose.bx)
    z = jnp.where(pair.mask, z, 0.0)
    product, square = sums((z * orientation.model[2], z * z))
    return product / jnp.where(square > 0, square, 1.0)


def _heights(
    pair: Pair,
    pose: RelativePose,
    linear: Linear,
    placed: tuple,
    slopes: list[tuple],
    shift: list[Values],
    left: Values,
):
    """Z of every point, its change by the shifts of the parameters and the corrections
    that follow, and its derivatives by the four coordinates."""

    rotation, (base, third) = pose.relative()[0], placed

    def height(first, second, base, third):
        """Z of the point halfway between the rays, in the frame of the elements."""
        squared, lam, mu = coplanarity.meeting(first, second, base)
        return rot.dot(
            third, coplanarity.halfway(first, second, base, lam / squared, mu / squared)
        )

    def one(point, shift):
        x1, y1, x2, y2 = point
        right = x2, y2, -pair.focal_right
        first, second = (x1, y1, -pair.focal_left), rot.apply(rotation, right)
        z, pull = jax.vjp(height, first, second, base, third)
        by_first, by_second, *by_shared = pull(jnp.ones_like(z))
        by_right = rot.apply(rot.transpose(rotation), by_second)
        # the first three parameters of a pose turn the right photo about its own axes
        moved = rot.dot(rot.cross(right, by_right), shift[:3])
        for slope, s in zip(slopes, shift, strict=True):
            moved += dot(jax.tree.leaves(by_shared), jax.tree.leaves(slope)) * s
        return z, moved, (*by_first[:2], *by_right[:2])

    # masked points stand where no rays are parallel, so that no derivative divides by
    # zero
    corrected = [
        c + v for c, v in zip(pair.coordinates, linear.corrections(pair), strict=True)
    ]
    corrected[0] = jnp.where(pair.mask, corrected[0], pair.focal_left)
    z, moved, by_coordinate = jax.vmap(one)(tuple(corrected), shift)
    return z, moved - dot(by_coordinate, linear.gradient) * left, by_coordinate


def dot(a, b) -> Any:
    """The sum of the products of equally many entries."""
    return sum(x * y for x, y in zip(a, b, strict=True))


def _on_m_q(
    pair: Pair,
    orientation: Orientation,
    linear: Linear,
    shift: list[Values],
    jump: Values,
) -> Values:
    """How much m_q = sqrt([qq] / (n - 5)) grows, for the worse sign of the error.

    With q = c g every parallax changes by c (a · shift), that of the point itself by c
    jump more.
    """
    left, right = (
        frame[2] for frame in coplanarity.turn_to_base(*orientation.pose.relative())
    )

    def ratio(point):
        """c = -f / (Z1 Z2) of the photos turned parallel to the base."""
        x1, y1, x2, y2 = point
        first, second = (x1, y1, -pair.focal_left), (x2, y2, -pair.focal_right)
        return -pair.focal_left / (rot.dot(left, first) * rot.dot(right, second))

    own = jnp.where(pair.mask, jax.vmap(ratio)(pair.coordinates), 0.0) ** 2
    n, s, qq = accumulate([linear.g], [[column] for column in linear.columns], [own])
    square = quadratic(n, shift) + own * jump * (2 * dot(linear.columns, shift) + jump)
    cross = dot(s, shift) + own * linear.g * jump
    freedom = orientation.degrees_of_freedom
    f = jnp.where(freedom > 0, freedom, 1).astype(own.dtype)
    return root((qq + 2 * jnp.abs(cross) + square) / f) - root(qq / f)
