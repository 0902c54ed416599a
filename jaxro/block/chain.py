"""Approximate stations of a block from its oriented pairs, in any order and direction.

Each pair is a model of its own scale. Two pairs that share a photo have the ratio of
scales that the depths of their common points in this photo tell: only points on three
photos carry scale. The most certain ratios join the pairs, and the most certain pairs
the photos (minimum spanning trees). A pair whose rotation closes no triangle of photos
is as uncertain as what is missing. Nothing is adjusted.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..geometry.camera_axes import SIGNS
from ..geometry.elements import RelativePose
from ..orientation.result import Orientation
from .measured_block import MeasuredBlock

PARALLEL = 1e-12
"""Determinant of Σ (1 - d dᵀ) over the cube of the number of photos, below which rays
count as parallel."""

EXACT = 1e-4
"""Angle by which rays miss their point at the least, for their weights."""

NEAR = 1e-3
"""Part of the mean distance of points from photos at which they are at the least."""

ROUNDS = 12
"""Rounds of weights: the first one is that of least squares."""


class Models(NamedTuple):
    """Oriented pairs: the numbers of their photos, the rotation of right camera axes
    into the left ones, the unit base in the left ones, and how uncertain the rotation
    is (radians). Axes as in `camera.condition`."""

    left: Int[np.ndarray, " pair"]
    right: Int[np.ndarray, " pair"]
    rotation: Float[np.ndarray, "pair 3 3"]
    base: Float[np.ndarray, "pair 3"]
    deviation: Float[np.ndarray, " pair"]


class Seen(NamedTuple):
    """Common points of pairs, row by row: their pair and number, the rays of both
    photos (z is 1 there), and their depths along these with a base of 1."""

    pair: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    left: Float[np.ndarray, " row"]
    right: Float[np.ndarray, " row"]


class Chained(NamedTuple):
    """Rotations of the photos (object to camera) and their centres, in a system of any
    position and scale."""

    rotations: Float[np.ndarray, "photo 3 3"]
    centres: Float[np.ndarray, "photo 3"]


JOINING = (
    "measure points that lie on three photos, two of each part; scale passes only "
    "through these"
)
"""What photos that nothing joins need."""


class Unjoined(ValueError):
    """Photos that no common scale joins to the others; `photos` names them, `advice`
    says what is wrong, or what to measure."""

    def __init__(self, photos: list[str], advice: str = JOINING):
        self.photos, self.advice = photos, advice
        some = ", ".join(photos[:5]) + (", ..." if len(photos) > 5 else "")
        super().__init__(f"no scale joins the photos {some} to the others: {advice}")


class Oriented(NamedTuple):
    """What is read of oriented pairs: pose, cofactors of its five elements, whether they
    may be used, and how many of their points were kept; arrays have a pair axis."""

    pose: RelativePose
    cofactor: Float[Array, "*pair 5 5"]
    usable: Bool[Array, "*pair"]
    kept: Int[Array, "*pair"]
    points: Int[Array, "*pair"]


def models_of(
    left: Int[np.ndarray, " pair"],
    right: Int[np.ndarray, " pair"],
    oriented: Oriented | Orientation,
) -> Models:
    """The usable ones of oriented pairs."""
    from scipy.spatial.transform import Rotation

    pose = oriented.pose
    columns = lambda *parts: np.stack([np.asarray(a) for a in parts], axis=-1)
    quaternions = columns(pose.qx, pose.qy, pose.qz, pose.qw)
    base = columns(pose.bx, pose.by, pose.bz)
    turned = SIGNS
    axes = turned[:, None] * turned[None]
    variances = np.diagonal(np.asarray(oriented.cofactor), axis1=-2, axis2=-1)
    use = np.asarray(oriented.usable)
    return Models(
        left=left[use],
        right=right[use],
        rotation=Rotation.from_quat(quaternions[use]).as_matrix() * axes,
        base=(base * turned)[use],
        deviation=np.sqrt(np.sum(variances[:, :3], axis=1))[use],
    )


def chain(block: MeasuredBlock, models: Models) -> Chained:
    """The photos of a block, joined by its pairs. Raises `Unjoined`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    pairs, photos = len(models.left), len(block.photos)
    if pairs == 0:
        raise Unjoined(list(block.photos))
    missing = least_closures(models, photos)
    models = models._replace(deviation=np.hypot(models.deviation, missing))
    one, other, ratio, spread = _ratios(models, _common(block, models))
    # an error of a rotation changes all depths of its pair alike
    spread = np.hypot(spread, np.hypot(models.deviation[one], models.deviation[other]))
    joined = coo_array((spread, (one, other)), (pairs, pairs)).tocsr()
    tree = minimum_spanning_tree(joined)
    scale = np.full(pairs, np.nan)
    of_two = _lookup(one, other, ratio)
    best: tuple[int, np.ndarray] | None = None
    while np.any(rest := np.isnan(scale)):
        first = int(np.argmin(np.where(rest, models.deviation, np.inf)))
        order, before = breadth_first_order(tree, first, directed=False)
        scale[first] = 1.0
        for k in order[1:]:
            scale[k] = scale[before[k]] * of_two(before[k], k)
        shown = np.unique([models.left[order], models.right[order]])
        if best is None or len(shown) > best[0]:
            best = len(shown), order
    if best is None or best[0] < photos:
        own = () if best is None else best[1]
        shown = {*models.left[own], *models.right[own]} if len(own) else set()
        raise Unjoined([n for k, n in enumerate(block.photos) if k not in shown])
    return _poses(models, scale, best[1], photos)


