"""Equations (5) to (10) of Dorozhinsky (1971): how one error spreads over the residual
parallaxes, to first order.

The parallax of a point at (x, y), x = 0 or b, is by equations (5) and (7)

    v = (x y / f) alpha + x chi - (f + y²/f) omega' + ((b - x) y / f) alpha' + (b - x) chi' + q.

The paper does not solve these equations by least squares. It determines every element
several times and takes means:

* alpha from every pair of a point in zone 4 and one in zone 6, alpha' from those of
  zones 3 and 5;
* omega' from every such pair of either side and the principal point of this side;
* chi (chi') from the principal point, as in (6); where a zone of this side holds more
  than one point, as the mean over the three zones of the side, each zone being the mean
  of its points, as in (6').

Its printed residuals (9) and (10) contain misprints, and they are no least-squares
residuals. So three vectors stand side by side: the printed one, the one by the paper's
own rule, and that of least squares.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np

from ..geometry.mock_pairs import ZONES

EQUATIONS = {
    9: ((1, 2, 3, 4, 5, 6, 4), (0, 4, -6, -17, 6, 1, 19)),
    10: ((1, 2, 3, 4, 5, 6, 3, 4), (-3, 3, -16.5, -1.5, -1.5, -1.5, 19.5, -1.5)),
}
"""Zones of the points, and the residuals that an error of point 7 leaves, in 36ths of
it, as printed.

In (10) the first term of v6 is printed as -delta b7; it is read as -delta q7.
"""

MISPRINTS = {
    9: "v2 must be -2 and v5 -6: with d alpha' = 0 points 3 and 5 have the same residual, "
    "so that the printed vector belongs to no set of elements",
    10: "the sign of v5 is a misprint; -delta b7 in v6 stands for -delta q7",
}

SIDES = (1, 3, 5), (2, 4, 6)
"""Zones of the left and of the right side: principal point, above, below."""


def coefficients(zones: Sequence[int], f: float, b: float, y: float) -> np.ndarray:
    """d v / d (alpha, chi, omega', alpha', chi') of points in these zones, (point,
    5)."""
    places = np.array([ZONES[zone] for zone in zones])
    x = b * places[:, 0]
    height = y * places[:, 1]
    right = b - x
    omega = -(f + height**2 / f)
    return np.stack([x * height / f, x, omega, right * height / f, right], axis=1)


def average(
    zones: Sequence[int], q: np.ndarray, f: float = 1.0, b: float = 1.0, y: float = 1.0
) -> np.ndarray:
    """alpha, chi, omega', alpha', chi' by the paper's means: equations (6), (8), (6')
    and (7')."""
    by_zone = {
        zone: [v for z, v in zip(zones, q, strict=True) if z == zone] for zone in ZONES
    }
    tilts, omegas = [], []
    for middle, above, below in SIDES:
        centre = by_zone[middle][0]
        pairs = np.array(list(product(by_zone[above], by_zone[below])))
        up, low = pairs[:, 0], pairs[:, 1]
        tilts.append(np.mean(f / (2 * b * y) * (low - up)))
        omegas += list(f / (2 * y**2) * (low + up - 2 * centre))
    omega = float(np.mean(omegas))
    swings = [
        _swing([by_zone[zone] for zone in side], omega, f, b, y) for side in SIDES
    ]
    (alpha_right, alpha), (chi_right, chi) = tilts, swings
    return np.array([alpha, chi, omega, alpha_right, chi_right])


def _swing(side: list, omega: float, f: float, b: float, y: float) -> float:
    """chi or chi' from the parallaxes of the principal point and the zones above and
    below it."""
    if all(len(zone) == 1 for zone in side):
        return f / b * omega - side[0][0] / b
    # alpha drops out of the sum over the zones above and below
    mean = float(np.mean([np.mean(zone) for zone in side]))
    return (f / b + 2 * y**2 / (3 * f * b)) * omega - mean / b


def by_the_papers_rule(equation: int, wrong: int = 6) -> np.ndarray:
    """The residuals that an error of one point (counted from 0) leaves by (5) and (7),
    in 36ths of it; f = b = y."""
    zones, _ = EQUATIONS[equation]
    q = np.eye(len(zones))[wrong]
    elements = average(zones, q)
    return 36 * (coefficients(zones, 1.0, 1.0, 1.0) @ elements + q)
