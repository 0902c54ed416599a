"""COLMAP databases of simulated pairs with known poses, made by pycolmap, and what a
verification of them is worth."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pycolmap
from numpy.typing import NDArray

from jaxro.geometry import mock_pairs

Array = NDArray[np.float64]

FEWEST, MOST = 200, 1000
"""Matches of a pair."""
FOCAL, CENTRE = 2000.0, 3000.0
"""Of the pinhole camera, in pixels."""
RIGHT = 0.1
"""Degrees within which rotation and direction of the base are right."""

FISHEYES = {
    "OPENCV_FISHEYE": (764, 760, 1000, 1010, -0.01, 0.003, -0.001, 0.0002),
    "SIMPLE_RADIAL_FISHEYE": (764, 1000, 1010, -0.01),
    "FOV": (600, 605, 1000, 1010, 0.9),
    "THIN_PRISM_FISHEYE": (
        *(764, 762, 1000, 1010, -0.01, 0.003),
        *(0.0005, -0.0004, 0.0003, -0.0001, 0.001, -0.0008),
    ),
}
"""Parameters of wide-angle cameras whose image of 2,000 x 2,000 pixels is as wide as a
field of 150°."""
FIELD = 150.0
"""Degrees."""
DEPTHS = 3.0, 12.0
"""Distances of the points in bases."""
TURN = 25.0
"""Largest angle between the two photos, in degrees."""


class Truth(NamedTuple):
    """By pair: numbers of its images, R and t of cam2_from_cam1, right matches."""

    images: list[tuple[int, int]]
    rotation: Array
    translation: Array
    good: list[NDArray[np.bool_]]


class Verdict(NamedTuple):
    """Shares of the pairs within RIGHT of the truth, of the right matches that are
    kept, and of those kept that are wrong; the median error of the pairs, in degrees
    (the larger one of rotation and direction of the base)."""

    right: float
    kept: float
    false: float
    median: float


def write_pinhole(
    path: Path, counts: NDArray, rng: np.random.Generator, noise: float, wrong: float
) -> Truth:
    """Pairs of photos in any position (`mock_pairs.random_pairs`), with so many
    matches (not more than MOST)."""
    exact, pose = mock_pairs.random_pairs(
        jax.random.key(0), len(counts), MOST, focal=FOCAL
    )
    x1, y1, x2, y2 = (np.asarray(c) for c in exact.coordinates)
    pixels = lambda x, y: np.stack([CENTRE + x, CENTRE - y], axis=-1)
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=int(2 * CENTRE),
        height=int(2 * CENTRE),
        params=[FOCAL, FOCAL, CENTRE, CENTRE],
        has_prior_focal_length=True,
    )
    photos = (
        (left[:count], right[:count])
        for count, left, right in zip(
            counts, pixels(x1, y1), pixels(x2, y2), strict=True
        )
    )
    images, good = _write(path, camera, photos, rng, noise, wrong)
    turned = np.diag([1.0, -1.0, -1.0])
    rotation, base = (np.array(part) for part in pose.relative())
    rotation = turned @ np.moveaxis(rotation, (0, 1), (2, 1)) @ turned
    translation = -np.einsum("pij,jp->pi", rotation @ turned, base)
    return Truth(images, rotation, translation, good)


def write_fisheye(
    path: Path,
    model: str,
    counts: NDArray,
    rng: np.random.Generator,
    noise: float,
    wrong: float,
) -> Truth:
    """Pairs of photos of one of the FISHEYES, the base in any direction, points all
    over the field."""
    camera = pycolmap.Camera(
        model=model,
        width=2000,
        height=2000,
        params=FISHEYES[model],
        has_prior_focal_length=True,
    )
    axes = rng.normal(size=(len(counts), 3))
    axes *= rng.uniform(0, np.deg2rad(TURN), (len(counts), 1)) / _length(axes)
    rotation = np.stack([pycolmap.Rotation3d(axis).matrix() for axis in axes])
    translation = rng.normal(size=(len(counts), 3))
    translation /= _length(translation)
    photos = (
        _seen_by_both(camera, r, t, count, rng)
        for r, t, count in zip(rotation, translation, counts, strict=True)
    )
    images, good = _write(path, camera, photos, rng, noise, wrong)
    return Truth(images, rotation, translation, good)


def _seen_by_both(
    camera: pycolmap.Camera,
    rotation: Array,
    translation: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Pixels of so many points within the FIELD of both photos."""
    left, right = np.zeros((0, 2)), np.zeros((0, 2))
    while len(left) < count:
        pixels = rng.uniform(0, [camera.width, camera.height], (4 * count, 2))
        rays = np.asarray(camera.cam_from_img(pixels))
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        points *= rng.uniform(*DEPTHS, (len(rays), 1)) / _length(points)
        moved = points @ rotation.T + translation
        here, other = (np.asarray(camera.img_from_cam(x)) for x in (points, moved))
        inside = (other > 0) & (other < [camera.width, camera.height])
        # COLMAP gives a ray to what lies more than 90° off the axis, too, a wrong one
        within = np.all(inside & (np.abs(here - pixels) < 1e-3), axis=1)
        least = np.cos(np.deg2rad(FIELD / 2))
        for seen in (points, moved):
            within &= seen[:, 2] > least * _length(seen)[:, 0]
        left = np.concatenate([left, pixels[within]])
        right = np.concatenate([right, other[within]])
    return left[:count], right[:count]