def least_closures(models: Models, photos: int) -> Float[np.ndarray, " pair"]:
    """By which angle the best triangle of photos with each pair does not close,
    D_ij D_jk = D_ik; 0 for pairs in no triangle. Right pairs close at least one triangle
    to their errors, if two other right pairs belong to it; a wrong one closes none."""
    first = np.minimum(models.left, models.right)
    second = np.maximum(models.left, models.right)
    turned = (models.left > models.right)[:, None, None]
    of = np.where(turned, np.swapaxes(models.rotation, 1, 2), models.rotation)
    key = first * photos + second
    order = np.lexsort((models.deviation, key))
    keys, begin, least = key[order], first[order], np.full(len(key), np.inf)
    for lag in range(1, len(key)):
        same = np.flatnonzero(begin[lag:] == begin[:-lag])
        if len(same) == 0:
            break
        near, far = order[same], order[same + lag]
        wanted = second[near] * photos + second[far]
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        there = keys[at] == wanted
        near, far, across = near[there], far[there], order[at[there]]
        apart = of[near] @ of[across] - of[far]
        angle = np.sqrt(np.sum(apart**2, axis=(1, 2)) / 2)
        for pair in (near, far, across):
            np.minimum.at(least, pair, angle)
    return np.where(np.isfinite(least), least, 0.0)


