"""Pairs of photos with matched points, as the files of other programs give them: photo
coordinates free of distortion, and what their accuracy is.

The unit of all coordinates is a pixel of the mean focal length of the photo; x to the
right, y up, from the principal point.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..batches.copies import without_copies
from ..batches.ragged import Ragged
from ..geometry import copies
from ..geometry.cofactor_roots import CofactorRoots, from_covariances
from ..geometry.pairs import Camera
from ..tables.cameras import Cameras
from ..tables.fields import TableError
from ..tables.measured import COORDINATES, COVARIANCES, DEVIATIONS, SCORE, Table

EQUAL = 1e-12
"""Relative difference of variances that is rounding."""

LEAST = 6
"""Points that two photos must share to be a pair: fewer do not check an orientation."""

MARKS = ("-", " - ", " and ")
"""Between the names of two photos in that of their pair."""

FOCALS = 1e-3, 1e9
"""Pixels between which a focal length lies: of other numbers a file is damaged."""

FARTHEST = 1e9
"""Pixels from the principal point beyond which there is no place of a photo."""

VARIANCES = 1e-12, 1e12
"""Between these the eigenvalues of usable cofactors lie."""


def is_focal(focal: float) -> bool:
    """Whether this is a focal length in pixels."""
    return bool(FOCALS[0] <= focal <= FOCALS[1])


class Seen(NamedTuple):
    """Points on one photo, and their cofactors: covariances for pixels of variance
    1."""

    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]
    cofactors: Float[np.ndarray, "point 2 2"]

    def choose(self, rows: Any) -> "Seen":
        """Some of the points."""
        return Seen(*(a[rows] for a in self))

    @property
    def usable(self) -> Bool[np.ndarray, " point"]:
        """Which points have coordinates and cofactors that can be calculated with."""
        least, most = VARIANCES
        (xx, xy), (_, yy) = np.moveaxis(self.cofactors, 0, -1)
        with np.errstate(all="ignore"):
            trace, det = xx + yy, xx * yy - xy**2
            near = np.maximum(np.abs(self.x), np.abs(self.y)) <= FARTHEST
            return near & (trace <= most) & (det >= least * trace)


class Match(NamedTuple):
    """One pair: the names of it and of its photos, the names of its points, where they
    are seen, both focal lengths in pixels, and the scores of its points where there are
    any."""

    name: str
    photos: tuple[str, str]
    points: Sequence[str]
    left: Seen
    right: Seen
    focals: tuple[float, float]
    score: Float[np.ndarray, " point"] | None = None


class Matches(NamedTuple):
    """The pairs of a file. `pairs`, in photo coordinates, goes into `orient_ragged` and
    `clean_ragged`; with `left`, `right` (the photos of each pair) and `points` (the
    names of all rows) into `block.orient_block`.

    `sigma_known`: whether a standard deviation of the pixels was given; otherwise those
    of `pairs` are for pixels of standard deviation 1, and only their ratios count.
    `warnings`: what was left out.
    """

    file: str
    names: tuple[str, ...]
    left: tuple[str, ...]
    right: tuple[str, ...]
    points: tuple[str, ...]
    pairs: Ragged
    sigma_known: bool
    warnings: tuple[str, ...] = ()

    @property
    def cameras(self) -> Cameras:
        """The cameras of the photos by their names, for coordinates that are photo
        coordinates already."""
        both = (self.left, self.pairs.focal_left), (self.right, self.pairs.focal_right)
        focals = {
            name: Camera(float(focal))
            for names, of_pairs in both
            for name, focal in zip(names, of_pairs, strict=True)
        }
        return Cameras(self.file, photos=focals)

    @property
    def table(self) -> Table:
        """The points as the table that the commands read."""
        pairs = self.pairs
        numbers = {name: getattr(pairs, name) for name in COORDINATES}
        if pairs.roots is not None:
            numbers |= _accuracy(pairs.sigma, pairs.roots)
        elif self.sigma_known:
            numbers["sigma"] = pairs.sigma
        if pairs.score is not None:
            numbers[SCORE] = pairs.score
        return Table(
            file=self.file,
            names=np.array(self.names, object),
            begins=pairs.begins,
            points=np.array(self.points, object),
            numbers=numbers,
            photos=(np.array(self.left, object), np.array(self.right, object)),
            warnings=self.warnings,
            relative=not self.sigma_known,
        )


def _accuracy(
    sigma: Float[np.ndarray, " row"], roots: CofactorRoots
) -> dict[str, Float[np.ndarray, " row"]]:
    """The columns of a table with the accuracy of each coordinate."""
    both = [q * sigma[:, None, None] ** 2 for q in roots.cofactors]
    deviations = [np.sqrt(q[:, k, k]) for q in both for k in range(2)]
    covariances = [q[:, 0, 1] for q in both]
    names, values = (*DEVIATIONS, *COVARIANCES), (*deviations, *covariances)
    return dict(zip(names, values, strict=True))


def collect(
    file: str,
    matches: Sequence[Match],
    sigma: float | None,
    warnings: Sequence[str] = (),
) -> Matches:
    """The pairs of a file as `Matches`; `sigma`: the standard deviation of a pixel
    coordinate, if it is known."""
    side = lambda name: Seen(
        *map(np.concatenate, zip(*(getattr(m, name) for m in matches), strict=True))
    )
    left, right = side("left"), side("right")
    unit = 1.0 if sigma is None else float(sigma)
    equal = all(
        np.allclose(a.cofactors, np.eye(2), rtol=EQUAL, atol=EQUAL)
        for a in (left, right)
    )
    deviation, roots = np.full(len(left.x), unit), None
    if not equal:
        both = (unit**2 * a.cofactors for a in (left, right))
        deviation, roots = from_covariances(*both)
    focal_left, focal_right = np.array([m.focals for m in matches], float).T.copy()
    pairs = Ragged(
        begins=np.cumsum([0] + [len(m.points) for m in matches]),
        x_left=left.x,
        y_left=left.y,
        x_right=right.x,
        y_right=right.y,
        sigma=deviation,
        mask=np.ones(len(left.x), bool),
        focal_left=focal_left,
        focal_right=focal_right,
        roots=roots,
        score=_join_scores(matches),
    )
    return Matches(
        file=file,
        names=tuple(m.name for m in matches),
        left=tuple(m.photos[0] for m in matches),
        right=tuple(m.photos[1] for m in matches),
        points=tuple(name for m in matches for name in m.points),
        pairs=without_copies(pairs),
        sigma_known=sigma is not None,
        warnings=tuple(warnings),
    )


def _join_scores(matches: Sequence[Match]) -> Float[np.ndarray, " row"] | None:
    """The scores of all points, NaN of pairs without; None where no pair has any."""
    if all(m.score is None for m in matches):
        return None
    each = [
        np.full(len(m.points), np.nan) if m.score is None else m.score for m in matches
    ]
    return np.concatenate(each)


def check_names(file: str, names: Sequence[str]) -> None:
    """Raises TableError where two photos have one name."""
    seen: dict[str, int] = {}
    for number, name in enumerate(names):
        if seen.setdefault(name, number) != number:
            raise TableError(
                file,
                found=f"the name {name!r} of photos {seen[name]} and {number}",
                expected="a name of its own for each photo",
            )


def join_names(photos: Sequence[tuple[str, str]]) -> list[str]:
    """The names of pairs, LEFT-RIGHT; with another mark where two would be the same
    (1-2 and 3, 1 and 2-3)."""
    for mark in MARKS:
        names = [mark.join(both) for both in photos]
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({k})" for k, name in enumerate(names, 1)]


class Tracks(NamedTuple):
    """Points that are seen on many photos, one row for each place: the numbers of its
    photo and of its point. `focals` of the photos in pixels; `names` of both."""

    photo: Int[np.ndarray, " row"]
    point: Int[np.ndarray, " row"]
    seen: Seen
    photos: Sequence[str]
    points: Sequence[str]
    focals: Float[np.ndarray, " photo"]

    def once(self) -> tuple["Tracks", int]:
        """Without the points on photos that show them at two places, and how many they
        are: nothing tells which place is right. The same place, twice, is one."""
        places = self.photo, self.point, self.seen.x, self.seen.y
        most = copies.distance_of(np.ones(len(self.photo)), self.focals[self.photo])
        each = self.choose(~copies.repeat_places(*places, most))
        key = np.stack([each.photo, each.point])
        _, inverse, counts = np.unique(
            key, axis=1, return_inverse=True, return_counts=True
        )
        twice = counts[inverse.ravel()] > 1
        return each.choose(~twice), int(np.sum(counts > 1))

    def choose(self, rows: Bool[np.ndarray, " row"]) -> "Tracks":
        """Some of the rows."""
        return self._replace(
            photo=self.photo[rows], point=self.point[rows], seen=self.seen.choose(rows)
        )

    def pairs(self, least: int = LEAST) -> list[Match]:
        """All pairs of photos that share so many points, in the order of the photos."""
        from scipy.sparse import csr_matrix

        shape = len(self.points), len(self.photos)
        ones = np.ones(len(self.photo), int)
        shows = csr_matrix((ones, (self.point, self.photo)), shape=shape)
        shared = (shows.T @ shows).tocoo()
        enough = (shared.data >= least) & (shared.row < shared.col)
        both = np.stack([shared.row, shared.col])[:, enough]
        both = both[:, np.lexsort(both[::-1])]
        rows = _rows_by_point(self)
        photos = [(self.photos[int(i)], self.photos[int(j)]) for i, j in both.T]
        names = join_names(photos)
        return [
            self._match(name, rows, int(i), int(j))
            for name, (i, j) in zip(names, both.T, strict=True)
        ]

    def _match(self, name: str, rows: list[np.ndarray], i: int, j: int) -> Match:
        """The pair of two photos."""
        of_left, of_right = self.point[rows[i]], self.point[rows[j]]
        common, left, right = np.intersect1d(
            of_left, of_right, assume_unique=True, return_indices=True
        )
        return Match(
            name=name,
            photos=(self.photos[i], self.photos[j]),
            points=tuple(self.points[int(k)] for k in common),
            left=self.seen.choose(rows[i][left]),
            right=self.seen.choose(rows[j][right]),
            focals=(float(self.focals[i]), float(self.focals[j])),
        )


def _rows_by_point(tracks: Tracks) -> list[Int[np.ndarray, " _"]]:
    """The rows of every photo, in the order of the points."""
    order = np.lexsort([tracks.point, tracks.photo])
    ends = np.searchsorted(tracks.photo[order], np.arange(len(tracks.photos) + 1))
    return [order[a:b] for a, b in pairwise(ends)]
