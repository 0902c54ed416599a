"""One call of `jaxro colmap`: every matched pair of a COLMAP database oriented, its two-view geometry written.

With D = diag(1, -1, -1) (`colmap_cameras`) a pose R, b of jaxro is in COLMAP's frames

    cam2_from_cam1:  R' = D Rᵀ D,  t = -R' D b,    E = [t]x R',    F = K2⁻ᵀ E K1⁻¹,    H = K2 D Rᵀ (I - b nᵀ) D K1⁻¹

b of unit length, n · X = 1 the plane. F and H hold for keypoints free of distortion.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console

from ..elements import RelativePose
from ..experiments.tables import number, table
from . import colmap_batches as batches
from .colmap_batches import Matched, Photo
from .colmap_cameras import MODELS, PhotoCamera, photo_points
from .colmap_database import Database, Geometry, images_of, opened
from .colmap_orientation import Found, Kind
from .console import consoles, progress
from .tables import TableError

CONFIG = {
    Kind.oriented: 2,
    Kind.plane: 4,
    Kind.rotation: 5,
    Kind.weak: 2,
    Kind.no_consensus: 1,
    Kind.too_few: 1,
}
"""COLMAP's number: CALIBRATED 2, PLANAR 4, PANORAMIC 5, DEGENERATE 1."""

MEANING = {
    Kind.oriented: ("oriented", "CALIBRATED, with relative pose"),
    Kind.plane: ("plane scene", "PLANAR, without pose: a plane may have two"),
    Kind.rotation: ("pure rotation", "PANORAMIC, the base is zero"),
    Kind.weak: ("weak", "CALIBRATED, without pose: base too short for its errors"),
    Kind.no_consensus: ("no consensus", "DEGENERATE, no matches: agreement could be an accident"),
    Kind.too_few: ("too few", "DEGENERATE, no matches: fewer than six"),
}
GOOD = (Kind.oriented, Kind.plane, Kind.rotation)
D = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Options:
    """The command line. `sigma`: standard deviation of a keypoint coordinate in pixels."""

    database: Path
    sigma: float = 1.0
    out: Path | None = None
    force: bool = False
    assume_calibrated: bool = False


@dataclass
class Summary:
    """What became of the pairs: their number, matches and kept matches by kind; sigma0 of the oriented; seconds."""

    pairs: Counter[Kind] = field(default_factory=Counter)
    matches: Counter[Kind] = field(default_factory=Counter)
    kept: Counter[Kind] = field(default_factory=Counter)
    sigma0: list[float] = field(default_factory=list)
    unseen: int = 0
    seconds: float = 0.0

    def add(self, geometry: Geometry, kind: Kind, matches: int, sigma0: float) -> None:
        """Count one pair."""
        self.pairs[kind] += 1
        self.matches[kind] += matches
        self.kept[kind] += len(geometry.matches)
        if kind == Kind.oriented:
            self.sigma0.append(sigma0)


def run(options: Options) -> bool:
    """Orient, write, show. True if every pair has a geometry. Raises TableError."""
    console, errors = consoles()
    with progress(errors, "Orienting", None) as told:
        summary = orient_database(options, told)
    _show(console, options, summary)
    return all(kind in GOOD for kind in summary.pairs)


def orient_database(options: Options, told: Callable[..., None] = lambda done, total: None) -> Summary:
    """Orient every matched pair and write its geometry, all or none; told(done, total). Raises TableError."""
    if not (np.isfinite(options.sigma) and options.sigma > 0):
        raise TableError("--sigma", None, None, repr(options.sigma), "a positive number of pixels")
    begin, summary = time.perf_counter(), Summary()
    with opened(options.database, options.out, options.force) as database:
        numbers, lengths = map(list, zip(*database.pair_ids(), strict=True)) if database.pair_ids() else ([], [])
        cameras, photos = _photos(database, numbers, options.assume_calibrated)
        summary.unseen = sum(int(np.sum(~photo.points.seen)) for photo in photos.values())
        read = lambda places: _matched(database, photos, [numbers[i] for i in places])
        count = lambda done: told(done, len(numbers))
        for places, pairs, found in batches.oriented(lengths, read, options.sigma, count):
            geometries = []
            for row, (place, pair) in enumerate(zip(places, pairs, strict=True)):
                a, b = images_of(numbers[place])
                kind = Kind(int(found.kind[row]))
                geometries.append(geometry(numbers[place], pair, found, row, cameras[a].matrix, cameras[b].matrix))
                summary.add(geometries[-1], kind, len(pair.matches), float(found.sigma0[row]))
            database.write(geometries)
    summary.seconds = time.perf_counter() - begin
    return summary


