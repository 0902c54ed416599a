"""How accurately each coordinate of a point is measured, and how the errors of x and y
of one photo depend on each other.

The covariance matrix of (x, y) of a point in one photo is sigma² Q, with a cofactor
matrix Q of its own for each photo. What is kept of Q is its root L,

    Q = L Lᵀ,    L = [[xx, 0], [yx, yy]],

so that the errors of a point are sigma L z with independent z of variance 1. A change
of the coordinates by L z in place of a change by z is all that a formula needs which
was written for coordinates of equal accuracy. sigma² is the mean of the four variances
of the point.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from ..xla.programs import is_traced

Four = tuple
"""What belongs to x_left, y_left, x_right, y_right, of one point or of all."""


Values = Float[Array | np.ndarray, "*pairs point"]


class CofactorRoots(NamedTuple):
    """The roots L of the left and of the right photo, for each point."""

    xx_left: Values
    yx_left: Values
    yy_left: Values
    xx_right: Values
    yx_right: Values
    yy_right: Values

    def displace(self, z: Four) -> Four:
        """L z: the change of the coordinates (x_left, y_left, x_right, y_right)."""
        x1, y1, x2, y2 = z
        return (
            self.xx_left * x1,
            self.yx_left * x1 + self.yy_left * y1,
            self.xx_right * x2,
            self.yx_right * x2 + self.yy_right * y2,
        )

    def pull(self, b: Four) -> Four:
        """Lᵀ bᵀ: the gradient by z of what has the gradient b by the coordinates."""
        x1, y1, x2, y2 = b
        return (
            self.xx_left * x1 + self.yx_left * y1,
            self.yy_left * y1,
            self.xx_right * x2 + self.yx_right * y2,
            self.yy_right * y2,
        )

    def swapped(self) -> "CofactorRoots":
        """Left and right exchanged."""
        return CofactorRoots(*self[3:], *self[:3])

    @property
    def fair(self) -> Bool[Array | np.ndarray, "*pairs point"]:
        """Whether these are roots of positive definite matrices."""
        small = lambda a: abs(a) <= LARGEST
        positive = lambda a: (a > 1 / LARGEST) & small(a)
        one, two, three, four, five, six = self
        left = positive(one) & small(two) & positive(three)
        return left & positive(four) & small(five) & positive(six)

    @property
    def cofactors(self) -> tuple:
        """(Q left, Q right), (..., point, 2, 2) each, in NumPy."""
        return _product(*self[:3]), _product(*self[3:])


LARGEST = 1e6
"""Ratio of two standard deviations of one point, and its inverse, above which they are
no measurement."""

UNIT = 1.0, 0.0, 1.0, 1.0, 0.0, 1.0
"""Of coordinates of equal accuracy."""


def _product(xx, yx, yy) -> Float[np.ndarray, "*pairs point 2 2"]:
    """L Lᵀ."""
    xx, yx, yy = (np.asarray(a, float) for a in (xx, yx, yy))
    rows = [[xx * xx, xx * yx], [xx * yx, yx * yx + yy * yy]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_covariances(
    left: Float[np.ndarray, "*pairs point 2 2"],
    right: Float[np.ndarray, "*pairs point 2 2"],
) -> tuple[Float[np.ndarray, "*pairs point"], CofactorRoots]:
    """sigma and the roots of covariance matrices; NaN where a matrix is not positive
    definite."""
    variances = np.stack([a[..., k, k] for a in (left, right) for k in range(2)])
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(np.mean(variances, axis=0))
        roots = [r / sigma for a in (left, right) for r in _roots(a)]
    return sigma, CofactorRoots(*roots)  # pyright: ignore[reportArgumentType]


def read_covariances(
    covariances: tuple[Any, Any], shape: tuple[int, ...], mask: Any = None
) -> tuple[Float[np.ndarray, "*pairs point"], CofactorRoots]:
    """sigma and roots of the covariance matrices that are given for the points of a pair
    of this shape; masked points may have anything. Raises ValueError for what are
    none."""
    if is_traced(covariances):
        raise ValueError(
            "pair: covariances are read outside of jit, vmap and grad: make the pair "
            "first, and give it to the traced function"
        )
    use = np.broadcast_to(True if mask is None else np.asarray(mask, bool), shape)
    both = []
    for side, given in zip(("left", "right"), covariances, strict=True):
        values = np.asarray(given, float)
        try:
            matrices = np.broadcast_to(values, (*shape, 2, 2))
        except ValueError:
            raise ValueError(
                f"pair: the covariances of the {side} photo have shape {values.shape}; "
                f"{(*shape, 2, 2)} is wanted, or (2, 2) for all points"
            ) from None
        matrices = np.where(use[..., None, None], matrices, np.eye(2))
        if not np.allclose(
            matrices[..., 0, 1], matrices[..., 1, 0], rtol=1e-9, atol=0, equal_nan=True
        ):
            raise ValueError(
                f"pair: a covariance matrix of the {side} photo is not symmetric"
            )
        both.append(matrices)
    sigma, roots = from_covariances(*both)
    wrong = np.argwhere(~np.asarray(roots.fair))
    if len(wrong):
        place = tuple(wrong[0].tolist())
        left, right = (matrices[place].tolist() for matrices in both)
        raise ValueError(
            f"pair: the covariances of point {place[-1]} are {left} and {right}; both "
            "must be positive definite, with standard deviations of about one size"
        )
    return sigma, roots


def _roots(covariance: Float[np.ndarray, "*pairs point 2 2"]) -> tuple:
    """The three numbers of L of one photo."""
    xx = np.sqrt(covariance[..., 0, 0])
    yx = covariance[..., 1, 0] / xx
    return xx, yx, np.sqrt(covariance[..., 1, 1] - yx * yx)


def covariances_of(
    sigma_x: Float[np.ndarray, " point"],
    sigma_y: Float[np.ndarray, " point"],
    covariance: Float[np.ndarray, " point"] | float = 0.0,
) -> Float[np.ndarray, "point 2 2"]:
    """Covariance matrices of x and y from their standard deviations and their
    covariance."""
    xy = np.broadcast_to(covariance, np.shape(sigma_x))
    rows = [[np.square(sigma_x), xy], [xy, np.square(sigma_y)]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
