"""Pairs with known answers, and comparisons by geometry, shared by the tests."""

import csv
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles

import jaxro
from jaxro import DependentElements, IndependentElements, Pair, RelativePose, pair
from jaxro.experiments import dorozhinsky1971
from jaxro.geometry import mock_pairs, rotations
from jaxro.xla.settings import COMPILE_FAST, known_settings

orient = jaxro.orient
"""Compiled once per element system, residual and shape for the whole run of tests."""

jit = partial(jax.jit, compiler_options=known_settings(COMPILE_FAST))
"""For large programs that run once."""

SYSTEMS = (RelativePose, IndependentElements, DependentElements)

DEWITT_FOCAL = 152.113
DEWITT = np.array(
    [
        [-4.878, 1.974, -97.920, -2.923],
        [89.307, 2.709, -1.507, -1.856],
        [0.261, 84.144, -90.917, 78.970],
        [90.334, 83.843, -1.571, 79.470],
        [-4.668, -86.821, -100.060, -95.748],
        [88.599, -85.274, -0.965, -94.319],
    ]
).T
"""x_left, y_left, x_right, y_right of points a to f (mm); the sample of Dewitt's
public-domain program."""

TABLE_1_ERRORS = np.array(
    [0, 0, 0, 0, 0, 0, 2.0, 2.2, -2.43, -1.90, 0, 0, 0, 0, -0.60, 2.1]
)
"""Errors of the right-hand y behind table 1 (1971) in mm; the signs at 9 and 10 and the
error at 15 are recovered."""


def dewitt() -> Pair:
    """The six points of Dewitt's sample."""
    return pair(*DEWITT, focal=DEWITT_FOCAL)


@partial(jax.jit, static_argnums=0)
def table_1(points: int) -> Pair:
    """The flat mock pair of table 1 with the first `points` points."""
    flat = mock_pairs.mock_pair(
        mock_pairs.standard_layout(points), focal=70.0, base=70.0, y_range=70.0
    )
    return mock_pairs.plant(flat, y_right=TABLE_1_ERRORS[:points])


table_2 = dorozhinsky1971.table_2
"""The flat mock pair of table 2, eight points, errors at points 7 and 8."""


@jax.jit
def tilted(sigma: float = 0.01, seed: int = 0) -> Pair:
    """Sixteen points with relief, photos tilted by a few degrees, normal errors: the
    usual measured pair."""
    elements = IndependentElements(
        *(jnp.asarray(e) for e in (0.03, -0.05, 0.04, -0.02, 0.06))
    )
    heights_key, noise_key = jax.random.split(jax.random.key(seed))
    layout = mock_pairs.row_layout()
    heights = mock_pairs.relief(heights_key, layout, 8.0)
    return mock_pairs.noisy(
        mock_pairs.mock_pair(layout, elements, heights=heights), noise_key, sigma
    )


class Case(NamedTuple):
    """A pair of photos in a certain position: the rotation of the right one into the
    left one, the base (mm), points in the frame of the left photo, its focal length,
    and the standard deviation of a coordinate."""

    rotation: np.ndarray
    base: np.ndarray
    points: np.ndarray
    focal: float = 70.0
    sigma: float = 0.01

    def measure(self, sigma: float | None = None, seed: int = 0) -> Pair:
        """The pair with normal errors, of another standard deviation if given."""
        right = (self.points - self.base) @ self.rotation
        exact = [
            -self.focal * image[:, axis] / image[:, 2]
            for image in (self.points, right)
            for axis in (0, 1)
        ]
        errors = np.random.default_rng(seed).normal(size=(4, len(self.points)))
        size = self.sigma if sigma is None else sigma
        return pair(
            *(c + size * e for c, e in zip(exact, errors, strict=True)),
            focal=self.focal,
        )

    @property
    def pose(self) -> RelativePose:
        """The true pose."""
        return pose_of(self.rotation, self.base)

    def swap(self) -> "Case":
        """The same photos, left and right exchanged."""
        points = (self.points - self.base) @ self.rotation
        back = -self.base @ self.rotation
        return self._replace(rotation=self.rotation.T, base=back, points=points)

    def turn_left(self, turn: np.ndarray) -> "Case":
        """The same photos with the left one turned."""
        return self._replace(
            rotation=turn @ self.rotation,
            base=turn @ self.base,
            points=self.points @ turn.T,
        )


def pose_of(rotation: np.ndarray, base: np.ndarray) -> RelativePose:
    """The pose of a rotation and a base of any length."""
    quaternion = rotations.to_quaternion(rotations.as_matrix(jnp.asarray(rotation)))
    return RelativePose(*quaternion, *jnp.asarray(base / np.linalg.norm(base)))


def _overlap(focal: float = 70.0) -> np.ndarray:
    """Sixteen points in the overlap of two photos 70 mm apart, with relief."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid([0.0, 23.0, 47.0, 70.0], [-60.0, -20.0, 20.0, 60.0])
    height = rng.uniform(-0.15, 0.15, 16) * focal - focal
    return np.stack([x.ravel(), y.ravel(), height], axis=1) + rng.uniform(
        -4, 4, (16, 3)
    )


_TILT = oracles.wolf(0.03, -0.05, 0.04)
_BASE = np.array([70.0, 2.0, -3.0])
_NEAR = Case(_TILT, _BASE, _overlap())
CASES = {
    "near-vertical": _NEAR,
    "convergent": Case(oracles.wolf(0.02, -0.7, 0.05), _BASE, _overlap()),
    "swapped": _NEAR.swap(),
    "upside down": Case(_TILT @ oracles.r3(np.pi), _BASE, _overlap()),
    "narrow angle": Case(_TILT, _BASE, _overlap(700.0), focal=700.0, sigma=0.001),
}
"""Photos in the positions that every law holds for, by name."""


def read(path: Path, focal: float) -> Pair:
    """A pair from a table with the columns id, xl, yl, xr, yr, all rows of which were
    used by the solution that was published with it."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return pair(
        *(np.array([float(row[c]) for row in rows]) for c in ("xl", "yl", "xr", "yr")),
        focal=focal,
        copies=True,
    )


def rotation_base(pose: RelativePose) -> tuple[np.ndarray, np.ndarray]:
    """(R, b) of one pose as arrays, written out here once more so that the package is
    not its own judge."""
    w, x, y, z = (float(c) for c in (pose.qw, pose.qx, pose.qy, pose.qz))
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return matrix, np.array([float(c) for c in (pose.bx, pose.by, pose.bz)])


def difference(
    pose: RelativePose, rotation: np.ndarray, base: np.ndarray
) -> tuple[float, float]:
    """Angles (rad) between the rotations and between the base directions."""
    r, b = rotation_base(pose)
    return oracles.angle(r.T @ rotation), oracles.angle_between(b, base)


def arrays(one: Pair) -> np.ndarray:
    """(4, point) coordinates for the oracle, padding taken off."""
    return np.stack([np.asarray(c) for c in one.coordinates])[:, np.asarray(one.mask)]
