"""What is wrong with a pair as a whole: its axes, units and origin, as functions of
numbers.

A photo whose y counts the other way, or whose x and y are exchanged, is the mirror image
of a photo, up to a turn about its axis. All its points still fulfil the condition of
coplanarity, but with rays that point the other way: the points would lie behind one
photo, or half of them behind both. Which of the two photos is the mirrored one the
points do not tell.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WIDEST = 70.0
"""Angle (degrees) from the axis that hardly any perspective camera sees."""

NO_LENS = 20.0
"""Distance from the principal point, in focal lengths, that none sees (87°)."""

NARROWEST = 0.5
"""Angle (degrees) from the axis within which hardly any camera has its whole field."""

OUTER = 75.0
"""Percentile of the distances from the principal point that stands for the outer points:
a few wrong coordinates do not move it."""

CORNER_POINTS = 6
"""Points from which on a single quadrant is no chance."""

CORNER_WIDTH = 0.5
"""Extent of coordinates of one sign over the largest one, from which on they are spread
from an edge and are no cluster of points."""

ABSURD = 0.01
"""sigma0 over the focal length that no measurement has."""

GOOD = 0.002
"""sigma0 over the focal length up to which a mirrored pair fits."""

OFF = 5.0
"""Ratio of sigma0 to the standard deviation given, and its inverse, that deserves a
word."""

FEW_CHECKS = 3
"""Degrees of freedom below which a sigma0 may be large or small by chance."""

LEAST_MORE = 2
"""Points that a hypothesis has to explain beyond those explained without it, and a tenth
of all."""

MOST_LEFT = 1 / 3
"""Part of the points that a mirrored pair may leave unexplained."""

PLANE = 3.0
"""Distance of the points from a homography, in sigma0, up to which they may as well lie
in a plane."""

Points = Float[np.ndarray, "point 2"]


class Fit(NamedTuple):
    """How well a pair came out. `usable`: whether its orientation may be used, and its
    cleaning is finished; `points` kept; those that lie `in_front` of both photos;
    `sigma0` as a standard deviation of a coordinate."""

    usable: bool
    points: int
    in_front: int
    sigma0: float


def is_mirrored(given: Fit, mirrored: Fit, count: int, focal: float) -> bool:
    """Whether one of the photos of a pair of `count` points is a mirror image: whether
    the pair fits with one photo mirrored, and does not as it is given."""
    if not mirrored.usable or mirrored.points - 5 < FEW_CHECKS:
        return False
    if mirrored.points < (1 - MOST_LEFT) * count or mirrored.sigma0 > GOOD * focal:
        return False
    more = max(LEAST_MORE, 0.1 * count)
    if mirrored.points < given.in_front + more:
        return False
    if not given.usable:
        return True
    # a larger sigma0 explains more points by itself
    return mirrored.sigma0 < 3 * given.sigma0


def lie_in_plane(left: Points, right: Points, noise: float) -> bool:
    """Whether a homography takes the left points to the right ones within the `noise` of
    a coordinate: points in a plane, or photos that only turn. Their mirror image is one
    of a plane seen from its other side, so that nothing tells the two apart."""
    if len(left) < 5:
        return True
    scale = max(float(np.abs(left).max()), float(np.abs(right).max()), 1e-300)
    p, q = (np.column_stack([a / scale, np.ones(len(a))]) for a in (left, right))
    zero = np.zeros_like(p)
    rows = np.concatenate(
        [
            np.hstack([p, zero, -q[:, :1] * p]),
            np.hstack([zero, p, -q[:, 1:2] * p]),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    moved = p @ matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = (moved[:, :2] / moved[:, 2:] - q[:, :2]) * scale
    # the errors of both photos, and eight numbers fitted
    freedom = max(2 * len(p) - 8, 1)
    return bool(np.sum(apart**2) <= 2 * freedom * (PLANE * noise) ** 2)


def distances(photo: Points, focal: float) -> Float[np.ndarray, " point"]:
    """Distances of points from the principal point over the focal length; of those that
    exist."""
    there = photo[np.all(np.isfinite(photo), axis=1)]
    return np.hypot(*there.T) / focal


def outer_distance(photo: Points, focal: float) -> float:
    """Distance of the outer points from the principal point, in focal lengths; NaN
    without points."""
    reached = distances(photo, focal)
    return float(np.percentile(reached, OUTER)) if reached.size else np.nan


def is_no_lens(photo: Points, focal: float) -> bool:
    """Whether no camera has a field as wide as these points need."""
    return outer_distance(photo, focal) > NO_LENS


def tell_field(photo: Points, focal: float) -> str | None:
    """A sentence about a field of view that is far too wide or far too narrow: the unit
    of the focal length is then not that of the coordinates. None where it is fine."""
    reached = distances(photo, focal)
    if not reached.size:
        return None
    largest = float(reached.max())
    angle = np.degrees(np.arctan(largest))
    asked = "is the focal length in the unit of the coordinates?"
    if np.degrees(np.arctan(outer_distance(photo, focal))) > WIDEST:
        return (
            f"rays stand up to {angle:.1f}° from the axis (coordinates reach "
            f"{largest:.3g} focal lengths): {asked}"
        )
    if angle < NARROWEST:
        return f"all rays lie within {angle:.2g}° of the axis: {asked}"
    return None


def is_corner(photo: Points) -> bool:
    """Whether the origin of the coordinates seems to be a corner of the photo: x is
    positive and y has one sign everywhere, and both reach from near zero far away."""
    there = photo[np.all(np.isfinite(photo), axis=1)]
    if len(there) < CORNER_POINTS or not np.all(there[:, 0] > 0):
        return False
    if not (np.all(there[:, 1] > 0) or np.all(there[:, 1] < 0)):
        return False
    sizes = np.abs(there)
    return bool(np.all(np.ptp(sizes, axis=0) > CORNER_WIDTH * sizes.max(axis=0)))


def tell_origin(left: Points, right: Points) -> str | None:
    """A sentence where the coordinates of both photos seem to count from a corner."""
    if not (is_corner(left) and is_corner(right)):
        return None
    reach = np.abs(np.concatenate([left, right])).max(axis=0)
    y = "x and y" if np.median(left[:, 1]) > 0 else "x and -y"
    return (
        f"all {y} are positive on both photos, up to {reach[0]:.6g} and {reach[1]:.6g}: "
        "the origin seems to be a corner; give the principal point (--principal-point X "
        "Y, or --camera)"
    )


def tell_sigma0(
    sigma0: float, freedom: int, focal: float, sigma: float | None, unit: str
) -> str | None:
    """A sentence where residuals are absurd for the focal length, or far from the
    standard deviation `sigma` that was given for a coordinate. `sigma0`: as a standard
    deviation of a coordinate, with so many degrees of `freedom`."""
    if freedom < FEW_CHECKS or not np.isfinite(sigma0):
        return None
    size = f"{sigma0:.2g} {unit}".rstrip()
    if sigma0 > ABSURD * focal:
        return (
            f"the coordinates misfit by {size}, {100 * sigma0 / focal:.2g} % of the "
            "focal length: points are exchanged or wrong, or the camera is another one"
        )
    if sigma is None or not sigma > 0:
        return None
    if sigma0 > OFF * sigma:
        return (
            f"the coordinates misfit by {size}, {sigma0 / sigma:.2g} times the standard "
            "deviation given: points are wrong, or it is too small"
        )
    # few residuals may be small by chance
    if sigma0 * OFF < sigma and freedom > FEW_CHECKS + 1:
        return (
            f"the coordinates misfit by {size} only, a {sigma / sigma0:.2g}th of the "
            "standard deviation given: it is too large"
        )
    return None
