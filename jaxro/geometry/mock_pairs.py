"""Mock stereo pairs: standard zones and layouts as data, ideal photos in any position,
noise, planted errors.

A mock pair is built in the frame whose X axis is the base. A point that stands at (x,
y) in an ideal vertical left photo, `height` above the plane, has the model coordinates
(1 - height / f) (x, y, -f); a photo turned by R sees it at

    p = Rᵀ (X - B),    x = -f p1 / p3,    y = -f p2 / p3,    B = 0 (left) or (b, 0, 0) (right).

Steps are functions of a `Pair`, so an experiment reads in the order it happens, and
`vmap` over keys repeats it:

    flat = mock_pair(standard_layout(8), focal=70.0, base=70.0, y_range=70.0)
    measured = noisy(planted(flat, y_right=errors), key, 0.01)

Everything random takes a JAX key. `random_pairs` makes photos in any position for tests
of the general start.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PRNGKeyArray

from . import elements as el, rotations as rot
from .pairs import Pair, pair

ZONES: dict[int, tuple[float, float]] = {
    1: (0.0, 0.0),
    2: (1.0, 0.0),
    3: (0.0, 1.0),
    4: (1.0, 1.0),
    5: (0.0, -1.0),
    6: (1.0, -1.0),
}
"""The six von Gruber zones: x in units of the base, y in units of the y-range; 1 is the
left principal point."""

TABLE_1_ZONES = (1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 1, 2, 4, 3, 5, 1)
"""Zones of the points 1 to 16 in table 1 of Dorozhinsky (1971); its n = 6, 7, 8, 9, 10
are the first n of them."""

ROWS_1989 = (1.0, 0.9, 0.6, 0.1, -0.1, -0.6, -0.9, -1.0)
"""y of the eight rows, two points a row, of the 16-point layout of Burshtynskaya and
Tumskaya (1989).

The figure of the layout is lost. With these rows one tolerance reproduces all three
pairs that the text describes.
"""


class Layout(NamedTuple):
    """Where the points of a pair stand: x in units of the base, y in units of the
    y-range, number of the zone."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    zone: tuple[int, ...]


def standard_layout(points: int) -> Layout:
    """The first 6 to 16 points of the 1971 table, each exactly in its zone."""
    if not 6 <= points <= len(TABLE_1_ZONES):
        raise ValueError(
            f"standard_layout: has 6 to {len(TABLE_1_ZONES)} points, got {points}"
        )
    zones = TABLE_1_ZONES[:points]
    return Layout(
        tuple(ZONES[z][0] for z in zones), tuple(ZONES[z][1] for z in zones), zones
    )


def row_layout(rows: tuple[float, ...] = ROWS_1989) -> Layout:
    """Two points a row, x = 0 and b: odd numbers left, even right. The default is the
    16-point layout of 1989."""
    y = tuple(y for y in rows for _ in range(2))
    x = (0.0, 1.0) * len(rows)
    band = [1 if abs(v) < 0.5 else 3 if v > 0 else 5 for v in y]
    return Layout(
        x,
        y,
        tuple(
            zone + (0 if left == 0 else 1) for zone, left in zip(band, x, strict=True)
        ),
    )


STANDARD_LAYOUTS: dict[str, Layout] = {
    **{f"standard {n}": standard_layout(n) for n in (6, 7, 8, 9, 10, 16)},
    "eight rows": row_layout(),
}
"""The layouts of the papers by name."""


def mock_pair(
    layout: Layout,
    elements: el.AbstractElements | None = None,
    *,
    focal: ArrayLike = 70.0,
    base: ArrayLike = 70.0,
    y_range: ArrayLike | tuple[ArrayLike, ArrayLike] = 70.0,
    heights: ArrayLike = 0.0,
) -> Pair:
    """The errorless pair of a layout, (point,) per coordinate, in mm if the arguments
    are.

    `elements`: position of the photos in any system (default vertical photos); the
    layout follows the base, whatever way it points, as long as the photos look roughly
    at right angles to it. `y_range`: y of the outer zones, one value or (above, below).
    `heights`: relief above the plane at photo scale, one value or one per point.
    """
    x = jnp.asarray(layout.x, float) * base
    above, below = y_range if isinstance(y_range, tuple) else (y_range, y_range)
    side = jnp.asarray(layout.y, float)
    y = side * jnp.where(side > 0, above, below)
    focal, base = jnp.asarray(focal, float), jnp.asarray(base, float)
    scale = 1 - jnp.broadcast_to(jnp.asarray(heights, float), x.shape) / focal

    pose = el.vertical(focal) if elements is None else el.to_pose(elements)
    rotation, direction = pose.relative()
    left = el.IndependentElements.from_relative(rotation, direction, base).model_frame()
    right = rot.product(left, rotation)

    def photos(x, y, scale):
        point = rot.scale((x, y, -focal), scale)
        beyond = (point[0] - base, point[1], point[2])
        return *project(left, point, focal), *project(right, beyond, focal)

    return pair(*jax.vmap(photos)(x, y, scale), focal=focal, copies=True)