def _poses(
    models: Models,
    scale: Float[np.ndarray, " pair"],
    members: Int[np.ndarray, " some"],
    photos: int,
) -> Chained:
    """The photos along the most certain rotations."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    left, right = models.left[members], models.right[members]
    best = np.lexsort((models.deviation[members],))
    left, right, members = left[best], right[best], members[best]
    # of two pairs of the same photos the more certain one
    same = np.stack([np.minimum(left, right), np.maximum(left, right)])
    _, first = np.unique(same, axis=1, return_index=True)
    left, right, members = left[first], right[first], members[first]
    weight = models.deviation[members] + np.finfo(float).tiny
    tree = minimum_spanning_tree(coo_array((weight, (left, right)), (photos, photos)))
    order, before = breadth_first_order(tree, left[0], directed=False)
    number = {}
    for k, (i, j) in enumerate(zip(left.tolist(), right.tolist(), strict=True)):
        number[i, j] = number[j, i] = k
    rotations, centres = np.zeros((photos, 3, 3)), np.zeros((photos, 3))
    rotations[order[0]] = np.eye(3)
    for photo in order[1:].tolist():
        known = int(before[photo])
        k = number[known, photo]
        pair = members[k]
        r, b = models.rotation[pair], scale[pair] * models.base[pair]
        if left[k] == known:
            rotations[photo] = r.T @ rotations[known]
            centres[photo] = centres[known] + rotations[known].T @ b
        else:
            rotations[photo] = r @ rotations[known]
            centres[photo] = centres[known] - rotations[photo].T @ b
    return Chained(rotations, centres)


def rays_of(block: MeasuredBlock) -> Float[np.ndarray, "ray 3"]:
    """The directions of all rays in camera axes, z = 1."""
    focal = block.focal[block.photo]
    return np.stack([block.x / focal, -block.y / focal, np.ones(len(focal))], axis=1)


def intersect(block: MeasuredBlock, chained: Chained) -> Float[np.ndarray, "point 3"]:
    """The points with the smallest sums of distances from their rays, as seen from the
    photos, which a wrong ray among several right ones hardly moves. NaN for points on
    one photo, and where all rays are parallel.

    Each round solves Σ p (1 - d dᵀ) (X - S) = 0 with weights p of one over the angle by
    which a ray missed the point before, and over the square of their distance.
    """
    turned = chained.rotations[block.photo]
    d = np.einsum("rji,rj->ri", turned, rays_of(block))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    stations = chained.centres[block.photo]
    number = len(block.points)
    seen = np.unique(np.stack([block.point, block.photo]), axis=1)[0]
    photos = np.bincount(seen, minlength=number)
    weight = np.ones(len(block.photo))
    found = np.full((number, 3), np.nan)
    for _ in range(ROUNDS):
        n, h = np.zeros((number, 3, 3)), np.zeros((number, 3))
        rows = weight[:, None, None] * across
        np.add.at(n, block.point, rows)
        np.add.at(h, block.point, np.einsum("rij,rj->ri", rows, stations))
        # the determinant of parallel rays is rounding
        size = np.trace(n, axis1=1, axis2=2) / 2
        there = (photos >= 2) & (np.linalg.det(n) > PARALLEL * size**3)
        n[~there] = np.eye(3)
        met = np.linalg.solve(n, h[:, :, None])[:, :, 0]
        found = np.where(there[:, None], met, found)
        away = np.nan_to_num(found)[block.point] - stations
        far = np.linalg.norm(away, axis=1)
        far = np.maximum(far, NEAR * np.mean(far))
        off = np.linalg.norm(np.einsum("rij,rj->ri", across, away), axis=1) / far
        weight = 1 / (np.maximum(off, EXACT) * far**2)
        weight /= np.max(weight)
    return found


def _common(block: MeasuredBlock, models: Models) -> Seen:
    """The common points of all pairs, with their depths."""
    by_photo = np.argsort(block.photo, kind="stable")
    ends = np.searchsorted(block.photo[by_photo], np.arange(len(block.photos) + 1))
    rays, rows = rays_of(block), []
    for k, (i, j) in enumerate(
        zip(models.left.tolist(), models.right.tolist(), strict=True)
    ):
        of_left = by_photo[ends[i] : ends[i + 1]]
        of_right = by_photo[ends[j] : ends[j + 1]]
        _, first, second = np.intersect1d(
            block.point[of_left], block.point[of_right], return_indices=True
        )
        rows.append((np.full(len(first), k), of_left[first], of_right[second]))
    pair, one, other = (np.concatenate(a) for a in zip(*rows, strict=True))
    a, b = rays[one], np.einsum("rij,rj->ri", models.rotation[pair], rays[other])
    base = models.base[pair]
    # λ a - μ b = base by least squares
    dot = lambda first, second: np.sum(first * second, axis=1)
    aa, ab, bb = dot(a, a), dot(a, b), dot(b, b)
    along_a, along_b = dot(a, base), dot(b, base)
    volume = aa * bb - ab * ab
    safe = np.where(volume > 0, volume, np.inf)
    left = (bb * along_a - ab * along_b) / safe
    right = (ab * along_a - aa * along_b) / safe
    ahead = (left > 0) & (right > 0)
    return Seen(pair[ahead], block.point[one][ahead], left[ahead], right[ahead])


def _ratios(
    models: Models, seen: Seen
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of every two pairs that share a photo and points: their numbers, the median of the
    ratio of the second one's scale to the first one's, and how uncertain its logarithm
    is."""
    pair = np.concatenate([seen.pair, seen.pair])
    point = np.concatenate([seen.point, seen.point])
    photo = np.concatenate([models.left[seen.pair], models.right[seen.pair]])
    depth = np.log(np.concatenate([seen.left, seen.right]))
    order = np.lexsort((pair, point, photo))
    pair, point, photo, depth = (a[order] for a in (pair, point, photo, depth))
    found = [(a, b, c) for a, b, c in _meeting(pair, point, photo, depth)]
    if not found:
        none = np.zeros(0, int)
        return none, none, np.zeros(0), np.zeros(0)
    one, other, log = (np.concatenate(a) for a in zip(*found, strict=True))
    key = one * len(models.left) + other
    order = np.lexsort((log, key))
    key, log = key[order], log[order]
    keys, begin, number = np.unique(key, return_index=True, return_counts=True)
    at = lambda part: log[begin + (part * (number - 1)).astype(int)]
    spread = (at(0.84) - at(0.16)) / 2 / np.sqrt(number)
    # what one point says alone is the least certain
    spread = np.where(number > 1, spread, spread.max(initial=0.0) + 1.0)
    count = len(models.left)
    return keys // count, keys % count, np.exp(at(0.5)), spread + 1e-12


def _meeting(pair, point, photo, depth) -> Iterator[tuple]:
    """Rows of the same photo and point in two pairs: the numbers of the pairs, and the
    difference of the logarithms of depths."""
    for lag in range(1, len(pair)):
        same = (point[lag:] == point[:-lag]) & (photo[lag:] == photo[:-lag])
        if not np.any(same):
            return
        first, second = np.flatnonzero(same), np.flatnonzero(same) + lag
        yield pair[first], pair[second], depth[first] - depth[second]


def _lookup(one, other, ratio):
    """The ratio of the scale of pair j to that of pair i."""
    table = {}
    rows = zip(one.tolist(), other.tolist(), ratio.tolist(), strict=True)
    for i, j, value in rows:
        table[i, j], table[j, i] = value, 1 / value
    return lambda i, j: table[int(i), int(j)]
