"""The lengths of the bases of oriented pairs that share points, in one scale for all.

Each pair is a model of its own scale. Of a point that two pairs have on a photo they
share, both know the depth d in the unit of their base, and

    l_i d_i = l_j d_j   =>   log l_j - log l_i = median of (log d_i - log d_j)

over all such points: the ratio of scales by which `block.chain` joins pairs. All ratios
together give the logarithms of the lengths by least squares, with Σ log l = 0 over the
pairs of a part, so that its mean length (geometric) is 1.

What makes a ratio wrong is less the noise of its points than the errors of the two
orientations, which move all depths of a pair together, and of which all ratios of a
pair have the same. With the covariance C_p of the elements of each pair, A_p the mean
derivatives of the ratios by them, N what the coordinates of the points contribute, and G
the matrix of the least squares, the logarithms have the covariance

    Σ_p (G A_p) C_p (G A_p)ᵀ + G N Gᵀ.

Pairs that share measured places have correlated orientations (`batches.joint`), which is
left out. The matrices are dense: for some thousand pairs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..batches.ragged import Ragged
from ..geometry import rotations as rot
from ..geometry.elements import AbstractElements
from ..orientation.result import Orientation
from ..xla.programs import compiled

MEDIAN = np.pi / 2
"""The variance of a median of many normal errors over that of their mean."""


class Lengths(NamedTuple):
    """Of the base of each pair, with its standard deviation: infinite, and the length
    1, of a pair that no point joins to another one, or that is not usable."""

    length: Float[np.ndarray, " pair"]
    deviation: Float[np.ndarray, " pair"]


class Depths(NamedTuple):
    """Logarithms of the depths of points on a photo, row by row, with their derivatives
    by the elements of the pair, and their variances by the coordinates."""

    pair: Int[np.ndarray, " row"]
    photo: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    log: Float[np.ndarray, " row"]
    slope: Float[np.ndarray, "row 5"]
    variance: Float[np.ndarray, " row"]


class Ratios(NamedTuple):
    """log l_other - log l_one of two pairs, with the mean derivatives by the elements of
    both, and the variance by the coordinates."""

    one: Int[np.ndarray, " ratio"]
    other: Int[np.ndarray, " ratio"]
    log: Float[np.ndarray, " ratio"]
    of_one: Float[np.ndarray, "ratio 5"]
    of_other: Float[np.ndarray, "ratio 5"]
    variance: Float[np.ndarray, " ratio"]


def base_lengths(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    points: Sequence[str],
    oriented: Orientation,
    *,
    sigma0: ArrayLike | None = None,
) -> Lengths:
    """The lengths of the bases of oriented pairs: `left` and `right` name their photos,
    `points` the rows of `pairs`. `sigma0`: known before the measurement, 1 where the
    sigmas of the pairs are standard deviations."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(left)
    unit = np.asarray(oriented.sigma0 if sigma0 is None else sigma0, float)
    unit = np.broadcast_to(unit, (count,))
    elements = unit[:, None, None] ** 2 * np.asarray(oriented.cofactor)
    good = np.asarray(oriented.usable) & np.isfinite(unit)
    depths = _depths(left, right, pairs, points, oriented, good, unit)
    ratios = _ratios(depths)
    length, deviation = np.ones(count), np.full(count, np.inf)
    joined = coo_array(
        (np.ones(len(ratios.one)), (ratios.one, ratios.other)), (count, count)
    )
    parts, part = connected_components(joined, directed=False)
    for k in range(parts):
        members = np.flatnonzero(part == k)
        if len(members) > 1:
            some = Ratios(*(a[part[ratios.one] == k] for a in ratios))
            log, spread = _adjust(some, members, elements)
            length[members] = np.exp(log)
            deviation[members] = length[members] * spread
    return Lengths(length, deviation)


def _depths(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    points: Sequence[str],
    oriented: Orientation,
    good: np.ndarray,
    unit: np.ndarray,
) -> Depths:
    """The depths of all points of good pairs on both photos."""
    owner = np.repeat(np.arange(len(left)), pairs.lengths)
    rows = np.flatnonzero(pairs.mask & good[owner])
    owner = owner[rows]
    own = jax.tree.map(lambda a: np.asarray(a)[owner], oriented.elements)
    coordinates = np.stack(
        [pairs.x_left, pairs.y_left, pairs.x_right, pairs.y_right], axis=1
    )[rows]
    focal = np.stack([pairs.focal_left, pairs.focal_right], axis=1)[owner]
    found = _log_depths(own, coordinates, focal)
    log, slopes, by_coordinates = (np.asarray(a) for a in found)
    variance = np.sum(by_coordinates**2, axis=2)
    variance *= (unit[owner] * pairs.sigma[rows])[:, None] ** 2
    _, photo = np.unique(np.array([left, right]), return_inverse=True)
    photo = photo.reshape(2, -1)[:, owner]
    _, point = np.unique(np.asarray(points)[rows], return_inverse=True)
    both = lambda a: np.concatenate([a, a])
    sides = lambda a: np.concatenate([a[:, 0], a[:, 1]])
    ahead = np.flatnonzero(both(np.all(np.isfinite(log), axis=1)))
    columns = both(owner), photo.ravel(), both(point)
    columns = *columns, sides(log), sides(slopes), sides(variance)
    return Depths(*(column[ahead] for column in columns))


