"""Mock surveys over a grid: an eroded surface, seen through a grid of squares by a
tilted pair of photos with lens distortion.

Both cameras stand at the same height over the grid, the base along its rows. A point at
(X, Y, h) is read on the right photo beside the grid: the reading of the grid at the
point is interpolated, on the left photo, between the two sides of its square that the
epipolar direction crosses. Nothing here uses the formulas of `heights`, so that these
can be tested with it.
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
from .grid_survey import Measured, Survey, survey

Squares = list[tuple[int, int]]
"""Column and row of every square."""

ZERO = 40.0
"""mm: the reading of the instrument at parallax 0."""


class Scene(NamedTuple):
    """The surface, the grid and the photos (mm, degrees).

    The grid has `columns` by `rows` squares with this `side`; the surface lies `depth`
    below it, with this `relief`. `tilts` of the left and right photo along and across
    the base; `distortion` in mm at 20 mm from the principal point. `nearest`: the grid
    is read at the nearest side alone.
    """

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
    """A survey without errors of measurement, and for its points the true heights, the
    places x and y on the grid (mm), and the names."""

    survey: Survey
    truth: Float[np.ndarray, " point"]
    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]
    names: list[str]


def surface(scene: Scene, x: ArrayLike, y: ArrayLike) -> Float[Array, "..."]:
    """Height over the grid of a slope with rills."""
    x, y = jnp.asarray(x, float) / 100, jnp.asarray(y, float) / 100
    rills = 0.5 * jnp.sin(2.1 * x + 0.6 * y) + 0.35 * jnp.cos(1.3 * y - 0.4 * x)
    return -scene.depth + scene.relief * (rills + 0.15 * x)


def photo(
    scene: Scene, side: int, x: ArrayLike, y: ArrayLike, z: ArrayLike
) -> tuple[Array, Array]:
    """Photo coordinates of points on the left (0) or right (1) photo."""
    along, across = (jnp.asarray(math.radians(t)) for t in scene.tilts[side])
    rotation = rot.product(rot.r_alpha(along), rot.r_omega(across))
    middle = scene.columns * scene.side / 2, scene.rows * scene.side / 2
    station = middle[0] + (side - 0.5) * scene.base

    def of_point(x, y, z):
        ray = x - station, y - middle[1], z - scene.camera_height
        u, v = project(rotation, ray, scene.focal)
        bent = 1 + scene.distortion / 20**3 * (u * u + v * v)
        return u * bent, v * bent

    x, y, z = jnp.broadcast_arrays(*(jnp.asarray(a, float) for a in (x, y, z)))
    return jnp.vectorize(of_point)(x, y, z)


def parallax(scene: Scene, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    """x left less x right."""
    return photo(scene, 0, x, y, z)[0] - photo(scene, 1, x, y, z)[0]


def grid_at(scene: Scene, x: Array, y: Array, z: Array) -> Array:
    """The parallax of the grid where the left photo shows the point on it."""
    station = scene.columns * scene.side / 2 - scene.base / 2
    stretch = scene.camera_height / (scene.camera_height - z)
    middle = scene.rows * scene.side / 2
    x0, y0 = station + (x - station) * stretch, middle + (y - middle) * stretch
    left = jnp.floor(x0 / scene.side) * scene.side
    right = left + scene.side
    seen, begin, end = (
        photo(scene, 0, *place)[0]
        for place in ((x, y, z), (left, y0, 0.0), (right, y0, 0.0))
    )
    part = (seen - begin) / (end - begin)
    if scene.nearest:
        part = jnp.round(part)
    first, last = parallax(scene, left, y0, 0.0), parallax(scene, right, y0, 0.0)
    return first + part * (last - first)


def mock_survey(scene: Scene, deviations: Measured) -> Mock:
    """One traverse point s near the middle and one more point p in every square; a main
    traverse around the outer squares, closed, and one along every inner row; the first
    and the last traverse point are known.

    `deviations`: of the measurements to come; add errors with `noisy`. Raises
    ValueError for a grid of less than two squares in a direction.
    """
    if min(scene.columns, scene.rows) < 2:
        raise ValueError(
            f"mock_survey: {scene.columns} columns and {scene.rows} rows; traverses "
            "need two of each"
        )
    squares = [(i, j) for j in range(scene.rows) for i in range(scene.columns)]
    count = len(squares)
    x, y = _places(scene, squares)
    z = surface(scene, x, y)
    start, end = _legs(scene, squares)
    reading = ZERO + parallax(scene, x, y, z)
    measured = Measured(
        camera_height=jnp.asarray(scene.camera_height),
        base=jnp.asarray(scene.base),
        side=jnp.full(count, scene.side),
        photo_side=_photo_sides(scene, squares),
        grid=ZERO + grid_at(scene, jnp.asarray(x), jnp.asarray(y), z),
        point=reading,
        back=reading[start],
        fore=reading[end],
    )
    known = np.isin(np.arange(2 * count), (0, count - 1))
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
    names = [f"{kind}{i + 1}{j + 1}" for kind in "sp" for i, j in squares]
    return Mock(survey=made, truth=np.asarray(z), x=x, y=y, names=names)


def _places(scene: Scene, squares: Squares) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the traverse points, then of the other points."""
    rng = np.random.default_rng(1982)
    place = lambda low, high: [
        scene.side * (np.array(s) + rng.uniform(low, high, 2)) for s in squares
    ]
    x, y = np.transpose([*place(0.35, 0.65), *place(0.1, 0.9)])
    return x, y


def _photo_sides(scene: Scene, squares: Squares) -> Array:
    """The sides of the squares on the right photo: means of their two sides along the
    base."""
    x, y = np.transpose(np.array(squares, float) * scene.side)
    corner = lambda dx, dy: photo(
        scene, 1, x + dx * scene.side, y + dy * scene.side, 0.0
    )
    below = corner(1, 0)[0] - corner(0, 0)[0]
    above = corner(1, 1)[0] - corner(0, 1)[0]
    return (below + above) / 2


def _legs(scene: Scene, squares: Squares) -> tuple[np.ndarray, np.ndarray]:
    """The squares whose traverse points each leg joins."""
    right, top = scene.columns - 1, scene.rows - 1
    around = [(i, 0) for i in range(right)] + [(right, j) for j in range(top)]
    around += [(i, top) for i in range(right, 0, -1)]
    around += [(0, j) for j in range(top, 0, -1)]
    rows = [[(i, j) for i in range(scene.columns)] for j in range(1, top)]
    number = {s: k for k, s in enumerate(squares)}
    walks = [[*around, (0, 0)], *rows]
    legs = [(number[a], number[b]) for walk in walks for a, b in pairwise(walk)]
    start, end = np.transpose(legs)
    return start, end


def noisy(measured: Measured, deviations: Measured, key: PRNGKeyArray) -> Measured:
    """The measurements with normal errors of these standard deviations."""
    keys = jax.random.split(key, len(measured))
    every = zip(measured, deviations, keys, strict=True)
    return Measured(
        *(a + s * jax.random.normal(k, a.shape, float) for a, s, k in every)
    )
