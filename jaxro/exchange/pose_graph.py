"""Pose graphs of oriented pairs: files of g2o, which GTSAM, Ceres and others read, too.

    VERTEX_SE3:QUAT number  x y z  qx qy qz qw
    EDGE_SE3:QUAT one other  x y z  qx qy qz qw  upper triangle of the information, by rows
    FIX number

A vertex is where a camera stands, T = (R, t) with X = R Y + t, axes x to the right, y
down, z forward. An edge is T₁⁻¹ T₂ as it was measured, the right camera in the axes of
the left one, and the information is that of its error in g2o's tangent: translation,
then the vector part of a quaternion (`tangents.g2o`).

GTSAM's `readG2o` and the example of Ceres take rotation vectors for granted, which are
twice as large: they would give the rotations of such a file four times their weight.
For these readers the information is made in `tangents.g2o_angles`.

A pair measures the direction of its base, but not the length. It has to come from
elsewhere: known distances, or points that pairs share (`scales`). Of a pair of which no
length is known the information is zero along the base: the edge then holds rotation and
direction alone.

GTSAM factorises each information by Cholesky and, without a word, makes something else
of one that is not positive definite. For it give a deviation of UNKNOWN times the length
where nothing tells the length.

Edges count as independent in a pose graph. Those of pairs that share measurements are
not: each counts the same measurement again, and the photos come out as more certain than
they are. No file of g2o can say so. Given the measurements, the information of each edge
is divided by a factor: the largest eigenvalue of the correlations of all edges that are
joined by shared measurements, with which

    factor · diag(Σ_1, Σ_2, ...) - Σ    is positive semidefinite,

so that nothing that is computed from the edges is told with a deviation that is too
small. Closures of triplets, of which the errors cancel, are then smaller than their
deviations say, and no test of them is worth anything: `joint_pose_covariance` has the
correlations, `close_triplets` the closures with them, and `jaxro.block` adjusts the
measurements themselves.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from ..batches.joint import joint_root, largest_correlations
from ..batches.ragged import Ragged
from ..geometry.camera_axes import invert
from ..orientation.result import Orientation
from ..tables.fields import tell
from .pose_covariance import pose_information
from .poses import cam_from_world
from .tangents import Tangent, g2o

UNKNOWN = 100.0
"""A deviation of a length, in lengths, that is as good as an infinite one, but leaves
the information positive definite."""


class PoseGraph(NamedTuple):
    """Photos and what pairs measure between them. `poses`: approximate T of each photo;
    `fixed`: the first photo of every part that no edge joins to another one. `left`,
    `right`: the numbers of the photos of each edge; `measured`: the right camera in the
    axes of the left one; `information` of its displacement, and the `factor` by which it
    has been divided for measurements that edges share, 1 for none."""

    photos: tuple[str, ...]
    poses: Float[np.ndarray, "photo 3 4"]
    fixed: Int[np.ndarray, " part"]
    left: Int[np.ndarray, " edge"]
    right: Int[np.ndarray, " edge"]
    measured: Float[np.ndarray, "edge 3 4"]
    information: Float[np.ndarray, "edge 6 6"]
    factor: Float[np.ndarray, " edge"]


def pose_graph(
    left: Sequence[str],
    right: Sequence[str],
    oriented: Orientation,
    lengths: ArrayLike = 1.0,
    length_deviations: ArrayLike = np.inf,
    *,
    pairs: Ragged | None = None,
    sigma0: ArrayLike | None = None,
    tangent: Tangent = g2o,
) -> PoseGraph:
    """The graph of oriented pairs, of which `left` and `right` name the photos.

    `lengths` of the bases and their standard deviations, infinite where nothing is
    known of a length, then 1 will do. `pairs`: what was measured; without it edges count
    as independent, which they are where no two pairs share places. `sigma0`: known
    before the measurement, 1 where the sigmas given are standard deviations; without it
    each pair has its own estimate, which of few points is uncertain. Pairs that are not
    usable, or without redundancy and without a given `sigma0`, have no edge. Raises
    ValueError where none has one.
    """
    photos, numbers = np.unique(np.array([left, right]), return_inverse=True)
    one, other = numbers.reshape(2, -1)
    deviations = np.broadcast_to(np.asarray(length_deviations, float), one.shape)
    information = pose_information(
        oriented,
        tangent,
        length=lengths,
        length_deviation=deviations,
        sigma0=sigma0,
    )
    use = np.all(np.isfinite(information), axis=(1, 2)) & (one != other)
    if not np.any(use):
        raise ValueError(
            "pose_graph: no pair is usable, with a standard deviation and two photos"
        )
    measured = _inverses(np.asarray(cam_from_world(oriented, lengths)))[use]
    factor = np.ones(len(use))
    if pairs is not None:
        found = jax.tree.map(np.asarray, oriented)
        cofactor = np.where(use[:, None, None], found.cofactor, np.nan)
        root = joint_root(left, right, pairs, found.elements, cofactor)
        factor = largest_correlations(root, cofactor)
        information = information / factor[:, None, None]
    one, other, information = one[use], other[use], information[use]
    poses, fixed = _spread(len(photos), one, other, measured, information)
    there = np.zeros(len(photos), bool)
    there[one] = there[other] = True
    number = np.cumsum(there) - 1
    return PoseGraph(
        photos=tuple(str(name) for name in photos[there]),
        poses=poses[there],
        fixed=number[fixed[there[fixed]]],
        left=number[one],
        right=number[other],
        measured=measured,
        information=information,
        factor=factor[use],
    )


def g2o_text(graph: PoseGraph) -> str:
    """The graph as the text of a g2o file. Its first lines say which photo has which
    number; control characters of their names, such as line ends, are escapes there."""
    numbers = lambda values: " ".join(repr(float(value)) for value in values)
    lines = [f"# {k} {tell(name)}" for k, name in enumerate(graph.photos)]
    for k, seven in enumerate(_sevens(graph.poses)):
        lines.append(f"VERTEX_SE3:QUAT {k} {numbers(seven)}")
    lines += [f"FIX {k}" for k in graph.fixed]
    rows, columns = np.triu_indices(6)
    edges = zip(
        graph.left.tolist(),
        graph.right.tolist(),
        _sevens(graph.measured),
        graph.information[:, rows, columns],
        strict=True,
    )
    for one, other, seven, upper in edges:
        ends = f"{one} {other}"
        lines.append(f"EDGE_SE3:QUAT {ends} {numbers(seven)} {numbers(upper)}")
    return "\n".join(lines) + "\n"


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write the graph as a g2o file."""
    Path(path).write_text(g2o_text(graph), encoding="utf-8")


