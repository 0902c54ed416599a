"""Zones of the measured area in which the focal length has a value, or a piece of a
function, of its own (Yurchenko 2002).

Every kind of zones is a matrix: the weights of all parameters at the place of every
point. One focal length at a place is the sum of weights times parameters, whether the
zones are strips, rectangles, rings or a column of numbers, and whether the focal length
is constant in a zone or not.
"""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..adjustment.guarded import root
from .area import Area, Pair, Places
from .pieces import Pieces, pieces

Weights = Float[Array, "point zone"]


class AbstractZones(eqx.Module):
    """A division of the measured area into zones."""

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """The number of parameters."""

    @property
    @abc.abstractmethod
    def linear(self) -> tuple[bool, bool]:
        """Whether the focal length can change linearly over the whole area, along x and
        along y: then it imitates a tilt."""

    @abc.abstractmethod
    def weights(self, u: Places, area: Area) -> Weights:
        """The weights of the parameters at any places u of the frame."""


class Whole(AbstractZones):
    """One zone: one focal length in the whole area."""

    @property
    def count(self) -> int:
        return 1

    @property
    def linear(self) -> tuple[bool, bool]:
        return False, False

    def weights(self, u: Places, area: Area) -> Weights:
        return jnp.ones((len(u), 1), u.dtype)


class Rectangles(AbstractZones):
    """Rectangles, or strips where one of the axes is not divided; the axes of the zones
    are turned by `turn` (radians, from x to y of the frame).

    The weights are the products of those of `x` and of `y`: bilinear where both have
    degree 1, biquadratic at degree 2.
    """

    x: Pieces
    y: Pieces
    turn: float = 0.0

    @property
    def count(self) -> int:
        return self.x.count * self.y.count

    @property
    def linear(self) -> tuple[bool, bool]:
        return self.x.degree > 0, self.y.degree > 0

    def weights(self, u: Places, area: Area) -> Weights:
        own = self._turned(area.u)
        least = jnp.min(jnp.where(area.mask[:, None], own, jnp.inf), axis=0)
        most = jnp.max(jnp.where(area.mask[:, None], own, -jnp.inf), axis=0)
        side = jnp.where(most > least, most - least, 1.0)
        t = (self._turned(u) - least[None]) / side[None]
        along_x, along_y = self.x.weights(t[:, 0]), self.y.weights(t[:, 1])
        both = along_y[:, :, None] * along_x[:, None, :]
        return both.reshape(len(u), self.count)

    def _turned(self, u: Places) -> Places:
        """The coordinates along the axes of the zones."""
        c, s = jnp.cos(self.turn), jnp.sin(self.turn)
        return jnp.stack([c * u[:, 0] + s * u[:, 1], c * u[:, 1] - s * u[:, 0]], axis=1)


class Rings(AbstractZones):
    """Rings of equal or given widths about the principal place, or about the centroid
    of the measured points, as in the paper: this is the wrong centre where the points
    lie on one side of the image."""

    r: Pieces
    about_centroid: bool = eqx.field(static=True, default=False)

    @property
    def count(self) -> int:
        return self.r.count

    @property
    def linear(self) -> tuple[bool, bool]:
        return False, False

    def weights(self, u: Places, area: Area) -> Weights:
        centre = area.centroid if self.about_centroid else area.principal
        largest = jnp.max(jnp.where(area.mask, _distance(area.u, centre), 0.0))
        return self.r.weights(_distance(u, centre) / jnp.where(largest > 0, largest, 1))


class Numbered(AbstractZones):
    """Zones of any form: `number` gives the zone of a place, 0 to `zones` - 1."""

    number: Callable[[Places], Int[Array, " point"]] = eqx.field(static=True)
    zones: int

    @property
    def count(self) -> int:
        return self.zones

    @property
    def linear(self) -> tuple[bool, bool]:
        return False, False

    def weights(self, u: Places, area: Area) -> Weights:
        number = self.number(u)
        return (number[:, None] == jnp.arange(self.zones)[None]).astype(u.dtype)


def strips_along_x(
    number: int | Sequence[float | int], degree: int = 0, turn: float = 0.0
) -> Rectangles:
    """Strips that follow one another along x."""
    return Rectangles(pieces(number, degree), pieces(), turn)


def strips_along_y(
    number: int | Sequence[float | int], degree: int = 0, turn: float = 0.0
) -> Rectangles:
    """Strips that follow one another along y."""
    return Rectangles(pieces(), pieces(number, degree), turn)


def rectangles(
    columns: int | Sequence[float | int],
    rows: int | Sequence[float | int],
    degree: int = 0,
    turn: float = 0.0,
) -> Rectangles:
    """Rectangles in columns (along x) and rows (along y)."""
    return Rectangles(pieces(columns, degree), pieces(rows, degree), turn)


def rings(
    number: int | Sequence[float | int],
    degree: int = 0,
    *,
    about_centroid: bool = False,
) -> Rings:
    """Rings from the centre to the farthest point."""
    return Rings(pieces(number, degree), about_centroid)


def _distance(u: Places, centre: Pair) -> Float[Array, " point"]:
    apart = u - centre[None]
    squares = jnp.sum(apart**2, axis=1)
    return root(squares)
