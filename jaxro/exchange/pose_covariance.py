"""Covariance of a pose as other programs have it: 6x6, in the tangent of a program
(`tangents`).

A relative orientation has five parameters x, which are rotation and direction of the
base; its length l is not measured. With l given, and its standard deviation s, the pose
T(x, l) has the displacements ξ(x, l) = tangent(T(0, l0), T(x, l)), and

    Σ = J diag(sigma0² Q, s²) Jᵀ,    J = ∂ξ / ∂(x, l) at (0, l0)

by automatic differentiation of the whole chain: elements, pose, logarithm. With s = 0,
a length that is known exactly, Σ has rank 5. Its inverse, the information

    Σ⁻¹ = J⁻ᵀ diag((sigma0² Q)⁻¹, 1/s²) J⁻¹

exists for s = ∞, too, a length that nothing tells: then it is zero for the displacement
along the base, which is what the measurements say of it.

Poses of pairs that share measurements are not independent; `joint_pose_covariance` has
those of all pairs together.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..batches.joint import joint_root
from ..batches.ragged import Ragged
from ..block.adjust import BlockAdjustment
from ..block.covariance import relative_covariance
from ..camera.condition import Station
from ..geometry.camera_axes import to_camera_axes
from ..geometry.elements import AbstractElements
from ..orientation.result import Orientation
from ..xla.programs import compiled
from .poses import camera_pose, of_each, station_pose
from .tangents import CameraPose, Tangent, gtsam

SINGULAR = 1e15
"""Condition of a scaled matrix above which it has no inverse: that of pairs whose points
determine no orientation."""

Matrices = Float[np.ndarray, "*pairs 6 6"]


def pose_covariance(
    orientation: Orientation,
    tangent: Tangent = gtsam,
    *,
    length: ArrayLike = 1.0,
    length_deviation: ArrayLike = 0.0,
    sigma0: ArrayLike | None = None,
) -> Matrices:
    """Σ of the right camera relative to the left one, of a pair or of a batch.

    `length` of the base, one or of every pair, and its standard deviation, 0 for a
    length that is known exactly (then Σ has rank 5). `sigma0`: known before the
    measurement, 1 where the sigmas given are standard deviations; without it the
    estimated one. NaN where a pair is not usable.
    """
    spread = np.asarray(length_deviation, float)
    if not np.all(np.isfinite(spread) & (spread >= 0)):
        raise ValueError(
            "pose_covariance: the deviation of a length is a finite number that is not "
            f"negative, got {length_deviation}; of a length that nothing tells only "
            "the information exists, see pose_information"
        )
    slope, variances = _parts(orientation, tangent, length, sigma0)
    joint = np.zeros(slope.shape)
    joint[..., :5, :5] = variances
    joint[..., 5, 5] = spread**2
    return slope @ joint @ slope.swapaxes(-1, -2)


def pose_information(
    orientation: Orientation,
    tangent: Tangent = gtsam,
    *,
    length: ArrayLike = 1.0,
    length_deviation: ArrayLike = np.inf,
    sigma0: ArrayLike | None = None,
) -> Matrices:
    """Σ⁻¹ of the right camera relative to the left one, of a pair or of a batch.

    `length_deviation` may be infinite: nothing is known of the length, and the
    information has rank 5. Other arguments as of `pose_covariance`. NaN where a pair is
    not usable.
    """
    spread = np.asarray(length_deviation, float)
    if not np.all(spread > 0):
        raise ValueError(
            "pose_information: a length that is known exactly has no finite weight, got "
            f"the deviation {length_deviation}; give a small positive one"
        )
    slope, variances = _parts(orientation, tangent, length, sigma0)
    joint = np.zeros(slope.shape)
    joint[..., :5, :5] = _inverse(variances)
    joint[..., 5, 5] = spread**-2.0
    back = _inverse(slope)
    return _symmetric(back.swapaxes(-1, -2) @ joint @ back)


def joint_pose_covariance(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    orientation: Orientation,
    tangent: Tangent = gtsam,
    *,
    length: ArrayLike = 1.0,
    length_deviation: ArrayLike = 0.0,
    sigma0: ArrayLike | None = None,
) -> Any:
    """Σ of the right cameras relative to the left ones of all pairs together, a sparse
    matrix (6 · pair, 6 · pair): of each pair that of `pose_covariance`, and of two pairs
    that share measurements what their errors have in common.

    `left` and `right` name the photos of the pairs, whose measurements are `pairs`: two
    pairs share what is at one place of one photo. Lengths are taken as measured by
    themselves. Other arguments as of `pose_covariance`. Rows and columns of pairs that
    are not usable are zero.
    """
    from scipy.sparse import block_diag, diags_array

    found = jax.tree.map(np.asarray, orientation)
    usable = np.asarray(orientation.usable)[:, None, None]
    slope, _ = _parts(orientation, tangent, length, sigma0)
    slope = np.where(usable, slope, 0.0)
    cofactor = np.where(usable, found.cofactor, np.nan)
    root = joint_root(left, right, pairs, found.elements, cofactor)
    unit = np.broadcast_to(found.sigma0 if sigma0 is None else sigma0, len(slope))
    unit = np.where(usable, unit[:, None, None], 0.0)
    spread = np.broadcast_to(np.asarray(length_deviation, float), len(slope))
    by_elements = block_diag(list(unit * slope[:, :, :5])).tocsr() @ root
    by_length = block_diag(list(slope[:, :, 5:])).tocsr() @ diags_array(spread)
    return by_elements @ by_elements.T + by_length @ by_length.T


def _parts(
    orientation: Orientation,
    tangent: Tangent,
    length: ArrayLike,
    sigma0: ArrayLike | None,
) -> tuple[Matrices, Float[np.ndarray, "*pairs 5 5"]]:
    """J, and the covariance of the five elements; NaN where they are not usable."""
    pairs = jnp.shape(orientation.sigma0)
    lengths = np.broadcast_to(np.asarray(length, float), pairs)
    if not np.all(np.isfinite(lengths) & (lengths > 0)):
        raise ValueError(f"a base has a positive length, got {length}")
    slope = np.array(_slopes(orientation.elements, lengths, tangent=tangent))
    unit = orientation.sigma0 if sigma0 is None else sigma0
    variances = np.asarray(unit, float)[..., None, None] ** 2 * np.asarray(
        orientation.cofactor
    )
    slope[~np.asarray(orientation.usable)] = np.nan
    return slope, variances


@compiled
def _slopes(
    elements: AbstractElements, lengths: Float[Array, "*pairs"], *, tangent: Tangent
) -> Float[Array, "*pairs 6 6"]:
    """∂ξ / ∂(x, l)"""

    def of_pair(elements: AbstractElements, length: Array) -> Array:
        at = camera_pose(elements, length)

        def displacement(step: Array) -> Array:
            moved = elements.move(tuple(step[:5]))
            return tangent(at, camera_pose(moved, length + step[5]))

        return jax.jacfwd(displacement)(jnp.zeros(6, length.dtype))

    return of_each(of_pair, elements, lengths)


# -------------------------------------------------------------------------------------
# photos of a block


def photo_covariances(
    adjusted: BlockAdjustment, tangent: Tangent = gtsam
) -> Float[np.ndarray, "photo 6 6"]:
    """Σ of every photo of an adjusted block on the ground, in the order of
    `block.photos`. In a free network that of its datum."""
    frame = adjusted.check().frame
    where = adjusted.stations, frame.middle, frame.length
    slope = np.asarray(_slopes_of_photos(*where, tangent=tangent))
    q = np.asarray(adjusted.adjustment.cofactors["photo"])
    return adjusted.sigma0**2 * slope @ q @ slope.swapaxes(-1, -2)


def relative_photo_covariance(
    adjusted: BlockAdjustment,
    one_photo: str,
    other_photo: str,
    tangent: Tangent = gtsam,
) -> tuple[CameraPose, Float[np.ndarray, "6 6"]]:
    """Where the other camera stands in the axes of the first one, and Σ of this pose,
    by the joint covariance of both photos."""
    found = relative_covariance(adjusted, one_photo, other_photo)
    slope = np.asarray(_slope_of_relative(found.rotation, found.base, tangent=tangent))
    pose = CameraPose(*to_camera_axes(found.rotation, found.base))
    return pose, slope @ found.covariance @ slope.T


@compiled
def _slopes_of_photos(
    stations: Station, middle: Array, length: Array, *, tangent: Tangent
) -> Float[Array, "photo 6 6"]:
    """The derivatives of ξ by the parameters of the photos."""

    def of_photo(station: Station) -> Array:
        at = station_pose(station, middle, length)
        moved = lambda step: station_pose(station.move(step), middle, length)
        return jax.jacfwd(lambda step: tangent(at, moved(step)))(jnp.zeros(6))

    return jax.vmap(of_photo)(stations)


@compiled
def _slope_of_relative(
    rotation: Array, base: Array, *, tangent: Tangent
) -> Float[Array, "6 6"]:
    """The derivatives of ξ by small angles w about the axes of the first photo, D ->
    exp(w×) D, and by the base."""

    def pose(step: Array) -> CameraPose:
        w = step[:3]
        turned = rotation + jnp.cross(w[None], rotation.T).T
        return CameraPose(*to_camera_axes(turned, base + step[3:]))

    at = pose(jnp.zeros(6))
    return jax.jacfwd(lambda step: tangent(at, pose(step)))(jnp.zeros(6))


def _inverse(matrices: Float[np.ndarray, "*pairs n n"]) -> np.ndarray:
    """The inverse of each, NaN where it has none. Rows and columns are scaled to length
    one first: rotations and lengths have other units."""
    rows = np.linalg.norm(matrices, axis=-1, keepdims=True)
    scaled = matrices / np.where(rows > 0, rows, 1.0)
    columns = np.linalg.norm(scaled, axis=-2, keepdims=True)
    scaled = scaled / np.where(columns > 0, columns, 1.0)
    there = np.all(np.isfinite(scaled), axis=(-2, -1)) & np.all(rows > 0, axis=(-2, -1))
    unit = np.eye(matrices.shape[-1])
    there &= np.linalg.cond(np.where(there[..., None, None], scaled, unit)) < SINGULAR
    found = np.linalg.inv(np.where(there[..., None, None], scaled, unit))
    found = found / columns.swapaxes(-1, -2) / rows.swapaxes(-1, -2)
    return np.where(there[..., None, None], found, np.nan)


def _symmetric(matrices: Matrices) -> Matrices:
    return (matrices + matrices.swapaxes(-1, -2)) / 2
