"""Covariances of any photos and points of an adjusted block together, and of what lies
between two of them.

    Σ = sigma0² J Q Jᵀ

Q are columns of the inverse of the normal equations, solved through their factor; J
are the derivatives of angles and coordinates by the parameters of the adjustment. In a
free network Σ is that of its datum; what no datum changes, such as the rotation between
two photos, has a covariance that none changes either.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..camera.condition import Station
from ..geometry import rotations as rot
from ..xla.programs import compiled
from .adjust import BlockAdjustment
from .network import angles_and_centre, photo_axes


class Asked(NamedTuple):
    """Numbers that are asked for: the `rows` of the adjustment's parameters, and the
    derivatives `slope` of the numbers on the ground by these."""

    rows: Int[np.ndarray, " number"]
    slope: Float[np.ndarray, "number number"]


class RelativePose(NamedTuple):
    """How a second photo lies to a first one, in the axes of the first photo (x to the
    right, y up, z backward).

    `rotation` D turns axes of the second photo into those of the first, D = M1 M2ᵀ;
    `base`: the second projection centre. `covariance`: of the three small angles w by
    which D becomes exp(w×) D, about the first photo's axes in radians, and of the base.
    """

    rotation: Float[np.ndarray, "3 3"]
    base: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "6 6"]


class Difference(NamedTuple):
    """From one point to another one: the difference of their coordinates with its
    covariance, and the distance with its standard deviation."""

    vector: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    distance: float
    distance_deviation: float

    @property
    def height(self) -> float:
        """The difference of heights."""
        return float(self.vector[2])

    @property
    def height_deviation(self) -> float:
        """Its standard deviation."""
        return float(np.sqrt(self.covariance[2, 2]))


def joint_covariance(
    adjusted: BlockAdjustment,
    photos: Sequence[str] = (),
    points: Sequence[str] = (),
) -> Float[np.ndarray, "number number"]:
    """The covariance of all that is named: omega, phi, kappa (radians), X, Y, Z of each
    photo, then X, Y, Z of each point. Raises ValueError for a name that is not in the
    adjustment, and RuntimeError for an adjustment that is not usable."""
    asked = ask(adjusted, photos, points)
    q = adjusted.adjustment.all_cofactors.between(asked.rows)
    return adjusted.sigma0**2 * asked.slope @ q @ asked.slope.T


def relative_covariance(
    adjusted: BlockAdjustment, one_photo: str, other_photo: str
) -> RelativePose:
    """The `RelativePose` of two photos, neighbours or not."""
    asked = ask(adjusted, (one_photo, other_photo), ())
    q = adjusted.adjustment.all_cofactors.between(asked.rows)
    numbers = np.array(
        [adjusted.block.photos.index(a) for a in (one_photo, other_photo)]
    )
    both = jax.tree.map(lambda a: np.asarray(a)[numbers], adjusted.stations)
    found = _relative(both)
    rotation, base, slope = (np.array(a) for a in found)
    base *= adjusted.frame.length
    slope[3:] *= adjusted.frame.length
    return RelativePose(rotation, base, adjusted.sigma0**2 * slope @ q @ slope.T)


def difference(
    adjusted: BlockAdjustment, one_point: str, other_point: str
) -> Difference:
    """The `Difference` from one point to another one, with their correlation. Raises
    ValueError where they are the same point."""
    if one_point == other_point:
        raise ValueError(f"difference: two points are needed, got {one_point!r} twice")
    names = adjusted.block.points
    covariance = joint_covariance(adjusted, points=(one_point, other_point))
    one, other = (
        adjusted.coordinates[names.index(a)] for a in (one_point, other_point)
    )
    apart = np.hstack([-np.eye(3), np.eye(3)])
    own = apart @ covariance @ apart.T
    length = float(np.linalg.norm(other - one))
    along = (other - one) / length
    return Difference(other - one, own, length, float(np.sqrt(along @ own @ along)))


def ask(
    adjusted: BlockAdjustment, photos: Sequence[str], points: Sequence[str]
) -> Asked:
    """Where the photos and points that are named stand in the adjustment."""
    adjusted.check()
    number = adjusted.numbered.number
    photo = _find(adjusted.block.photos, photos, "photo")
    point = number[_find(adjusted.block.points, points, "point")]
    if np.any(point < 0):
        name = points[int(np.flatnonzero(point < 0)[0])]
        raise ValueError(
            f"point {name!r} is not in the adjustment: it needs rays on two photos, or "
            "on one and two known coordinates"
        )
    some = jax.tree.map(lambda a: np.asarray(a)[photo], adjusted.stations)
    turns = _slopes(some)
    length, size = adjusted.frame.length, 6 * len(photo) + 3 * len(point)
    slope = np.eye(size) * length
    for k, own in enumerate(np.asarray(turns)):
        at = slice(6 * k, 6 * k + 6)
        slope[at, at] = own * np.array([1.0] * 3 + [length] * 3)[:, None]
    return Asked(adjusted.adjustment.rows({"photo": photo, "point": point}), slope)


def _find(
    there: Sequence[str], names: Sequence[str], kind: str
) -> Int[np.ndarray, " name"]:
    """The numbers of names."""
    numbers = {name: k for k, name in enumerate(there)}
    for name in names:
        if name not in numbers:
            raise ValueError(f"the block has no {kind} {name!r}")
    return np.array([numbers[name] for name in names], int)


@compiled
def _slopes(stations: Station) -> Float[Array, "photo 6 6"]:
    """The derivatives of angles and centre of all photos by their parameters."""

    def of_photo(station: Station) -> Array:
        return jax.jacfwd(lambda step: angles_and_centre(station.move(step)))(
            jnp.zeros(6)
        )

    return jax.vmap(of_photo)(stations)


@compiled
def _relative(
    both: Station,
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, "6 12"]]:
    """D and the base of two photos, and the derivatives of the small angles and of the
    base by the parameters of both."""
    one, other = (jax.tree.map(lambda a, k=k: a[k], both) for k in range(2))

    def pose(steps: Array) -> tuple[Array, Array]:
        first, second = one.move(steps[:6]), other.move(steps[6:])
        m, n = (rot.as_array(photo_axes(station)) for station in (first, second))
        return m @ n.T, m @ (second.centre - first.centre)

    rotation, base = pose(jnp.zeros(12))

    def values(steps: Array) -> Array:
        turned, along = pose(steps)
        w = turned @ rotation.T
        return jnp.concatenate([jnp.stack([w[2, 1], w[0, 2], w[1, 0]]), along])

    return rotation, base, jax.jacfwd(values)(jnp.zeros(12))
