"""The errors of all pairs of a table together: those of pairs that share measurements
are not independent.

A point that was measured once on photo B takes part in the pairs A-B and B-C, with the
same error. With D_p the derivatives of the elements of pair p by all that was measured,
in standard deviations of it,

    Q_pq = D_p D_qᵀ

are the cofactors of two pairs: those of one pair for p = q, and zero only where two pairs
share nothing. All D_p one below the other are one sparse matrix, the root of the joint
cofactors.

A measurement is a place on a photo. Names of points are not needed: matches have none,
and a point that was measured twice on a photo is two measurements.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..adjustment import normal_equations as normal
from ..assessment.correlated import change_between
from ..geometry.copies import distance_of
from ..geometry.elements import AbstractElements
from ..geometry.linear import linearise
from ..geometry.pairs import Pair, mask_unusable
from ..orientation.model_errors import root as lower_root
from .buckets import map_ragged
from .padding import plan_for
from .ragged import Ragged


class _Oriented(NamedTuple):
    """One oriented pair, or a batch."""

    pair: Pair
    elements: AbstractElements
    cofactor: Float[Any, "*pairs 5 5"]

    @property
    def x_left(self) -> Float[Any, "*pairs point"]:
        """Of the pair, by which batches are split."""
        return self.pair.x_left


def joint_root(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    elements: AbstractElements,
    cofactor: Float[np.ndarray, "pair 5 5"],
) -> Any:
    """The root of the joint cofactors of the elements of oriented pairs, a sparse matrix
    (5 · pair, 2 · measurement): D D' is of all elements, pair behind pair. `left` and
    `right`: the photos of each pair. Rows are zero of pairs without a cofactor."""
    from scipy.sparse import coo_array

    used = np.all(np.isfinite(lower_root(cofactor)), axis=(1, 2))
    owner = np.repeat(np.arange(len(left)), pairs.lengths)
    rows = np.flatnonzero(pairs.mask & used[owner])
    slopes = _slopes(
        pairs, elements, np.where(used[:, None, None], cofactor, np.eye(5))
    )
    places = find_places(left, right, pairs, rows)
    # of each row the two coordinates of both photos
    columns = 2 * places[:, :, None] + np.arange(2)
    columns = columns.reshape(-1, 4, 1)
    lines = 5 * owner[rows][:, None, None] + np.arange(5)
    columns, lines = np.broadcast_arrays(columns, lines)
    shape = 5 * len(left), 2 * (np.max(places, initial=-1) + 1)
    entries = slopes[rows].ravel(), (lines.ravel(), columns.ravel())
    return coo_array(entries, shape).tocsr()


def largest_correlations(
    root: Any, cofactor: Float[np.ndarray, "pair 5 5"]
) -> Float[np.ndarray, " pair"]:
    """Of every pair the largest eigenvalue of the correlations of all pairs that are
    joined with it by shared measurements, the elements of each taken as five independent
    numbers of variance 1; 1 of a pair that shares none. `root` and `cofactor` as of
    `joint_root`."""
    from scipy.sparse import block_diag, coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import eigsh

    count = len(cofactor)
    plain = lower_root(cofactor)
    used = np.all(np.isfinite(plain), axis=(1, 2), keepdims=True)
    inverse = np.linalg.inv(np.where(used, plain, np.eye(5)))
    white = block_diag(list(np.where(used, inverse, 0.0))).tocsr() @ root
    joint = (white @ white.T).tocsr()
    owner = np.arange(5 * count) // 5
    blocks = joint.tocoo()
    meeting = coo_array(
        (np.ones(blocks.nnz, bool), (owner[blocks.row], owner[blocks.col])),
        (count, count),
    )
    parts, part = connected_components(meeting, directed=False)
    largest = np.ones(count)
    sizes = np.bincount(part, minlength=parts)
    for k in np.flatnonzero(sizes > 1):
        own = np.flatnonzero(part[owner] == k)
        matrix = joint[own][:, own]
        start = np.ones(len(own))
        top = eigsh(matrix, k=1, which="LA", v0=start, return_eigenvectors=False)
        largest[part == k] = max(float(top[0]), 1.0)
    return largest


def find_places(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    rows: Int[np.ndarray, " some"],
) -> Int[np.ndarray, "some 2"]:
    """Numbers of what was measured on the left and the right photo in these rows of the
    pairs: the same one for places of a photo that are copies (`geometry.copies`)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    owner = np.repeat(np.arange(len(left)), pairs.lengths)[rows]
    _, photo = np.unique(np.array([left, right]), return_inverse=True)
    photo = photo.reshape(2, -1)[:, owner].ravel()
    both = lambda one, other: np.concatenate([one[rows], other[rows]])
    at = both(pairs.x_left, pairs.x_right), both(pairs.y_left, pairs.y_right)
    at = np.stack(at, axis=1)
    focal = np.concatenate([pairs.focal_left[owner], pairs.focal_right[owner]])
    most = distance_of(both(pairs.sigma, pairs.sigma), focal)
    joined = [np.zeros((0, 2), int)]
    order = np.argsort(photo, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(photo[order])) + 1):
        if len(own):
            near = KDTree(at[own]).query_pairs(np.min(most[own]), p=np.inf)
            joined.append(own[np.array(sorted(near), int).reshape(-1, 2)])
    one, other = np.concatenate(joined).T
    graph = coo_array((np.ones(len(one), bool), (one, other)), (len(at),) * 2)
    _, place = connected_components(graph, directed=False)
    return place.reshape(2, -1).T


def _slopes(
    pairs: Ragged, elements: AbstractElements, cofactor: Float[np.ndarray, "pair 5 5"]
) -> Float[np.ndarray, "row 4 5"]:
    """The derivatives of the elements by the coordinates of each row."""
    own = jax.tree.map(np.asarray, elements)

    def batch_of(members: np.ndarray, size: int) -> _Oriented:
        of_pairs = jax.tree.map(lambda a: a[members], (own, cofactor))
        return _Oriented(pairs.pad_to(members, size), *of_pairs)

    return map_ragged(_differentiate, pairs, batch_of, plan_for(pairs.lengths))


def _differentiate(oriented: _Oriented) -> Float[Array, "point 4 5"]:
    """-Q aᵀ B L / d of every point, in standard deviations of its coordinates, times what
    takes the cofactors of least squares to those that the pair has."""
    pair = mask_unusable(oriented.pair)[0]
    linear = linearise(pair, oriented.elements)
    q = normal.dense(normal.inverse(linear.normal_equations()[0])[0])
    toward = change_between(q, oriented.cofactor) @ q
    columns = jnp.stack(linear.columns, axis=-1) * linear.weight[:, None]
    gradient = linear.gradient
    if linear.roots is not None:
        gradient = linear.roots.pull(gradient)
    by_z = jnp.stack(gradient, axis=-1) * pair.sigma[:, None]
    return -by_z[:, :, None] * (columns @ toward.T)[:, None, :]
