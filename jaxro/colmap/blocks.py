"""The matched pairs of a database in padded blocks, oriented and classified on all
cores.

A pair has one sigma for the four coordinates of a match, but the errors of an
undistorted keypoint depend on the direction: 70° off the axis of a fisheye they grow
four times as much along the radius as across it. The coplanarity condition g needs one
number of a match, the variance of g. With B = dg/d(coordinates) and the cofactors Q of
the keypoints it is that of four coordinates with the common

    sigma² = sigma_keypoint² (B Q Bᵀ) / (B Bᵀ),    Q = diag(Q_left, Q_right)

B needs a pose. A pair is oriented with a mean of all directions, sigma² =
sigma_keypoint² (sqrt(det Q_left) + sqrt(det Q_right)) / 2, and if directions matter a
second time, with B of the first pose.
"""

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
from jaxtyping import Array, Float, Int, PyTree

from ..batches.batch import clean_in_stages
from ..batches.buckets import buckets
from ..batches.padding import FEWER
from ..geometry.coplanarity import fundamental_matrix, linearise
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..rejection.classification import ENGINE, Found, Verdict, classify, verdict
from ..xla.programs import Program
from ..xla.slabs import Progress, Split, map_chunks, silent, spread
from .cameras import NO_POINTS, PhotoPoints, camera_matrix, focal_length, to_photo
from .database import Database, Matches, images_of

TOGETHER = 2_000_000
"""Matches in memory at once, padding included: some 300 MB."""

PAIRS = 48
"""Pairs in one call of a program: enough to hide the .3 ms that a call costs, few
enough to share out among threads."""

ONE_BY_ONE = Split(slab=PAIRS, chunk=1)
"""A pair is work enough by itself: it waits for no other one, and without `vmap` the
programs compile a third sooner.
"""

ROUND = 1.2
"""Ratio of the largest to the smallest variance of a coordinate of a match up to which
directions do not matter."""

Places = Int[np.ndarray, "pair match"]


class Photos(NamedTuple):
    """The images that are matched: their cameras, all their keypoints one image after
    another, and where those of an image begin and end."""

    cameras: dict[int, pycolmap.Camera]
    points: PhotoPoints
    begin: dict[int, int]
    end: dict[int, int]

    @property
    def counts(self) -> dict[int, int]:
        """How many keypoints an image has."""
        return {image: self.end[image] - self.begin[image] for image in self.end}

    def matrices(self, pair_ids: list[int]) -> list[Float[np.ndarray, "pair 3 3"]]:
        """The matrices of the first and of the second cameras of the pairs."""
        own = {image: camera_matrix(camera) for image, camera in self.cameras.items()}
        sides = images_of_pairs(pair_ids)
        return [np.stack([own[image] for image in side]) for side in sides]


class Block(NamedTuple):
    """Some pairs: their numbers, their matches, and what was found."""

    pair_ids: list[int]
    matches: list[Matches]
    found: Found


class Cofactors(NamedTuple):
    """J Jᵀ of the keypoints of one side, as in `PhotoPoints`."""

    xx: Float[Array, "*pairs match"]
    xy: Float[Array, "*pairs match"]
    yy: Float[Array, "*pairs match"]

    def along(self, x: Float[Array, "..."], y: Float[Array, "..."]):
        """The variance of x times the first plus y times the second coordinate."""
        return self.xx * x * x + 2 * self.xy * x * y + self.yy * y * y


def images_of_pairs(pair_ids: list[int]) -> tuple[list[int], list[int]]:
    """The first and the second images of the pairs."""
    both = [images_of(pair_id) for pair_id in pair_ids]
    return [a for a, _ in both], [b for _, b in both]


def read_photos(
    database: Database, pair_ids: list[int], assume_calibrated: bool
) -> Photos:
    """Cameras and keypoints of every image that is matched. Raises TableError."""
    images = database.images(pair_ids)
    cameras = database.cameras(images, assume_calibrated)
    keypoints = database.keypoints(images)
    camera_of = lambda image: images[image].camera
    numbers = sorted(images, key=camera_of)
    parts = [NO_POINTS]
    for camera, own in groupby(numbers, camera_of):
        pixels = np.concatenate([keypoints[image] for image in own])
        parts.append(to_photo(pixels, cameras[camera]))
    ends = np.cumsum([len(keypoints[image]) for image in numbers]).tolist()
    return Photos(
        cameras={image: cameras[camera_of(image)] for image in numbers},
        points=PhotoPoints(*map(np.concatenate, zip(*parts, strict=True))),
        begin=dict(zip(numbers, [0, *ends], strict=False)),
        end=dict(zip(numbers, ends, strict=True)),
    )


