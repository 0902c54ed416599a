"""Functions of one coordinate in pieces: constant, linear, quadratic or cubic in each,
with as many continuous derivatives as their degree allows.

They are sums of B-splines (Cox 1972, de Boor 1972): degree 0 gives a number for each
piece, degree 1 a number for each border between pieces and both ends, degree 2 and 3
have continuous first and second derivatives.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Pieces(eqx.Module):
    """The pieces of one axis: `borders` from 0 to 1, and the `degree` of the polynomial
    in each."""

    borders: tuple[float, ...] = eqx.field(static=True)
    degree: int = eqx.field(static=True)

    @property
    def count(self) -> int:
        """The number of parameters."""
        return len(self.borders) - 1 + self.degree

    def weights(self, t: Float[Array, " point"]) -> Float[Array, "point count"]:
        """The B-splines at t; the first and the last piece go on outside of [0, 1]."""
        knots = np.concatenate(
            [np.zeros(self.degree), np.array(self.borders), np.ones(self.degree)]
        )
        t = t[:, None]
        pieces = len(knots) - 1
        first, last = self.degree, pieces - self.degree - 1
        inner = np.asarray(knots[first + 1 : last + 1])
        number = first + jnp.sum(t >= inner[None], axis=1, keepdims=True)
        values = (number == np.arange(pieces)[None]).astype(t.dtype)
        for degree in range(1, self.degree + 1):
            begin, spread = knots[:-degree], knots[degree:] - knots[:-degree]
            there = spread > 0  # of knots that coincide nothing is left
            part = (t - begin[None]) / np.where(there, spread, 1.0)[None]
            rise = jnp.where(there[None], part, 0.0)
            fall = jnp.where(there[None], 1 - part, 0.0)
            values = rise[:, :-1] * values[:, :-1] + fall[:, 1:] * values[:, 1:]
        return values


def pieces(number: int | Sequence[float | int] = 1, degree: int = 0) -> Pieces:
    """`number` pieces of equal width, or pieces between the borders given, from the
    first to the last of them; of degree 0 to 3.

    Raises ValueError for no piece, borders that do not grow, or another degree.
    """
    if isinstance(number, int):
        if number < 1:
            raise ValueError(f"pieces: at least one piece, got {number}")
        number = np.linspace(0.0, 1.0, number + 1).tolist()
    borders = np.asarray(number, float)
    if borders.size < 2 or not np.all(np.diff(borders) > 0):
        raise ValueError(f"pieces: borders have to grow, got {borders.tolist()}")
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"pieces: the degree is 0, 1, 2 or 3, got {degree}")
    borders = (borders - borders[0]) / (borders[-1] - borders[0])
    return Pieces(tuple(borders.tolist()), degree)