def project(
    rotation: rot.Matrix, ray: rot.Vector, focal: ArrayLike
) -> tuple[rot.Scalar, rot.Scalar]:
    """Photo coordinates of one ray in a photo turned by `rotation` (photo to model)."""
    p, focal = rot.apply(rot.transpose(rotation), ray), jnp.asarray(focal)
    return -focal * p[0] / p[2], -focal * p[1] / p[2]


def relief(
    key: PRNGKeyArray, layout: Layout, amplitude: ArrayLike
) -> Float[Array, "point"]:
    """Heights for `mock_pair`, uniform in ±amplitude."""
    return jnp.asarray(amplitude) * jax.random.uniform(
        key, (len(layout.x),), float, -1.0, 1.0
    )


def plant(
    one: Pair,
    *,
    x_left: ArrayLike = 0.0,
    y_left: ArrayLike = 0.0,
    x_right: ArrayLike = 0.0,
    y_right: ArrayLike = 0.0,
) -> Pair:
    """The pair with errors added to its coordinates: one value, or one per point.
    Masked points stay zero."""
    errors = (x_left, y_left, x_right, y_right)
    moved = [
        c + jnp.where(one.mask, jnp.asarray(e, float), 0.0)
        for c, e in zip(one.coordinates, errors, strict=True)
    ]
    names = ("x_left", "y_left", "x_right", "y_right")
    return dataclasses.replace(one, **dict(zip(names, moved, strict=True)))


def noisy(one: Pair, key: PRNGKeyArray, sigma: ArrayLike) -> Pair:
    """The pair with normal errors of standard deviation `sigma` (mm) in all four
    coordinates of its points; with `roots` of the covariances that these have with
    it."""
    errors = sigma * jax.random.normal(key, (4, *one.x_left.shape), float)
    if one.roots is not None:
        errors = one.roots.displace(tuple(errors))
    return plant(
        one, x_left=errors[0], y_left=errors[1], x_right=errors[2], y_right=errors[3]
    )


def draw_points(
    key: PRNGKeyArray, mask: Bool[Array, "point"], number: ArrayLike
) -> Bool[Array, "point"]:
    """So many points of the mask, each set of them equally likely."""
    chance = jnp.where(mask, jax.random.uniform(key, mask.shape, float), 2.0)
    rank = jnp.argsort(jnp.argsort(chance))
    return mask & (rank < number)


CONE = math.radians(20.0)
"""Half-angle of the cone that holds the points of a random pair, seen from the left
photo."""
TILT = math.radians(35.0)
"""Largest angle between the axis of either photo and the cone. With depths of two bases
and more a point is at most 35° + 20° + 30° from the axis of the right photo: always in
front of it."""


def random_pairs(
    key: PRNGKeyArray,
    count: int,
    points: int,
    *,
    focal: ArrayLike = 100.0,
    depth: tuple[float, float] = (2.0, 10.0),
) -> tuple[Pair, el.RelativePose]:
    """`count` errorless pairs of `points` points in any position, and their true poses:
    fields (pair point), (pair).

    Any turn about the photo axes, axes up to 70° apart, base in any direction, every
    point at a distance of `depth` bases from the left photo and in front of both.
    Raises ValueError if the nearest is under two bases.
    """
    if not 2.0 <= depth[0] <= depth[1]:
        raise ValueError(
            "random_pairs: depth must be (nearest, farthest) with nearest >= 2 bases, "
            f"got {depth}"
        )
    return jax.vmap(
        lambda key: _random_pair(key, points, jnp.asarray(focal, float), depth)
    )(jax.random.split(key, count))


def _random_pair(key, points, focal, depth):
    keys = jax.random.split(key, 6)
    base = rot.unit(tuple(jax.random.normal(keys[0], (3,), float)))
    spin = jax.random.uniform(keys[1], (), float, -jnp.pi, jnp.pi)
    cloud_left, cloud_right = (_frame(_towards(key, TILT, -1.0)) for key in keys[2:4])
    rotation = rot.product(
        rot.product(cloud_left, rot.r_chi(spin)), rot.transpose(cloud_right)
    )

    def photos(key, distance):
        point = rot.scale(rot.apply(cloud_left, _towards(key, CONE, 1.0)), distance)
        beyond = (point[0] - base[0], point[1] - base[1], point[2] - base[2])
        return *project(rot.identity(focal), point, focal), *project(
            rotation, beyond, focal
        )

    distances = jax.random.uniform(keys[4], (points,), float, *depth)
    coordinates = jax.vmap(photos)(jax.random.split(keys[5], points), distances)
    return pair(*coordinates, focal=focal), el.RelativePose(
        *rot.to_quaternion(rotation), *base
    )


def _towards(key, half_angle, side):
    """A unit vector uniform in the cone about side * z."""
    height, turn = jax.random.uniform(key, (2,), float)
    z = 1 - height * (1 - math.cos(half_angle))
    across = jnp.sqrt(1 - z * z)
    return (
        across * jnp.cos(2 * jnp.pi * turn),
        across * jnp.sin(2 * jnp.pi * turn),
        side * z,
    )


def _frame(direction):
    """The rotation whose third column is the given unit vector."""
    return rot.transpose((*rot.tangents(direction), direction))