def orient_blocks(
    database: Database,
    photos: Photos,
    matched: list[tuple[int, int]],
    sigma: float,
    progress: Progress = silent,
) -> Iterator[Block]:
    """The pairs `matched` (number, number of matches) in blocks, not in their order;
    `sigma` of a keypoint in pixels. Raises TableError."""
    done = 0
    lengths = [length for _, length in matched]
    for size, members in buckets(lengths, FEWER).items() if lengths else ():
        most = max(1, TOGETHER // size)
        for begin in range(0, len(members), most):
            pair_ids = [matched[i][0] for i in members[begin : begin + most]]
            matches = list(database.matches(pair_ids, photos.counts))
            pairs, places = pad(photos, pair_ids, matches, size, sigma)
            told = lambda count, _, before=done: progress(before + count, len(matched))
            found = orient(pairs, photos.points, places, sigma, told)
            done += len(pair_ids)
            progress(done, len(matched))
            yield Block(pair_ids, matches, found)


def pad(
    photos: Photos,
    pair_ids: list[int],
    matches: list[Matches],
    size: int,
    sigma: float,
) -> tuple[Pair, tuple[Places, Places]]:
    """The pairs padded to `size`, in NumPy, with the same sigma in all directions, and
    the places of their left and right keypoints among all.

    A match with a keypoint that no ray is seen at is masked.
    """
    lengths = np.array([len(m) for m in matches])[:, None]
    number = np.arange(size)[None, :]
    there = number < lengths
    row = np.where(there, np.cumsum(lengths)[:, None] - lengths + number, 0)
    every = np.concatenate([*matches, np.zeros((1, 2), np.int64)])  # there may be none
    points, scale = photos.points, photos.points.scale
    if not len(scale):  # places without a match need a keypoint to point to
        points, scale = PhotoPoints(*(np.zeros(1, a.dtype) for a in points)), np.ones(1)
    coordinates, focals, places = [], [], []
    square = np.zeros(there.shape)
    for k, side in enumerate(images_of_pairs(pair_ids)):
        begin = np.array([photos.begin[image] for image in side])[:, None]
        place = np.where(there, every[row, k] + begin, 0)
        there = there & points.seen[place]
        coordinates += [points.x[place], points.y[place]]
        square += scale[place] ** 2
        focals.append(np.array([focal_length(photos.cameras[image]) for image in side]))
        places.append(place)
    # in place, since the system zeroes every page of a new array
    square /= 2
    deviation = np.sqrt(square, out=square)
    deviation *= sigma
    for values, empty in (*((c, 0.0) for c in coordinates), (deviation, 1.0)):
        np.copyto(values, empty, where=~there)
    pair = Pair(*jax.device_put((*coordinates, deviation, there, *focals)))
    return jax.tree.map(np.asarray, pair), (places[0], places[1])


def orient(
    pairs: Pair,
    points: PhotoPoints,
    places: tuple[Places, Places],
    sigma: float,
    progress: Progress,
) -> Found:
    """What is found of pairs whose keypoints are at these places among all points."""
    verdicts = clean_in_stages(pairs, ENGINE, verdict, ONE_BY_ONE, progress)
    again = _where_directions_matter(pairs, points, places)
    if again.size:
        some, pose = _rows_of((pairs, verdicts.pose), again)
        sides = [
            Cofactors(*jax.device_put([a[place[again]] for a in points[2:5]]))
            for place in places
        ]
        data = some, *sides, pose
        scale = spread(data, Program(_all_scales, {}), ONE_BY_ONE, 1)
        some = eqx.tree_at(lambda pair: pair.sigma, some, sigma * scale)
        new = clean_in_stages(some, ENGINE, verdict, ONE_BY_ONE, silent)
        pairs, verdicts = _with_rows((pairs, verdicts), again, (some, new))
    return spread((pairs, verdicts), Program(_classify_all, {}), ONE_BY_ONE, 1)


def _classify_all(verdicts: tuple[Pair, Verdict]) -> Found:
    return map_chunks(lambda one: classify(*one), verdicts, 1)


def _all_scales(data: tuple) -> Float[Array, "pair match"]:
    return map_chunks(lambda one: scale_by_direction(*one), data, 1)


def _where_directions_matter(
    pairs: Pair, points: PhotoPoints, places: tuple[Places, Places]
) -> Int[np.ndarray, " some"]:
    """The pairs with a match whose variances differ by more than ROUND, be it along two
    directions or in the two photos."""
    least, most = points.variances
    if np.max(most, initial=0) <= ROUND * np.min(least[points.seen], initial=np.inf):
        return np.zeros(0, int)
    left, right = places
    lower = np.minimum(least[left], least[right])
    uneven = np.maximum(most[left], most[right]) > ROUND * lower
    return np.flatnonzero(np.any(pairs.mask & uneven, axis=1))


def scale_by_direction(
    pair: Pair, left: Cofactors, right: Cofactors, pose: RelativePose
) -> Float[Array, " match"]:
    """sqrt(B Q Bᵀ / B Bᵀ) of every match, B of this pose; 1 where B is zero."""
    f = fundamental_matrix(*pose.relative(), pair.focal_left, pair.focal_right)

    def scale(point, use, left, right):
        _, square, b = linearise(f, point, use)
        fair = use & (square > 0)
        variance = left.along(b[0], b[1]) + right.along(b[2], b[3])
        return jnp.sqrt(jnp.where(fair, variance / jnp.where(fair, square, 1.0), 1.0))

    return jax.vmap(scale)(pair.coordinates, pair.mask, left, right)


def _rows_of(tree: PyTree, rows: Int[np.ndarray, " some"]) -> PyTree:
    """These rows of the arrays of a tree."""
    return jax.tree.map(lambda a: np.asarray(a)[rows], tree)


def _with_rows(tree: PyTree, rows: Int[np.ndarray, " some"], new: PyTree) -> PyTree:
    """The arrays of a tree with these rows new."""

    def replace(old, part):
        out = np.array(old)
        out[rows] = part
        return out

    return jax.tree.map(replace, tree, new)