def _photos(
    database: Database, numbers: list[int], assume_calibrated: bool
) -> tuple[dict[int, PhotoCamera], dict[int, Photo]]:
    """Camera and keypoints of every image that is matched."""
    images, cameras = database.images(), database.cameras()
    wanted: dict[int, int] = {}
    for pair_id in numbers:
        for image in images_of(pair_id):
            wanted.setdefault(image, pair_id)
    for image, pair_id in wanted.items():
        if image not in images:
            expected = "an image of the table images; match the images again"
            raise database.error("matches", f"pair_id {pair_id}", None, f"image {image}", expected)
        name, camera = images[image]
        row = f"image_id {image} ({name})"
        if camera not in cameras:
            raise database.error("images", row, "camera_id", str(camera), "a camera of the table cameras")
        if not cameras[camera].parameters:
            understood = ", ".join(name for name, _ in MODELS.values())
            found = f"camera {camera} of the model {cameras[camera].model}"
            raise database.error("images", row, "camera_id", found, f"one of {understood}; undistort the images first")
        if not (cameras[camera].known or assume_calibrated):
            expected = "1: a focal length that is known; calibrate, or give --assume-calibrated if it is good to 1 %"
            raise database.error("cameras", f"camera_id {camera}", "prior_focal_length", "0", expected)
    keypoints = database.keypoints(set(wanted))
    for image in wanted:
        if image not in keypoints:
            row = f"image_id {image} ({images[image].name})"
            raise database.error("keypoints", row, None, "no such row", "the keypoints of a matched image")
    of_image = {image: cameras[images[image].camera] for image in wanted}
    points = photo_points([keypoints[image] for image in wanted], list(of_image.values()))
    photos = {image: Photo(p, of_image[image].focal) for image, p in zip(wanted, points, strict=True)}
    return of_image, photos


def _matched(database: Database, photos: dict[int, Photo], numbers: list[int]) -> Iterator[Matched]:
    for pair_id, matches in zip(numbers, database.matches(numbers), strict=True):
        left, right = (photos[image] for image in images_of(pair_id))
        for column, photo in enumerate((left, right)):
            most = int(matches[:, column].max(initial=-1))
            if most >= len(photo.points.x):
                image = images_of(pair_id)[column]
                expected = f"places below {len(photo.points.x)}, the number of keypoints of image {image}"
                raise database.error("matches", f"pair_id {pair_id}", "data", f"keypoint {most}", expected)
        yield Matched(left, right, matches)


def geometry(pair_id: int, pair: Matched, found: Found, row: int, k1: np.ndarray, k2: np.ndarray) -> Geometry:
    """The row of two_view_geometries of the pair at `row` of a batch."""
    kind = Kind(int(found.kind[row]))
    kept = pair.matches[np.asarray(found.kept[row, : len(pair.matches)])]
    if kind in (Kind.no_consensus, Kind.too_few):
        return Geometry(pair_id, kept[:0], CONFIG[kind])
    q, turn, base = _relative(found.pose, row)
    back, forth = np.linalg.inv(k1), np.linalg.inv(k2)
    t = -turn @ base
    homography = k2 @ turn @ (np.eye(3) - np.outer(base, D @ [float(c[row]) for c in found.normal])) @ back
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ turn
    fundamental = forth.T @ essential @ back
    if kind == Kind.rotation:
        return Geometry(pair_id, kept, CONFIG[kind], H=k2 @ turn @ back, qvec=q, tvec=np.zeros(3))
    if kind == Kind.plane:
        return Geometry(pair_id, kept, CONFIG[kind], fundamental, essential, homography)
    if kind == Kind.weak:
        return Geometry(pair_id, kept, CONFIG[kind], fundamental, essential)
    return Geometry(pair_id, kept, CONFIG[kind], fundamental, essential, qvec=q, tvec=t)


def _relative(
    pose: RelativePose, row: int
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Quaternion (w, x, y, z) and matrix of R' = D Rᵀ D, and D b."""
    w, x, y, z, *base = (float(getattr(pose, name)[row]) for name in ("qw", "qx", "qy", "qz", "bx", "by", "bz"))
    # D turns by half a turn about x: the vector part of the inverse, turned
    x, y, z = -x, y, z
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.array([w, x, y, z]), matrix, D @ np.array(base)


def _show(console: Console, options: Options, summary: Summary) -> None:
    pairs, kept, matches = (sum(c.values()) for c in (summary.pairs, summary.kept, summary.matches))
    name = options.database.name
    console.print(f"Two-view geometries of {name}: {pairs} pairs, {kept} of {matches} matches kept", markup=False)
    rows = table("outcome", "pairs", "matches", "kept", "kept [%]", "written as", left=1)
    for kind in Kind:
        if summary.pairs[kind]:
            share = 100 * summary.kept[kind] / max(summary.matches[kind], 1)
            counts = [str(c[kind]) for c in (summary.pairs, summary.matches, summary.kept)]
            rows.add_row(MEANING[kind][0], *counts, number(share, 1), MEANING[kind][1])
    console.print(rows)
    if summary.unseen:
        console.print(f"{summary.unseen} keypoints lie where the distortion shows no ray; their matches are out.")
    if summary.sigma0:
        ratio = float(np.median(summary.sigma0))
        console.print(
            f"sigma0 of the oriented pairs, median: {number(ratio * options.sigma, 2)} px (--sigma {options.sigma:g})"
        )
        if not 0.5 <= ratio <= 2:
            console.print(f"Mind: keypoints seem to have about this sigma: try --sigma {ratio * options.sigma:.2g}")
    each = 1e3 * summary.seconds / max(pairs, 1)
    console.print(f"{summary.seconds:.1f} s, {each:.2f} ms a pair. Written to {options.out or options.database}", markup=False)
