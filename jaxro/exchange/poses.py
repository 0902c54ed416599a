"""Poses of photos as COLMAP and OpenCV have them.

A photo of jaxro has x along the flight and y up, and looks along -z: a measured point
is the vector p = (x, y, -f). A pair places the photos by

    left X = λ p1,    right X = B + μ R p2,

with X in the axes of the left photo. A camera of the other programs has x to the right,
y down and z forward; with D = diag(1, -1, -1) a vector v of a photo is D v in its
camera. A point that has the coordinates Y in the right photo's axes has

    X = B + R Y   =>   D Y = (D Rᵀ D) (D X) - (D Rᵀ D) (D B)

and the right camera relative to the left one, whose axes are the world's, is

    x_cam = R' x_world + t,    R' = D Rᵀ D,    t = -R' D B.

Of the left one cam_from_world is [I | 0]. The projection is u = x_cam / z_cam in units
of the focal length: x_cam / z_cam = x / f, y_cam / z_cam = -y / f.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..block.adjust import BlockAdjustment
from ..camera.condition import Station
from ..geometry import rotations as rot
from ..geometry.camera_axes import to_camera_axes
from ..geometry.elements import AbstractElements
from ..orientation.result import Orientation
from .tangents import CameraPose

Oriented = AbstractElements | Orientation
"""What has a relative pose, of one pair or of a batch."""


def rotation_matrix(oriented: Oriented) -> Float[Array, "*pairs 3 3"]:
    """R, which turns vectors of the right photo into the axes of the left one; photo
    axes as in the module's text."""
    return of_each(_rotation, elements_of(oriented))


def cam_from_world(
    oriented: Oriented | BlockAdjustment, length: ArrayLike = 1.0
) -> Float[Array | np.ndarray, "*photos 3 4"]:
    """[R' | t] with x_cam = R' x_world + t, camera axes as COLMAP and OpenCV have them.

    Of a pair, or of a batch of pairs: the right camera relative to the left one, whose
    axes are the world's; `length`: of the base, one or of every pair. Of an adjusted
    block: every photo, in the order of `block.photos`, the world being the ground.
    """
    if isinstance(oriented, BlockAdjustment):
        return _cameras_of(oriented)
    elements = elements_of(oriented)
    pairs = jnp.shape(jax.tree.leaves(elements)[0])
    return of_each(_camera, elements, jnp.broadcast_to(jnp.asarray(length), pairs))


def elements_of(oriented: Oriented) -> AbstractElements:
    """The elements of an orientation, or those that are given."""
    return oriented.elements if isinstance(oriented, Orientation) else oriented


def of_each(function: Callable, *trees: PyTree) -> PyTree:
    """function(pair's part of each tree), for every pair of the leading axes of the
    trees, whose leaves are scalars of a pair."""
    if not jnp.ndim(jax.tree.leaves(trees)[0]):
        return function(*jax.tree.map(jnp.asarray, trees))
    return jax.vmap(lambda *one: of_each(function, *one))(*trees)


def camera_pose(elements: AbstractElements, length: Float[Array, ""]) -> CameraPose:
    """The right camera of one pair in the axes of the left one, its base of this
    length."""
    rotation, base = elements.normalise().relative()
    unit = rot.as_array(rot.unit(base))
    return CameraPose(*to_camera_axes(rot.as_array(rotation), length * unit))


def station_pose(station: Station, middle: Array, length: Array) -> CameraPose:
    """The camera of a photo of a block on the ground, of which its station has the
    coordinates middle + length * centre."""
    quaternion = rot.unit_quaternion(station.quaternion)
    turn = rot.from_quaternion(*(quaternion[k] for k in range(4)))
    return CameraPose(rot.as_array(turn).T, middle + length * station.centre)


def _rotation(elements: AbstractElements) -> Float[Array, "3 3"]:
    return rot.as_array(elements.normalise().relative()[0])


def _camera(elements: AbstractElements, length: Array) -> Float[Array, "3 4"]:
    rotation, translation = camera_pose(elements, length).inverse
    return jnp.concatenate([rotation, translation[:, None]], axis=1)


def _cameras_of(adjusted: BlockAdjustment) -> Float[np.ndarray, "photo 3 4"]:
    """[R | -R S] of every photo."""
    from scipy.spatial.transform import Rotation

    stations = adjusted.check().stations
    w, x, y, z = np.asarray(stations.quaternion).T
    turns = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    along = -np.einsum("pij,pj->pi", turns, adjusted.centres)
    return np.concatenate([turns, along[:, :, None]], axis=2)