@compiled
def _log_depths(
    elements: AbstractElements, coordinates: Array, focal: Array
) -> tuple[Float[Array, "row 2"], Float[Array, "row 2 5"], Float[Array, "row 2 4"]]:
    """Of all rows log λ and log μ, and their derivatives by elements and
    coordinates."""

    def of_row(elements, coordinates, focal):
        function = lambda step, at: log_depth(elements.move(tuple(step)), at, focal)
        at = jnp.zeros(5), coordinates
        return function(*at), *jax.jacfwd(function, argnums=(0, 1))(*at)

    return jax.vmap(of_row)(elements, coordinates, focal)


def log_depth(
    elements: AbstractElements, coordinates: Float[Array, "4"], focal: Float[Array, "2"]
) -> Float[Array, "2"]:
    """log λ and log μ with λ p1 - μ R p2 = b by least squares, b of length 1; NaN where
    the point is not in front of both photos."""
    rotation, base = elements.normalise().relative()
    base = rot.unit(base)
    x1, y1, x2, y2 = (coordinates[k] for k in range(4))
    first = x1, y1, -focal[0]
    second = rot.apply(rotation, (x2, y2, -focal[1]))
    aa, ab, bb = (
        rot.dot(first, first),
        rot.dot(first, second),
        rot.dot(second, second),
    )
    along_a, along_b = rot.dot(first, base), rot.dot(second, base)
    volume = aa * bb - ab * ab
    depths = jnp.stack([bb * along_a - ab * along_b, ab * along_a - aa * along_b])
    return jnp.log(jnp.where(depths > 0, depths, jnp.nan)) - jnp.log(volume)


def _ratios(depths: Depths) -> Ratios:
    """Every two pairs that have points on a photo they share."""
    order = np.lexsort((depths.pair, depths.point, depths.photo))
    depths = Depths(*(a[order] for a in depths))
    meetings = []
    for lag in range(1, len(depths.pair)):
        same = depths.point[lag:] == depths.point[:-lag]
        same &= depths.photo[lag:] == depths.photo[:-lag]
        if not np.any(same):
            break
        first = np.flatnonzero(same)
        meetings.append(np.stack([first, first + lag]))
    empty = np.zeros((2, 0), int)
    one, other = np.concatenate([empty, *meetings], axis=1)
    apart = depths.pair[one] != depths.pair[other]
    one, other = one[apart], other[apart]
    log = depths.log[one] - depths.log[other]
    variance = depths.variance[one] + depths.variance[other]
    key = depths.pair[one] * (np.max(depths.pair, initial=0) + 1) + depths.pair[other]
    order = np.lexsort((log, key))
    keys, begin, number = np.unique(key[order], return_index=True, return_counts=True)
    one, other, log = one[order], other[order], log[order]
    if not len(keys):
        none = np.zeros(0, int)
        return Ratios(none, none, *np.zeros((1, 0)), *np.zeros((2, 0, 5)), np.zeros(0))
    middle = begin + (number - 1) // 2, begin + number // 2
    median = (log[middle[0]] + log[middle[1]]) / 2
    mean = lambda a: (
        np.add.reduceat(a, begin) / number.reshape(-1, *(1,) * (a.ndim - 1))
    )
    return Ratios(
        one=depths.pair[one[begin]],
        other=depths.pair[other[begin]],
        log=median,
        of_one=mean(depths.slope[one]),
        of_other=-mean(depths.slope[other]),
        variance=np.where(number > 2, MEDIAN, 1.0) * mean(variance[order]) / number,
    )


def _adjust(
    ratios: Ratios,
    members: Int[np.ndarray, " some"],
    elements: Float[np.ndarray, "pair 5 5"],
) -> tuple[Float[np.ndarray, " some"], Float[np.ndarray, " some"]]:
    """The logarithms of the lengths of a part, and their standard deviations."""
    place = np.full(len(elements), -1)
    place[members] = np.arange(len(members))
    one, other = place[ratios.one], place[ratios.other]
    covariance = elements[members]
    own = lambda slope, k: np.einsum("ri,rij,rj->r", slope, covariance[k], slope)
    variance = ratios.variance + own(ratios.of_one, one) + own(ratios.of_other, other)
    rows = np.arange(len(one))
    design = np.zeros((len(rows), len(members)))
    design[rows, one], design[rows, other] = -1.0, 1.0
    weighted = design / variance[:, None]
    # the sum of the logarithms is zero: the pseudo-inverse
    g = np.linalg.pinv(design.T @ weighted, hermitian=True) @ weighted.T
    log = g @ ratios.log
    spread = g**2 @ ratios.variance
    for k in range(len(members)):
        a = g[:, one == k] @ ratios.of_one[one == k]
        a += g[:, other == k] @ ratios.of_other[other == k]
        spread += np.einsum("mi,ij,mj->m", a, covariance[k], a)
    return log, np.sqrt(spread)
