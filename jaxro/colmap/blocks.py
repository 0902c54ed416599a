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
from jaxtyping import Array, Float, Int, PyTree

from ..batches.batch import clean_in_stages
from ..batches.buckets import buckets
from ..batches.padding import FEWER
from ..geometry.copies import find_copies
from ..geometry.coplanarity import fundamental_matrix, linearise
from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair, pair
from ..rejection.classification import ENGINE, Found, Verdict, classify, verdict
from ..xla.programs import compiled
from ..xla.settings import RUN_FAST
from ..xla.slabs import Progress, Split, map_chunks, silent, spread
from .cameras import NO_RAY, PhotoPoints, camera_matrix, focal_length, to_photo
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


class Photo(NamedTuple):
    """A matched image: matrix of its camera, the place of its first keypoint among all,
    and how many it has."""

    matrix: Float[np.ndarray, "3 3"]
    begin: int
    count: int


class Photos(NamedTuple):
    """The matched images by number, and the keypoints of all. The first keypoint
    belongs to no image and is not seen: padding points to it."""

    of: dict[int, Photo]
    points: PhotoPoints

    @property
    def unseen(self) -> int:
        """How many keypoints have no photo coordinates."""
        return int(np.sum(~self.points.seen)) - 1

    def sides(self, pair_ids: list[int]) -> tuple[list[Photo], list[Photo]]:
        """The first and the second photos of the pairs."""
        both = [images_of(pair_id) for pair_id in pair_ids]
        return [self.of[a] for a, _ in both], [self.of[b] for _, b in both]


class Block(NamedTuple):
    """Some pairs: their numbers, their matches, and what was found."""

    pair_ids: list[int]
    matches: list[Matches]
    found: Found


