"""The first-order start from the six standard zones (Dorozhinsky 1971, eqs 5 and 6),
and its residuals (eqs 9, 10).

Zones (von Gruber): 1 left and 2 right principal point; 3, 4 above, 5, 6 below them at
the distance y. The y-parallax q = y_left - y_right of a point on flat ground, vertical
photos but for small angles, obeys to first order

    zones 1, 3, 5:  ±(b y/f) alpha' - (f + y²/f) omega' + b chi' + q = 0,    (y = 0 in zone 1)
    zones 2, 4, 6:  ±(b y/f) alpha  - (f + y²/f) omega' + b chi  + q = 0.    (y = 0 in zone 2)
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...geometry.elements import IndependentElements, to_pose
from ...geometry.pairs import Pair
from ...xla.passes import total
from .base import AbstractStart, StartingPose

Scalar = Float[Array, ""] | float

# 36ths of the error that stay in points 1..n, as printed in (9) and (10); the fifth
# residual of (10) has the sign that the exchange of left and right demands. The printed
# ones are averages; exact least squares: `first_order_residuals`.
SEVEN_PRINTED = (0.0, 4.0, -6.0, -17.0, 6.0, 1.0, 19.0)
EIGHT_PRINTED = (-3.0, 3.0, -16.5, -1.5, 1.5, -1.5, 19.5, -1.5)
SEVEN_ZONES = (1, 2, 3, 4, 5, 6, 4)
EIGHT_ZONES = (1, 2, 3, 4, 5, 6, 3, 4)


def six_points(
    q: Float[Array, "6"], y: Scalar, base: Scalar, focal: Scalar
) -> IndependentElements:
    """The elements from the y-parallaxes of zones 1 to 6 (eq. 6; the text's 2 y1 is a
    misprint of 2 q1).

    q, y, base (in photo units, the mean x-parallax) and focal in one unit. Error:
    second order in the angles.
    """
    q1, q2, q3, q4, q5, q6 = (q[i] for i in range(6))
    tilt = focal / (2 * base * y)
    omega2 = (q6 + q4 - 2 * q2 + q5 + q3 - 2 * q1) * focal / (4 * y**2)
    return IndependentElements(
        phi1=tilt * (q6 - q4),
        kappa1=(focal * omega2 - q2) / base,
        omega2=omega2,
        phi2=tilt * (q5 - q3),
        kappa2=(focal * omega2 - q1) / base,
    )


class SixPoints(AbstractStart):
    """The closed form on the points nearest to the six zones, for near-vertical photos
    with points in all of them.

    Error: second order in the angles, and first order in the distances of the points
    from their zones.
    """

    def __call__(self, pair: Pair) -> StartingPose:
        focal = pair.focal_left
        parallax = pair.y_left - pair.y_right * (focal / pair.focal_right)
        base = total(
            jnp.where(pair.mask, pair.x_left - pair.x_right, 0.0)
        ) / jnp.maximum(pair.count, 1.0)
        reach = jnp.max(jnp.where(pair.mask, jnp.abs(pair.y_left), 0.0))
        zones = [
            (right * base, side * reach) for side in (0, 1, -1) for right in (0, 1)
        ]
        nearest = []
        for x, y in zones:
            distance = (pair.x_left - x) ** 2 + (pair.y_left - y) ** 2
            nearest.append(jnp.argmin(jnp.where(pair.mask, distance, jnp.inf)))
        y = sum(jnp.abs(pair.y_left[i]) for i in nearest[2:]) / 4
        elements = six_points(jnp.stack([parallax[i] for i in nearest]), y, base, focal)
        no = jnp.zeros_like(focal, bool)
        return StartingPose(to_pose(elements), no, no)


def first_order_design(
    zones: Sequence[int], y: float = 1.0, base: float = 1.0, focal: float = 1.0
) -> Float[Array, "point 5"]:
    """A of A (alpha, chi, omega', alpha', chi') + q = 0, one row per point in its zone
    (eq. 5)."""
    rows = []
    for zone in zones:
        side = {1: 0, 2: 0, 3: 1, 4: 1, 5: -1, 6: -1}[zone]
        tilt, omega = side * base * y / focal, -(focal + side**2 * y**2 / focal)
        rows.append(
            (0.0, 0.0, omega, tilt, base) if zone % 2 else (tilt, base, omega, 0.0, 0.0)
        )
    return jnp.asarray(np.array(rows, float))


def first_order_residuals(
    zones: Sequence[int],
    errors: Float[Array, "point"],
    y: float = 1.0,
    base: float = 1.0,
    focal: float = 1.0,
) -> Float[Array, "point"]:
    """Residual parallaxes that the errors leave after exact least squares: v = (I - A
    (AᵀA)⁻¹ Aᵀ) errors.

    Part after part along the orthonormalised columns of A is taken off. With y = base
    the focal length cancels.
    """
    residuals, columns = errors, []
    for column in first_order_design(zones, y, base, focal).T:
        for done in (*columns, *columns):
            column = column - done * jnp.sum(done * column, keepdims=True)
        length = jnp.sqrt(jnp.sum(column * column, keepdims=True))
        columns.append(
            jnp.where(
                length > 1e-9, column / jnp.where(length > 1e-9, length, 1.0), 0.0
            )
        )
        residuals = residuals - columns[-1] * jnp.sum(
            columns[-1] * residuals, keepdims=True
        )
    return residuals


def printed_residuals_seven(error: Scalar) -> Float[Array, "7"]:
    """Eq. (9): six points without error and a seventh in zone 4 with one."""
    return jnp.asarray(SEVEN_PRINTED) / 36 * error


def printed_residuals_eight(error7: Scalar, error8: Scalar) -> Float[Array, "8"]:
    """Eq. (10): six points without error, a seventh in zone 3 and an eighth in zone 4
    with one each."""
    seventh = jnp.asarray(EIGHT_PRINTED) / 36
    # the exchange of left and right exchanges 1 2, 3 4, 5 6 and 7 8
    eighth = jnp.asarray([EIGHT_PRINTED[i ^ 1] for i in range(8)]) / 36
    return seventh * error7 + eighth * error8
