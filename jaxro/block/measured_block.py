"""What was measured of a strip or block: places of points on photos, each place once
however often it comes in, and what is known of the ground.

Photo coordinates are those of `geometry.pairs`: x to the right, y up, origin at the
principal point, in any unit that the focal length has, too. Everything is NumPy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from ..batches.ragged import Ragged
from ..geometry import copies

APART = 0.01
"""Part of the focal length from which on two places of one name on a photo are two
points."""


class MeasuredBlock(NamedTuple):
    """Places of points on photos, ray by ray; `photo` and `point` count from 0 in
    `photos` and `points`, the names. `focal`: of each photo; `sigma`: the standard
    deviation of a coordinate of each ray; `cameras`: the name of the camera of each
    photo, None where they are told by their focal lengths alone."""

    photos: tuple[str, ...]
    points: tuple[str, ...]
    photo: Int[np.ndarray, " ray"]
    point: Int[np.ndarray, " ray"]
    x: Float[np.ndarray, " ray"]
    y: Float[np.ndarray, " ray"]
    sigma: Float[np.ndarray, " ray"]
    focal: Float[np.ndarray, " photo"]
    cameras: tuple[str, ...] | None = None

    def without(self, rays: Bool[np.ndarray, " ray"]) -> "MeasuredBlock":
        """The block without some rays; photos and points keep their numbers."""
        kept = lambda a: a[~rays]
        return self._replace(
            photo=kept(self.photo),
            point=kept(self.point),
            x=kept(self.x),
            y=kept(self.y),
            sigma=kept(self.sigma),
        )


class Ground(NamedTuple):
    """What is known of the ground: NaN for a coordinate that is not; `sigma` of each
    coordinate; `check`: known, but kept out of the adjustment, which they judge;
    `station`: of the projection centre of a photo, and not of a point."""

    points: tuple[str, ...]
    coordinates: Float[np.ndarray, "known 3"]
    sigma: Float[np.ndarray, "known 3"]
    check: Bool[np.ndarray, " known"]
    station: Bool[np.ndarray, " known"]

    def numbers_in(self, block: MeasuredBlock) -> Int[np.ndarray, " known"]:
        """The numbers of its points and photos in a block, -1 where it has not got
        them."""
        point = {name: k for k, name in enumerate(block.points)}
        photo = {name: k for k, name in enumerate(block.photos)}
        both = zip(self.points, self.station, strict=True)
        found = [
            (photo if of_photo else point).get(name, -1) for name, of_photo in both
        ]
        return np.array(found, int)


def ground(
    points: Sequence[str],
    coordinates: Float[ArrayLike, "known 3"],
    sigma: Float[ArrayLike, "..."],
    check: Bool[ArrayLike, " known"] | None = None,
    station: Bool[ArrayLike, " known"] | None = None,
) -> Ground:
    """Known points, and stations that are known, too. Raises ValueError for a name that
    occurs twice, and for standard deviations that are not positive."""
    at = np.asarray(coordinates, float)
    names = tuple(points)
    none = np.zeros(len(names), bool)
    stations = none if station is None else np.asarray(station)
    kinds = list(zip(names, stations.tolist(), strict=True))
    if len(set(kinds)) < len(kinds):
        twice = next(name for name, kind in kinds if kinds.count((name, kind)) > 1)
        raise ValueError(f"ground: point {twice!r} occurs twice")
    deviation = np.broadcast_to(np.asarray(sigma, float), at.shape)
    wrong = np.isfinite(at) & ~(deviation > 0)
    if np.any(wrong):
        name = names[int(np.flatnonzero(np.any(wrong, axis=1))[0])]
        raise ValueError(
            f"ground: point {name!r} has a standard deviation that is not positive"
        )
    checks = none if check is None else np.asarray(check)
    return Ground(names, at, deviation, checks, stations)


def nothing_known() -> Ground:
    """The ground of a free network."""
    return ground((), np.zeros((0, 3)), 1.0)


def from_pairs(
    left: Sequence[str],
    right: Sequence[str],
    pairs: Ragged,
    points: Sequence[str],
) -> MeasuredBlock:
    """The block of oriented pairs: photo names `left` and `right` of each, the names of
    the `points` of all rows.

    A place that several pairs share is one measurement (`without_copies`). Two places
    of a point on one photo that differ are two measurements of it; `TwoPoints` is
    raised where they are too far apart for that, ValueError where a photo has two focal
    lengths, and for pairs with covariances: here a place has one standard deviation.
    """
    if pairs.roots is not None:
        raise ValueError(
            "from_pairs: the points have covariances, but a place of a block has one "
            "standard deviation: leave them out, pairs._replace(roots=None), which "
            "keeps the mean of each point"
        )
    photos, both = np.unique(np.array([left, right]), return_inverse=True)
    both = both.reshape(2, -1)
    names, point = np.unique(np.asarray(points), return_inverse=True)
    of_row = np.repeat(np.arange(len(pairs.lengths)), pairs.lengths)
    used = np.flatnonzero(pairs.mask)
    rows = lambda of_left, of_right: np.concatenate([of_left[used], of_right[used]])
    photo = rows(both[0][of_row], both[1][of_row])
    x, y = rows(pairs.x_left, pairs.x_right), rows(pairs.y_left, pairs.y_right)
    sigma, point = rows(pairs.sigma, pairs.sigma), rows(point, point)
    focal = _focals(photos, both, pairs)
    block = MeasuredBlock(
        photos=tuple(str(name) for name in photos),
        points=tuple(str(name) for name in names),
        photo=photo,
        point=point,
        x=x,
        y=y,
        sigma=sigma,
        focal=focal,
    )
    return check_names(without_copies(block))


def pairs_of_rays(
    block: MeasuredBlock,
    begins: Int[np.ndarray, " ends"],
    one: Int[np.ndarray, " row"],
    other: Int[np.ndarray, " row"],
    left: Int[np.ndarray, " pair"],
    right: Int[np.ndarray, " pair"],
) -> Ragged:
    """Pairs of the photos `left` and `right`, whose rows are the rays `one` and `other`
    of their points; pair k has the rows begins[k] to begins[k + 1]."""
    return Ragged(
        begins=begins,
        x_left=block.x[one],
        y_left=block.y[one],
        x_right=block.x[other],
        y_right=block.y[other],
        sigma=np.maximum(block.sigma[one], block.sigma[other]),
        mask=np.ones(len(one), bool),
        focal_left=block.focal[left],
        focal_right=block.focal[right],
    )


def without_copies(block: MeasuredBlock) -> MeasuredBlock:
    """The block with each place once: of places of a point on a photo that differ by a
    small part of their standard deviation, the first one."""
    most = copies.distance_of(block.sigma, block.focal[block.photo])
    return block.without(
        copies.repeat_places(block.photo, block.point, block.x, block.y, most)
    )


def check_names(block: MeasuredBlock) -> MeasuredBlock:
    """The block. Raises `TwoPoints` where two places on a photo have the name of one
    point and are too far apart to be two measurements of it."""
    order = np.lexsort((block.point, block.photo))
    photo, point = block.photo[order], block.point[order]
    first = np.flatnonzero(np.diff(photo, prepend=-1) | np.diff(point, prepend=-1))
    extent = lambda a: np.maximum.reduceat(a, first) - np.minimum.reduceat(a, first)
    apart = np.hypot(extent(block.x[order]), extent(block.y[order]))
    far = np.flatnonzero(apart > APART * block.focal[photo[first]])
    if len(far):
        at = first[far[0]]
        names = block.photos[photo[at]], block.points[point[at]]
        raise TwoPoints(*names, float(apart[far[0]]))
    return block


class TwoPoints(ValueError):
    """Two points of a photo have one name."""

    def __init__(self, photo: str, point: str, apart: float):
        self.photo, self.point, self.apart = photo, point, apart
        super().__init__(
            f"photo {photo!r} has two points with the name {point!r}, {apart:.3g} "
            "apart: rename one of them in all pairs where it is meant"
        )


def add_rays(
    block: MeasuredBlock,
    photos: Sequence[str],
    points: Sequence[str],
    places: Float[ArrayLike, "ray 2"],
    sigma: Float[ArrayLike, " ray"],
) -> MeasuredBlock:
    """The block with further rays, such as known points that one photo shows; points
    may be new, and places that the block has already are no new ones. Raises ValueError
    for a photo that the block has not got, and `TwoPoints`."""
    of_photo = {name: k for k, name in enumerate(block.photos)}
    of_point = {name: k for k, name in enumerate(block.points)}
    for name in photos:
        if name not in of_photo:
            raise ValueError(f"add_rays: the block has no photo {name!r}")
    for name in points:
        of_point.setdefault(name, len(of_point))
    at = np.asarray(places, float)
    more = block._replace(
        points=tuple(of_point),
        photo=np.append(block.photo, [of_photo[name] for name in photos]),
        point=np.append(block.point, [of_point[name] for name in points]),
        x=np.append(block.x, at[:, 0]),
        y=np.append(block.y, at[:, 1]),
        sigma=np.append(block.sigma, np.asarray(sigma, float)),
    )
    return check_names(without_copies(more))


def _focals(photos, both: Int[np.ndarray, "2 pair"], pairs: Ragged):
    photo = both.reshape(-1)
    focal = np.concatenate([pairs.focal_left, pairs.focal_right])
    least, most = np.full(len(photos), np.inf), np.zeros(len(photos))
    np.minimum.at(least, photo, focal)
    np.maximum.at(most, photo, focal)
    if np.any(wrong := least < most):
        k = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"from_pairs: photo {photos[k]!s} has the focal lengths {least[k]:g} and "
            f"{most[k]:g} in different pairs"
        )
    return least
