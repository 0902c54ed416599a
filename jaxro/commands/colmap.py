"""One call of `jaxro colmap`: every matched pair of a COLMAP database oriented, its
two-view geometry written.

With D = diag(1, -1, -1) (`colmap_cameras`) a pose R, b of jaxro is in COLMAP's frames

    cam2_from_cam1:  R' = D Rᵀ D,  t = -R' D b,    E = [t]x R',
    F = K2⁻ᵀ E K1⁻¹,    H = K2 D Rᵀ (I - b nᵀ) D K1⁻¹

b of unit length, n · X = 1 the plane. F and H hold for keypoints free of distortion.
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console

from ..colmap import batches as batches
from ..colmap.batches import Block
from ..colmap.cameras import MODELS, PhotoCamera, PhotoPoints, photo_points
from ..colmap.database import Database, Geometry, Matches, images_of, opened
from ..colmap.two_view import Found, Kind
from ..reports.terminal import consoles, progress
from ..reports.text import number, table
from ..tables.fields import TableError
from ..xla.programs import pause_collection

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
    Kind.no_consensus: (
        "no consensus",
        "DEGENERATE, no matches: agreement could be an accident",
    ),
    Kind.too_few: ("too few", "DEGENERATE, no matches: fewer than six"),
}
GOOD = (Kind.oriented, Kind.plane, Kind.rotation)
D = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Options:
    """The command line. `sigma`: standard deviation of a keypoint coordinate in
    pixels."""

    database: Path
    sigma: float = 1.0
    out: Path | None = None
    force: bool = False
    assume_calibrated: bool = False


@dataclass
class Summary:
    """What became of the pairs: their number, matches and kept matches by kind; sigma0
    of the oriented; keypoints at which no ray is seen; geometries of pairs without
    matches; seconds."""

    pairs: Counter[Kind] = field(default_factory=Counter)
    matches: Counter[Kind] = field(default_factory=Counter)
    kept: Counter[Kind] = field(default_factory=Counter)
    sigma0: list[float] = field(default_factory=list)
    unseen: int = 0
    untouched: int = 0
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


@pause_collection()
def orient_database(
    options: Options, told: Callable[..., None] = lambda done, total: None
) -> Summary:
    """Orient every matched pair and write its geometry, all or none; told(done, total).
    Raises TableError."""
    if not (np.isfinite(options.sigma) and options.sigma > 0):
        raise TableError(
            "--sigma", found=repr(options.sigma), expected="a positive number of pixels"
        )
    begin, summary = time.perf_counter(), Summary()
    with opened(options.database, options.out, options.force) as database:
        matched = database.pair_ids()
        numbers, lengths = (
            [number for number, _ in matched],
            [length for _, length in matched],
        )
        photos = _photos(database, numbers, options.assume_calibrated)
        summary.unseen = int(np.sum(~photos.points.seen))
        of_block: list[Matches] = []

        def read(places: list[int]) -> Block:
            of_block[:] = _matches(database, photos, [numbers[i] for i in places])
            return photos.block([numbers[i] for i in places], of_block)

        count = lambda done: told(done, len(numbers))
        for places, found in batches.oriented(
            lengths, read, photos.points, options.sigma, count
        ):
            pair_ids = [numbers[i] for i in places]
            matrices = [
                np.stack([photos.cameras[image].matrix for image in side])
                for side in _sides(pair_ids)
            ]
            new = geometries(pair_ids, of_block, found, *matrices)
            database.write(new)
            for one, matches, kind, sigma0 in zip(
                new, of_block, found.kind, found.sigma0, strict=True
            ):
                summary.add(one, Kind(int(kind)), len(matches), float(sigma0))
        summary.untouched = database.geometries() - len(numbers)
    summary.seconds = time.perf_counter() - begin
    return summary


@dataclass(frozen=True)
class Photos:
    """The images that are matched: their cameras, all their keypoints, and where those
    of an image begin and end."""

    cameras: dict[int, PhotoCamera]
    points: PhotoPoints
    begin: dict[int, int]
    end: dict[int, int]

    def block(self, pair_ids: list[int], matches: list[Matches]) -> Block:
        """The pairs with places in all keypoints."""
        every = np.concatenate([*matches, np.zeros((0, 2), np.int64)])
        lengths = np.array([len(m) for m in matches])
        columns, focals = [], []
        for k, side in enumerate(_sides(pair_ids)):
            columns.append(
                every[:, k] + np.repeat([self.begin[image] for image in side], lengths)
            )
            focals.append(np.array([self.cameras[image].focal for image in side]))
        return Block(*columns, lengths, *focals)


def _sides(pair_ids: list[int]) -> tuple[list[int], list[int]]:
    """The first and the second images of the pairs."""
    both = [images_of(pair_id) for pair_id in pair_ids]
    return [a for a, _ in both], [b for _, b in both]


def _photos(database: Database, numbers: list[int], assume_calibrated: bool) -> Photos:
    """Cameras and keypoints of every image that is matched."""
    images, cameras = database.images(), database.cameras()
    wanted: dict[int, int] = {}
    for pair_id in numbers:
        for image in images_of(pair_id):
            wanted.setdefault(image, pair_id)
    for image, pair_id in wanted.items():
        if image not in images:
            expected = "an image of the table images; match the images again"
            raise database.error(
                "matches", f"pair_id {pair_id}", None, f"image {image}", expected
            )
        name, camera = images[image]
        row = f"image_id {image} ({name})"
        if camera not in cameras:
            raise database.error(
                "images", row, "camera_id", str(camera), "a camera of the table cameras"
            )
        if not cameras[camera].parameters:
            understood = ", ".join(name for name, _ in MODELS.values())
            found = f"camera {camera} of the model {cameras[camera].model}"
            raise database.error(
                "images",
                row,
                "camera_id",
                found,
                f"one of {understood}; undistort the images first",
            )
        if not (cameras[camera].known or assume_calibrated):
            expected = (
                "1: a focal length that is known; calibrate, or give "
                "--assume-calibrated if it is good to 1 %"
            )
            raise database.error(
                "cameras", f"camera_id {camera}", "prior_focal_length", "0", expected
            )
    keypoints = database.keypoints(set(wanted))
    for image in wanted:
        if image not in keypoints:
            row = f"image_id {image} ({images[image].name})"
            raise database.error(
                "keypoints",
                row,
                None,
                "no such row",
                "the keypoints of a matched image",
            )
    of_image = {image: cameras[images[image].camera] for image in wanted}
    lengths = [len(keypoints[image]) for image in wanted]
    pixels = np.concatenate([*(keypoints[image] for image in wanted), np.zeros((0, 2))])
    points = photo_points(pixels, list(of_image.values()), lengths)
    ends = np.cumsum(lengths).tolist()
    begins = [end - length for end, length in zip(ends, lengths, strict=True)]
    return Photos(
        of_image,
        points,
        dict(zip(wanted, begins, strict=True)),
        dict(zip(wanted, ends, strict=True)),
    )


def _matches(database: Database, photos: Photos, pair_ids: list[int]) -> list[Matches]:
    """The matches of these pairs. Raises TableError if one names a keypoint that does
    not exist."""
    found = list(database.matches(pair_ids))
    for pair_id, matches in zip(pair_ids, found, strict=True):
        for image, most in zip(
            images_of(pair_id), matches.max(axis=0, initial=-1), strict=True
        ):
            count = photos.end[image] - photos.begin[image]
            if most >= count:
                expected = (
                    f"places below {count}, the number of keypoints of image {image}"
                )
                raise database.error(
                    "matches",
                    f"pair_id {pair_id}",
                    "data",
                    f"keypoint {most}",
                    expected,
                )
    return found


def geometries(
    pair_ids: list[int],
    matches: list[Matches],
    found: Found,
    k1: Float[np.ndarray, "pair 3 3"],
    k2: Float[np.ndarray, "pair 3 3"],
) -> list[Geometry]:
    """The rows of two_view_geometries of a block of pairs; k1, k2: the matrices of
    their cameras."""
    signs = np.diagonal(D)
    # a half turn about x (D) of the inverse: of the quaternion only x changes its sign
    q = np.asarray(found.quaternion) * np.array([1.0, -1.0, 1.0, 1.0])
    turn = D @ np.swapaxes(found.rotation, 1, 2) @ D
    t = -np.einsum("pij,pj->pi", turn, signs * found.base)
    essential = np.stack([np.cross(t, turn[:, :, k]) for k in range(3)], axis=-1)
    back, forth = np.linalg.inv(k1), np.linalg.inv(k2)
    fundamental = np.swapaxes(forth, 1, 2) @ essential @ back
    normal = signs * found.normal
    rotation = k2 @ turn @ back
    homography = rotation + k2 @ (t[:, :, None] * normal[:, None, :]) @ back
    out = []
    for i, (pair_id, all_matches) in enumerate(zip(pair_ids, matches, strict=True)):
        kind = Kind(int(found.kind[i]))
        row = (pair_id, all_matches[found.kept[i, : len(all_matches)]], CONFIG[kind])
        if kind in (Kind.no_consensus, Kind.too_few):
            out.append(Geometry(*row))
        elif kind == Kind.rotation:
            out.append(Geometry(*row, H=rotation[i], qvec=q[i], tvec=np.zeros(3)))
        elif kind == Kind.plane:
            out.append(Geometry(*row, fundamental[i], essential[i], homography[i]))
        elif kind == Kind.weak:
            out.append(Geometry(*row, fundamental[i], essential[i]))
        else:
            out.append(
                Geometry(*row, fundamental[i], essential[i], qvec=q[i], tvec=t[i])
            )
    return out


def _show(console: Console, options: Options, summary: Summary) -> None:
    pairs, kept, matches = (
        sum(c.values()) for c in (summary.pairs, summary.kept, summary.matches)
    )
    name = options.database.name
    console.print(
        f"Two-view geometries of {name}: {pairs} pairs, {kept} of {matches} matches "
        "kept",
        markup=False,
    )
    rows = table(
        "outcome", "pairs", "matches", "kept", "kept [%]", "written as", left=1
    )
    for kind in Kind:
        if summary.pairs[kind]:
            share = 100 * summary.kept[kind] / max(summary.matches[kind], 1)
            counts = [
                str(c[kind]) for c in (summary.pairs, summary.matches, summary.kept)
            ]
            rows.add_row(MEANING[kind][0], *counts, number(share, 1), MEANING[kind][1])
    console.print(rows)
    if summary.unseen:
        console.print(
            f"{summary.unseen} keypoints lie where the distortion shows no ray; their "
            "matches are out."
        )
    if summary.untouched:
        console.print(
            f"Mind: {summary.untouched} geometries of pairs without a row in matches "
            "stay as they were."
        )
    if summary.sigma0:
        ratio = float(np.median(summary.sigma0))
        console.print(
            f"sigma0 of the oriented pairs, median: {number(ratio * options.sigma, 2)} "
            f"px (--sigma {options.sigma:g})"
        )
        if not 0.5 <= ratio <= 2:
            console.print(
                "Mind: keypoints seem to have about this sigma: try --sigma "
                f"{ratio * options.sigma:.2g}"
            )
    each = 1e3 * summary.seconds / max(pairs, 1)
    console.print(
        f"{summary.seconds:.1f} s, {each:.2f} ms a pair. Written to "
        f"{options.out or options.database}",
        markup=False,
    )
