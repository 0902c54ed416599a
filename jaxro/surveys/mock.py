"""Mock surveys over a grid: an eroded surface, a tilted pair of photos with lens
distortion, squares between them.

Both cameras stand at the same height over the grid, the base along its rows. A point at
(X, Y, h) is read on the right photo beside the grid: the reading of the grid at the
point is interpolated, on the left photo, between the two sides of its square that the
epipolar direction crosses. Nothing here uses the formulas of `heights`.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from ..geometry import rotations as rot
from ..geometry.mock_pairs import project
from .survey import Measured, Survey, survey


class Scene(NamedTuple):
    """What is photographed, and how (mm, degrees): `tilts` of the left and right photo
    along and across the base, `distortion` in mm at 20 mm from the principal point,
    `nearest`: the grid is read at the nearest side alone."""

    focal: float = 75.0
    camera_height: float = 2100.0
    base: float = 400.0
    side: float = 100.0
    columns: int = 5
    rows: int = 3
    depth: float = 180.0
    relief: float = 25.0
    tilts: tuple[tuple[float, float], tuple[float, float]] = ((1.5, -1.0), (-1.0, 1.2))
    distortion: float = 0.1
    nearest: bool = False


class Mock(NamedTuple):
    """A survey without errors of measurement, the true heights of its points, their
    places (mm, on the grid), and the names of points."""

    survey: Survey
    truth: Float[np.ndarray, " point"]
    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]
    names: list[str]


def surface(scene: Scene, x: ArrayLike, y: ArrayLike) -> Float[Array, "..."]:
    """A slope with rills: height over the grid."""
    x, y = jnp.asarray(x, float) / 100, jnp.asarray(y, float) / 100
    rills = 0.5 * jnp.sin(2.1 * x + 0.6 * y) + 0.35 * jnp.cos(1.3 * y - 0.4 * x)
    return -scene.depth + scene.relief * (rills + 0.15 * x)


def photo(
    scene: Scene, side: int, x: ArrayLike, y: ArrayLike, z: ArrayLike
) -> tuple[Array, Array]:
    """Photo coordinates of points on the left (0) or right (1) photo."""
    along, across = (math.radians(t) for t in scene.tilts[side])
    rotation = rot.product(
        rot.r_alpha(jnp.asarray(along)), rot.r_omega(jnp.asarray(across))
    )
    middle = scene.columns * scene.side / 2, scene.rows * scene.side / 2
    station = middle[0] + (side - 0.5) * scene.base

    def one(x, y, z):
        u, v = project(
            rotation, (x - station, y - middle[1], z - scene.camera_height), scene.focal
        )
        bent = 1 + scene.distortion / 20**3 * (u * u + v * v)
        return u * bent, v * bent

    x, y, z = jnp.broadcast_arrays(*(jnp.asarray(a, float) for a in (x, y, z)))
    return jnp.vectorize(one)(x, y, z)


def parallax(scene: Scene, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """x left less x right."""
    return photo(scene, 0, x, y, z)[0] - photo(scene, 1, x, y, z)[0]


def grid_at(scene: Scene, x: Array, y: Array, z: Array) -> Array:
    """The parallax of the grid where the left photo shows the point on it."""
    station = scene.columns * scene.side / 2 - scene.base / 2
    stretch = scene.camera_height / (scene.camera_height - z)
    middle = scene.rows * scene.side / 2
    x0, y0 = station + (x - station) * stretch, middle + (y - middle) * stretch
    sides = jnp.floor(x0 / scene.side) * scene.side
    seen = photo(scene, 0, x, y, z)[0]
    (xa, xb), (pa, pb) = zip(
        *(
            (photo(scene, 0, s, y0, 0.0)[0], parallax(scene, s, y0, 0.0))
            for s in (sides, sides + scene.side)
        ),
        strict=True,
    )
    part = (seen - xa) / (xb - xa)
    return pa + (jnp.round(part) if scene.nearest else part) * (pb - pa)


ZERO = 40.0
"""mm: what the instrument reads at parallax 0."""


def mock_survey(scene: Scene, deviations: Measured) -> Mock:
    """One traverse point s near the middle and one more point p in every square; a main
    traverse around the outer squares, closed, and one along every inner row; the first
    and the last traverse point are known.

    `deviations`: of what will be measured; add errors with `noisy`.
    """
    if min(scene.columns, scene.rows) < 2:
        raise ValueError(
            f"mock_survey: {scene.columns} columns and {scene.rows} rows; traverses "
            "need two of each"
        )
    squares = [(i, j) for j in range(scene.rows) for i in range(scene.columns)]
    rng = np.random.default_rng(1982)
    place = lambda low, high: [
        scene.side * (np.array(s) + rng.uniform(low, high, 2)) for s in squares
    ]
    x, y = np.transpose([*place(0.35, 0.65), *place(0.1, 0.9)])
    names = [f"{kind}{i + 1}{j + 1}" for kind in "sp" for i, j in squares]
    z = surface(scene, x, y)
    count, number = len(squares), {s: k for k, s in enumerate(squares)}
    corner = np.array(squares, float) * scene.side
    edge = lambda dx, dy: photo(
        scene, 1, corner[:, 0] + dx * scene.side, corner[:, 1] + dy * scene.side, 0.0
    )[0]
    photo_side = (edge(1, 0) - edge(0, 0) + edge(1, 1) - edge(0, 1)) / 2

    right, top = scene.columns - 1, scene.rows - 1
    around = [(i, 0) for i in range(right)] + [(right, j) for j in range(top)]
    around += [(i, top) for i in range(right, 0, -1)] + [
        (0, j) for j in range(top, 0, -1)
    ]
    walks = [
        [*around, (0, 0)],
        *([(i, j) for i in range(scene.columns)] for j in range(1, top)),
    ]
    legs = [(number[a], number[b]) for walk in walks for a, b in pairwise(walk)]
    start, end = np.transpose(legs)
    reading = ZERO + parallax(scene, x, y, z)
    grid = ZERO + grid_at(scene, jnp.asarray(x), jnp.asarray(y), z)
    known = np.isin(np.arange(2 * count), (0, count - 1))
    measured = Measured(
        jnp.asarray(scene.camera_height),
        jnp.asarray(scene.base),
        jnp.full(count, scene.side),
        photo_side,
        grid,
        reading,
        reading[start],
        reading[end],
    )
    made = survey(
        measured,
        deviations,
        square=np.tile(np.arange(count), 2),
        grid=np.arange(2 * count),
        datum=np.zeros(count),
        known=known,
        height=np.where(known, np.asarray(z), 0.0),
        start=start,
        end=end,
    )
    return Mock(made, np.asarray(z), x, y, names)


def noisy(measured: Measured, deviations: Measured, key: PRNGKeyArray) -> Measured:
    """The measurements with normal errors of these standard deviations."""
    keys = jax.random.split(key, len(measured))
    return Measured(
        *(
            a + s * jax.random.normal(k, a.shape, float)
            for a, s, k in zip(measured, deviations, keys, strict=True)
        )
    )
