"""What every start returns."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ...adjustment import normal_equations as normal
from ...adjustment.residuals import Residuals
from ...geometry import coplanarity
from ...geometry.elements import AbstractElements, RelativePose, vertical
from ...geometry.pairs import Pair

LONGEST = 0.5
"""Longest component of a step towards a start (rad)."""


class StartingPose(NamedTuple):
    """A pose to begin with, whether another one fits the points as well, and whether a
    rotation alone explains them."""

    pose: AbstractElements
    ambiguous: Bool[Array, ""]
    pure_rotation: Bool[Array, ""]


class AbstractStart(eqx.Module):
    """A way to begin the adjustment of one pair of finite coordinates, whatever its
    masked points hold."""

    @abc.abstractmethod
    def __call__(self, pair: Pair) -> StartingPose:
        """The pose to begin with."""


def distances(pair: Pair, pose: RelativePose) -> Residuals:
    """Distances of the points from the condition, in the unit of the coordinates,
    around the pose."""
    return coplanarity.residuals(pair.with_sigma(1.0), pose)


class FirstOrder(NamedTuple):
    """The condition of a pair to first order in the elements of near-vertical photos,
    for any point.

    With x, y the coordinates over f of the left photo and u, v of the right one, which
    turns about its own axes,

        g = v - y + (1 + y v) rx - y u ry + u rz - (x v - y u) b1 + (x - u) b2,

    which Dorozhinsky (1971, eq. 5) has for the six standard zones.
    """

    pair: Pair

    def columns(
        self, at: tuple[Array, ...]
    ) -> tuple[list[Array], list[list[Array]], list[Array]]:
        """g at zero elements, its five slopes, and the weights of the points."""
        del at
        pair = self.pair
        # one division each: a point's would cost as much again
        left, right = (
            1 / pair.focal_left,
            1 / pair.focal_right,
        )
        x, y, u, v = (
            pair.x_left * left,
            pair.y_left * left,
            pair.x_right * right,
            pair.y_right * right,
        )
        slopes = [[1 + y * v], [-y * u], [u], [y * u - x * v], [x - u]]
        return [v - y], slopes, [jnp.where(pair.mask, 1 / pair.sigma**2, 0.0)]

    def correction(self, x: tuple[Array, ...]) -> tuple[Array, ...]:
        """What Gauss-Newton subtracts from the elements."""
        return normal.correction(self.columns(x))

    def further(
        self, x: tuple[Array, ...], step: tuple[Array, ...]
    ) -> tuple[Array, ...]:
        """The elements after a step."""
        return tuple(a + b for a, b in zip(x, step, strict=True))


def approach(pair: Pair, count: int) -> RelativePose:
    """The pose some Gauss-Newton steps from the vertical, which stays where they fail.

    The first is by the first-order equations, a third of the work.
    """
    pose = vertical(pair.focal_left)
    if count == 0:
        return pose
    near = _take_step(pose, normal.steps(FirstOrder(pair), pose.origin, 1, LONGEST))
    if count == 1:
        return near
    further = normal.steps(distances(pair, near), near.origin, count - 1, LONGEST)
    return _take_step(near, further)


def _take_step(pose: RelativePose, step: tuple[Array, ...]) -> RelativePose:
    """The pose after a step, or unchanged where that is not finite."""
    fine = jnp.isfinite(sum(step))
    there = pose.move(step).normalise()
    return jax.tree.map(lambda new, old: jnp.where(fine, new, old), there, pose)