def read_photos(
    database: Database, pair_ids: list[int], assume_calibrated: bool
) -> Photos:
    """Cameras and keypoints of every image that is matched. Raises TableError."""
    images = database.images(pair_ids)
    cameras = database.cameras(images, assume_calibrated)
    keypoints = database.keypoints(images)
    camera_of = lambda image: images[image].camera
    photos, parts, begin = {}, [NO_RAY], 1
    for number, own in groupby(sorted(images, key=camera_of), camera_of):
        camera = cameras[number]
        matrix, pixels = camera_matrix(camera), []
        for image in own:
            pixels.append(keypoints[image])
            photos[image] = Photo(matrix, begin, len(pixels[-1]))
            begin += len(pixels[-1])
        parts.append(to_photo(np.concatenate(pixels), camera))
    return Photos(photos, PhotoPoints(*map(np.concatenate, zip(*parts, strict=True))))


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
    keypoints = {image: photo.count for image, photo in photos.of.items()}
    lengths = [length for _, length in matched]
    for size, members in buckets(lengths, FEWER).items() if lengths else ():
        most = max(1, TOGETHER // size)
        for begin in range(0, len(members), most):
            pair_ids = [matched[i][0] for i in members[begin : begin + most]]
            matches = list(database.matches(pair_ids, keypoints))
            places = place_matches(photos, pair_ids, matches, size)
            pairs = pair_up(photos, pair_ids, places, sigma)
            told = lambda count, _, before=done: progress(before + count, len(matched))
            found = orient(pairs, photos.points, places, sigma, told)
            done += len(pair_ids)
            progress(done, len(matched))
            yield Block(pair_ids, matches, found)


def place_matches(
    photos: Photos, pair_ids: list[int], matches: list[Matches], size: int
) -> tuple[Places, Places]:
    """The places of the left and the right keypoints among all, padded to `size`."""
    left, right = np.zeros((2, len(pair_ids), size), np.int64)
    for i, (a, b) in enumerate(zip(*photos.sides(pair_ids), strict=True)):
        count = len(matches[i])
        left[i, :count] = matches[i][:, 0] + a.begin
        right[i, :count] = matches[i][:, 1] + b.begin
    return left, right


def pair_up(
    photos: Photos, pair_ids: list[int], places: tuple[Places, Places], sigma: float
) -> Pair:
    """The pairs with the same sigma in all directions, in NumPy. A match with a
    keypoint that is not seen is masked."""
    points, scale = photos.points, photos.points.scale
    left, right = places
    focals = [
        [focal_length(photo.matrix) for photo in side]
        for side in photos.sides(pair_ids)
    ]
    # in place, since the system zeroes every page of a new array
    square = scale[left] ** 2
    square += scale[right] ** 2
    square *= sigma**2 / 2
    pairs = pair(
        points.x[left],
        points.y[left],
        points.x[right],
        points.y[right],
        focal=focals,
        sigma=np.sqrt(square, out=square),
        mask=points.seen[left] & points.seen[right],
    )
    return jax.tree.map(np.asarray, pairs)


def orient(
    pairs: Pair,
    points: PhotoPoints,
    places: tuple[Places, Places],
    sigma: float,
    progress: Progress,
) -> Found:
    """What is found of pairs whose keypoints are at these places among all points."""
    measured = pairs
    verdicts = clean_in_stages(pairs, ENGINE, verdict, ONE_BY_ONE, progress)
    again = _where_directions_matter(pairs, points, places)
    if again.size:
        some, pose = _rows_of((pairs, verdicts.pose), again)
        left, right = (_rows_of(points, place[again]) for place in places)
        scale = spread(
            (some, left, right, pose), _scale_all.bind(), ONE_BY_ONE, chunk=1
        )
        some = eqx.tree_at(lambda one: one.sigma, some, sigma * scale)
        new = clean_in_stages(some, ENGINE, verdict, ONE_BY_ONE, silent)
        pairs, verdicts = _with_rows((pairs, verdicts), again, (some, new))
    found = spread((pairs, verdicts), _classify_all.bind(), ONE_BY_ONE, chunk=1)
    return _with_copies(found, measured, points, places)


def _with_copies(
    found: Found, pairs: Pair, points: PhotoPoints, places: tuple[Places, Places]
) -> Found:
    """What is found, with the matches kept that repeat one that is kept."""
    left, right = places
    seen = points.seen[left] & points.seen[right]
    if np.array_equal(seen, pairs.mask):
        return found
    focal = np.minimum(pairs.focal_left, pairs.focal_right)
    coordinates = pairs.x_left, pairs.y_left, pairs.x_right, pairs.y_right
    first = find_copies(coordinates, pairs.sigma, seen, focal)
    kept = np.take_along_axis(np.asarray(found.kept), first, axis=-1)
    return eqx.tree_at(lambda found: found.kept, found, kept & seen)


@compiled(settings=RUN_FAST)
def _classify_all(verdicts: tuple[Pair, Verdict]) -> Found:
    return map_chunks(lambda one: classify(*one), verdicts, 1)


@compiled(settings=RUN_FAST)
def _scale_all(data: tuple) -> Float[Array, "pair match"]:
    return map_chunks(lambda one: scale_by_direction(*one), data, 1)


def _where_directions_matter(
    pairs: Pair, points: PhotoPoints, places: tuple[Places, Places]
) -> Int[np.ndarray, " some"]:
    """The pairs with a match whose variances differ by more than ROUND, be it along two
    directions or in the two photos."""
    least, most = points.variances
    everywhere = ROUND * np.min(least[points.seen], initial=np.inf)
    if np.max(most, initial=0) <= everywhere:
        return np.zeros(0, int)
    left, right = places
    lower = np.minimum(least[left], least[right])
    upper = np.maximum(most[left], most[right])
    uneven = pairs.mask & (upper > ROUND * lower)
    return np.flatnonzero(np.any(uneven, axis=1))


def scale_by_direction(
    pair: Pair, left: PhotoPoints, right: PhotoPoints, pose: RelativePose
) -> Float[Array, " match"]:
    """sqrt(B Q Bᵀ / B Bᵀ) of every match, B of this pose; 1 where B is zero."""
    f = fundamental_matrix(*pose.relative(), pair.focal_left, pair.focal_right)

    def variance_along(keypoint: PhotoPoints, x, y):
        mixed = 2 * keypoint.xy * x * y
        return keypoint.xx * x * x + mixed + keypoint.yy * y * y

    def scale(point, use, left, right):
        _, square, b = linearise(f, point, use)
        fair = use & (square > 0)
        variance = variance_along(left, b[0], b[1])
        variance += variance_along(right, b[2], b[3])
        ratio = variance / jnp.where(fair, square, 1.0)
        return jnp.sqrt(jnp.where(fair, ratio, 1.0))

    return jax.vmap(scale)(pair.coordinates, pair.mask, left, right)


def _rows_of(tree: PyTree, rows: Int[np.ndarray, "..."]) -> PyTree:
    """These rows of the arrays of a tree."""
    return jax.tree.map(lambda a: np.asarray(a)[rows], tree)


def _with_rows(tree: PyTree, rows: Int[np.ndarray, " some"], new: PyTree) -> PyTree:
    """The arrays of a tree with these rows new."""

    def replace(old, part):
        out = np.array(old)
        out[rows] = part
        return out

    return jax.tree.map(replace, tree, new)