def _sevens(poses: Float[np.ndarray, "some 3 4"]) -> Float[np.ndarray, "some 7"]:
    """x y z qx qy qz qw of each pose."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(poses[:, :, :3]).as_quat(canonical=True)
    return np.concatenate([poses[:, :, 3], turns], axis=1)


def _inverses(poses: Float[np.ndarray, "some 3 4"]) -> Float[np.ndarray, "some 3 4"]:
    rotation, translation = invert(poses[:, :, :3], poses[:, :, 3])
    return np.concatenate([rotation, translation[:, :, None]], axis=2)


def _spread(
    photos: int,
    one: Int[np.ndarray, " edge"],
    other: Int[np.ndarray, " edge"],
    measured: Float[np.ndarray, "edge 3 4"],
    information: Float[np.ndarray, "edge 6 6"],
) -> tuple[Float[np.ndarray, "photo 3 4"], Int[np.ndarray, " part"]]:
    """Approximate poses along the edges of most information (a spanning tree of each
    part), and the first photo of every part, which stands at the origin."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    # the size of a rank-deficient matrix by what it has
    weight = 1 / np.sqrt(np.trace(information, axis1=1, axis2=2))
    best = np.argsort(weight, kind="stable")
    ends = np.stack([np.minimum(one, other), np.maximum(one, other)])[:, best]
    _, first = np.unique(ends, axis=1, return_index=True)
    edges = best[first]
    row, column = ends[:, first]
    # distances of a spanning tree must not be zero, and their ratios are enough
    relative = weight[edges] / np.min(weight[edges])
    tree = minimum_spanning_tree(coo_array((relative, (row, column)), (photos,) * 2))
    of_ends = {}
    for k in edges.tolist():
        of_ends[int(one[k]), int(other[k])] = measured[k]
        of_ends[int(other[k]), int(one[k])] = _inverses(measured[k][None])[0]
    poses = np.tile(np.eye(3, 4), (photos, 1, 1))
    reached, fixed = np.zeros(photos, bool), []
    for begin in range(photos):
        if reached[begin]:
            continue
        fixed.append(begin)
        order, before = breadth_first_order(tree, begin, directed=False)
        reached[order] = True
        for photo in order[1:].tolist():
            known = int(before[photo])
            step, at = of_ends[known, photo], poses[known]
            poses[photo] = at[:, :3] @ step
            poses[photo, :, 3] += at[:, 3]
    return poses, np.array(fixed)