def _length(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def _write(
    path: Path,
    camera: pycolmap.Camera,
    photos: Iterator[tuple[Array, Array]],
    rng: np.random.Generator,
    noise: float,
    wrong: float,
) -> tuple[list[tuple[int, int]], list[NDArray[np.bool_]]]:
    """The database; a share `wrong` of the matches of a pair have the partner of
    another one."""
    pairs, good = [], []
    with (
        pycolmap.Database.open(str(path)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        number = database.write_camera(camera)
        for i, sides in enumerate(photos):
            images = []
            for k, pixels in enumerate(sides):
                name = f"{i:06d}_{k}.png"
                images.append(
                    database.write_image(pycolmap.Image(name=name, camera_id=number))
                )
                measured = pixels + rng.normal(0, noise, pixels.shape)
                database.write_keypoints(images[-1], measured.astype(np.float32))
            place = np.arange(len(sides[0]))
            partner, out = place.copy(), rng.permutation(len(place))
            out = out[: round(wrong * len(place))]
            partner[out] = np.roll(out, 1)
            matches = np.stack([place, partner], axis=-1).astype(np.uint32)
            database.write_matches(images[0], images[1], matches)
            pairs.append((images[0], images[1]))
            good.append(partner == place)
    return pairs, good


def judge(path: Path, truth: Truth) -> Verdict:
    """The two-view geometries of a database against the truth."""
    errors, kept, false = [], [], []
    with pycolmap.Database.open(str(path)) as database:
        for images, rotation, translation, good in zip(*truth, strict=True):
            found = database.read_two_view_geometry(*images)
            use = np.zeros(len(good), bool)
            use[np.asarray(found.inlier_matches, int).reshape(-1, 2)[:, 0]] = True
            kept.append(np.mean(use[good]))
            false.append(np.sum(use & ~good) / max(np.sum(use), 1))
            errors.append(_error(found.cam2_from_cam1, rotation, translation))
    return Verdict(
        right=float(np.mean(np.array(errors) < RIGHT)),
        kept=float(np.mean(kept)),
        false=float(np.mean(false)),
        median=float(np.median(errors)),
    )


def _error(pose, rotation: Array, translation: Array) -> float:
    """The larger of the angles of rotation and base to the truth, in degrees; infinite
    without a pose or a base."""
    if pose is None or not np.any(pose.translation):
        return np.inf
    turn = pose.rotation * pycolmap.Rotation3d(rotation).inverse()
    base = pose.translation / np.linalg.norm(pose.translation)
    across = np.linalg.norm(base - translation) / 2
    return float(np.degrees(max(turn.angle(), 2 * np.arcsin(min(across, 1)))))
