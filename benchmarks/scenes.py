"""Simulated pairs with known truth: photographs, target fields, and points in any
position. NumPy alone.

Conventions are those of the package: a point is λ p1 seen from the left and B + μ R p2
seen from the right, where p = (x, y, -f) and y points up; the base has length 1.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TAIL, SPREAD, AGREEING = 0.08, 3.0, 0.3
"""Photographs: share of true matches with larger noise, how many times larger, share of
the variance in common with neighbours."""
BULK = 1.057
"""Median of such noise over that of normal noise: divided by it, 1.48 times the median
distance is sigma."""
REPEATED = 0.05
"""Share of true matches that are found twice at the same place."""
UNDECIDABLE = 3.0
"""A wrong match within so many sigma of its true epipolar line cannot be told from a
right one by any pose."""

BASES = ("forward", "sideways", "turned", "wide")
FIELDS = ("wall", "planes", "corner")


class Scenes(NamedTuple):
    """Pairs of equal length: coordinates (pair, point) relative to the principal point,
    in the unit of `focal`.

    `there`: which points exist (target fields differ in length; coordinates of others
    are zero). `good`: true matches. `undecidable`: wrong matches that agree with the
    true pose by chance or along the epipolar line; keeping them is neither right nor
    wrong. `rotation`, `base`: the truth; it means nothing where `common` is false: no
    common view. `sigma`: of a coordinate; for photographs, 1.48 times the median of its
    errors.
    """

    x_left: Array
    y_left: Array
    x_right: Array
    y_right: Array
    there: Mask
    good: Mask
    undecidable: Mask
    focal: Array
    sigma: Array
    rotation: Array
    base: Array
    common: Mask

    @property
    def coordinates(self) -> tuple[Array, Array, Array, Array]:
        return self.x_left, self.y_left, self.x_right, self.y_right

    def __getitem__(self, rows) -> "Scenes":  # pyright: ignore[reportIncompatibleMethodOverride]
        """Some of the pairs."""
        chosen: list[Any] = [field[rows] for field in tuple(self)]
        return Scenes(*chosen)


def joined(parts: list[Scenes]) -> Scenes:
    """Several sets of pairs of equal length as one."""
    return Scenes(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


# ------------------------------------------------------------------------------------
# geometry


def turn(axis: Array, angle: float) -> Array:
    """The rotation by an angle about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def direction(rng: np.random.Generator) -> Array:
    """A unit vector, uniform on the sphere."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def looking(towards: Array, roll: float) -> Array:
    """Camera to space: the axis (0, 0, -1) looks along `towards`, then the photo is
    rolled about its axis."""
    z = -towards / np.linalg.norm(towards)
    x = np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    return frame @ turn(np.array([0.0, 0.0, 1.0]), roll)


def project(
    space: Array, rotation: Array, station: Array, focal: float
) -> tuple[Array, Mask]:
    """Photo coordinates (point, 2) of points of space, and which of them are in
    front."""
    seen = (space - station) @ rotation
    front = seen[:, 2] < -1e-6
    return -focal * seen[:, :2] / np.where(front, seen[:, 2], -1.0)[:, None], front


def rays(photo: Array, focal: float) -> Array:
    """The image vectors (x, y, -f) of photo coordinates."""
    return np.concatenate([photo, np.full((*photo.shape[:-1], 1), -focal)], axis=-1)


def sampson(
    left: Array, right: Array, focal: float, rotation: Array, base: Array
) -> Array:
    """First-order distance of every match (point, 2) from the coplanarity of rays and
    base, as an error of one coordinate: p1 · E p2 over the root of its variance, E =
    [B]× R."""
    x, y, z = base
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    p1, p2 = rays(left, focal), rays(right, focal)
    line_left, line_right = p2 @ essential.T, p1 @ essential
    condition = np.sum(p1 * line_left, axis=1)
    return condition / np.sqrt(
        np.sum(line_left[:, :2] ** 2, axis=1) + np.sum(line_right[:, :2] ** 2, axis=1)
    )


# ------------------------------------------------------------------------------------
# photographs


class Photo(NamedTuple):
    """What a simulated camera is: focal length, half width, half height, in px."""

    focal: float
    width: float
    height: float

    def uniform(self, rng: np.random.Generator, count: int) -> Array:
        """Points anywhere in the photo."""
        return rng.uniform(-1, 1, (count, 2)) * (self.width, self.height)

    def holds(self, photo: Array) -> Mask:
        return np.all(np.abs(photo) <= (self.width, self.height), axis=1)


def camera(rng: np.random.Generator) -> Photo:
    """f = 800 to 3,000 px, 1,000 to 4,000 px wide."""
    focal = float(np.exp(rng.uniform(np.log(800), np.log(3000))))
    width = np.clip(focal * rng.uniform(1.0, 1.5), 1000, 4000)
    return Photo(focal, width / 2, width * rng.uniform(0.65, 0.75) / 2)


def placed(rng: np.random.Generator, kind: str) -> tuple[Array, Array, float]:
    """(R, base, distance of the scene in bases) of a kind of base."""
    small = np.deg2rad(10)
    sideways = np.array([*rng.normal(size=2), 0.0])
    sideways = sideways / np.linalg.norm(sideways) + (0, 0, rng.uniform(-0.5, 0.5))
    roll = rng.uniform(-small, small)
    jitter = turn(direction(rng), rng.uniform(0, np.deg2rad(12)))
    if kind == "forward":
        tilt, around = np.deg2rad(30) * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        base = np.array(
            [
                np.sin(tilt) * np.cos(around),
                np.sin(tilt) * np.sin(around),
                -np.cos(tilt),
            ]
        )
        base, distance = base * rng.choice([-1, 1]), rng.uniform(3, 8)
        rotation = jitter @ looking(np.array([0, 0, -1.0]), roll)
    elif kind == "sideways":
        base, distance = sideways, rng.uniform(3, 12)
        rotation = jitter @ looking(np.array([0, 0, -1.0]), roll)
    elif kind == "turned":
        base, distance = sideways, rng.uniform(2, 8)
        quarter = rng.choice([0, np.pi / 2, -np.pi / 2, np.pi]) + rng.uniform(
            -small, small
        )
        roll = quarter if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi)
        jitter = turn(direction(rng), rng.uniform(0, np.deg2rad(25)))
        rotation = jitter @ looking(np.array([0, 0, -1.0]), roll)
    else:  # wide: the second photo looks back to the same place from 30 to 60° beside
        base, distance = sideways, rng.uniform(0.8, 1.8)
        aim = np.array([0, 0, -distance]) - sideways / np.linalg.norm(sideways)
        rotation = turn(direction(rng), rng.uniform(0, np.deg2rad(6))) @ looking(
            aim, rng.uniform(-0.5, 0.5)
        )
    return rotation, base / np.linalg.norm(base), distance


def depths(
    rng: np.random.Generator, photo: Array, focal: float, distance: float
) -> Array:
    """Depth of every point of the left photo, for a scene of random kind: layers, one
    or two facades, clutter."""
    ray = rays(photo, focal) / focal
    count = len(photo)

    def plane(least: float, most: float) -> Array:
        slope, around = np.deg2rad(rng.uniform(0, 55)), rng.uniform(0, 2 * np.pi)
        normal = np.array(
            [
                np.sin(slope) * np.cos(around),
                np.sin(slope) * np.sin(around),
                np.cos(slope),
            ]
        )
        scale = -(ray @ normal)
        depth = distance * rng.uniform(least, most) * normal[2] / np.maximum(scale, 0.1)
        return depth * (1 + rng.uniform(0.005, 0.04) * rng.uniform(-1, 1, count))

    kind = rng.integers(3)
    if kind == 0:  # layers, each in its part of the photo
        layers = rng.integers(2, 5)
        middles = rng.uniform(-1, 1, (layers, 2)) * np.max(np.abs(photo), axis=0)
        nearest = np.argmin(np.sum((photo[:, None] - middles) ** 2, axis=2), axis=1)
        level = distance * np.exp(rng.uniform(np.log(0.5), np.log(3.0), layers))
        return level[nearest] * (1 + 0.05 * rng.uniform(-1, 1, count))
    if kind == 1:  # one facade, or two that meet
        first = plane(0.8, 1.3)
        return first if rng.random() < 0.5 else np.minimum(first, plane(0.8, 1.5))
    return distance / rng.uniform(0.25, 1.8, count)


def agreeing(
    rng: np.random.Generator, photo: Array, width: float, waves: int = 40
) -> Array:
    """A smooth random field of variance 1 at every point, (point, 2): errors that
    neighbouring keypoints share."""
    number = rng.normal(0, 1 / (0.1 * width), (waves, 2))
    phase = rng.uniform(0, 2 * np.pi, (2, waves))
    return np.stack(
        [np.sum(np.cos(photo @ number.T + p), axis=1) for p in phase], axis=1
    ) * np.sqrt(2 / waves)


def noise(
    rng: np.random.Generator, left: Array, right: Array, photo: Photo, sigma: float
) -> tuple[Array, Array]:
    """The photos with noise of heavy tails, a part of which neighbours share."""
    larger = np.where(rng.random(len(left)) < TAIL, SPREAD, 1.0)[:, None]
    own, common = np.sqrt(1 - AGREEING), np.sqrt(AGREEING)
    left, right = (
        p
        + sigma
        / BULK
        * (
            own * larger * rng.normal(size=p.shape)
            + common * agreeing(rng, p, photo.width)
        )
        for p in (left, right)
    )
    return left, right


def windows(rng: np.random.Generator, photo: Photo, count: int) -> tuple[Array, Array]:
    """Matches between two window grids that only look alike: of each photo a small
    piece, a grid seen obliquely."""
    columns = max(2, int(np.ceil(np.sqrt(count))))
    grid = (
        np.stack(np.divmod(np.arange(count), columns)[::-1], axis=1) - (columns - 1) / 2
    )
    sides = []
    for _ in range(2):
        step = rng.uniform(0.03, 0.08) * photo.width
        shear = np.eye(2) + rng.uniform(-0.2, 0.2, (2, 2))
        middle = photo.uniform(rng, 1) * 0.7
        piece = grid @ shear.T * step
        sides.append(
            middle
            + piece / (1 + piece @ rng.uniform(-0.1, 0.1, 2)[:, None] / photo.width)
        )
    return sides[0], sides[1]


def photographs(
    pairs: int,
    points: int,
    wrong: float,
    kind: str | None = None,
    *,
    common: bool = True,
    seed: int = 0,
) -> Scenes:
    """Pairs of photographs, `wrong` of their matches wrong; of one kind of base
    (`BASES`), or of all in turn.

    Of the wrong matches about 70 % lie anywhere, 15 % on the true epipolar line at
    another depth, 15 % belong to one to three groups of repeated structure: a piece of
    the scene moved by one and the same step. Without a `common` view all are wrong:
    anywhere, but for one to three groups of 4 to 12 windows that agree among
    themselves.
    """
    make = _photographed if common else _unrelated
    parts = []
    for number in range(pairs):
        own = kind or BASES[number % len(BASES)]
        rng = np.random.default_rng(
            [seed, number, points, round(1000 * wrong), int(common), BASES.index(own)]
        )
        parts.append(make(rng, points, wrong, own))
    return Scenes(
        *(
            np.stack([np.asarray(v) for v in field])
            for field in zip(*parts, strict=True)
        )
    )


def _photographed(
    rng: np.random.Generator, points: int, wrong: float, kind: str
) -> tuple:
    good = points - round(wrong * points)
    sigma = rng.uniform(0.3, 1.0)
    while True:  # until enough of the scene is seen in both photos
        photo = camera(rng)
        rotation, base, distance = placed(rng, kind)
        left = photo.uniform(rng, 6 * points + 200)
        depth = depths(rng, left, photo.focal, distance)
        space = rays(left, photo.focal) / photo.focal * depth[:, None]
        right, front = project(space, rotation, base, photo.focal)
        seen = front & photo.holds(right) & (depth > 0.2)
        if np.sum(seen) >= points + 50:
            break
    left, right, space, depth = (a[seen] for a in (left, right, space, depth))

    def noisy(one: Array, other: Array) -> tuple[Array, Array]:
        return noise(rng, one, other, photo, sigma)

    true = noisy(left[:good], right[:good])
    twice = rng.permutation(good)[: 2 * round(REPEATED * good)].reshape(2, -1)
    for side in true:
        side[twice[0]] = side[twice[1]]
    rest = slice(good, points)
    along, grouped = (round(0.15 * (points - good)),) * 2
    one = np.array(left[rest])
    other = photo.uniform(rng, points - good)
    # the partner is another window or twig on the same epipolar line: the point at
    # another depth
    for k in range(along):
        for _ in range(20):
            elsewhere = space[rest][k] * np.exp(rng.uniform(np.log(0.4), np.log(2.5)))
            at, front = project(elsewhere[None], rotation, base, photo.focal)
            if front[0] and photo.holds(at)[0]:
                other[k] = at[0]
                break
    # groups: points of one part of the photo, each matched to the window a step further
    groups = np.array_split(np.arange(along, along + grouped), rng.integers(1, 4))
    for members in groups:
        if len(members):
            middle = left[rng.integers(len(left))]
            near = np.argsort(np.sum((left - middle) ** 2, axis=1))[: len(members)]
            step = np.array([*rng.choice([-2, -1, 0, 1, 2], 2), 0.0]) * rng.uniform(
                0.03, 0.08
            )
            step[rng.integers(2)] += rng.choice([-1, 1]) * 0.05
            at, front = project(
                space[near] + step * depth[near].mean(), rotation, base, photo.focal
            )
            one[members], other[members] = (
                left[near],
                np.where(front[:, None], at, other[members]),
            )
    one[along + grouped :] = photo.uniform(rng, len(one) - along - grouped)
    one, other = noisy(one, other)
    left, right = (
        np.concatenate(both) for both in zip(true, (one, other), strict=True)
    )
    order = rng.permutation(points)
    left, right, is_good = left[order], right[order], order < good
    close = (
        np.abs(sampson(left, right, photo.focal, rotation, base)) <= UNDECIDABLE * sigma
    )
    there = np.ones(points, bool)
    return (
        *left.T,
        *right.T,
        there,
        is_good,
        ~is_good & close,
        photo.focal,
        sigma,
        rotation,
        base,
        True,
    )


def _unrelated(rng: np.random.Generator, points: int, wrong: float, kind: str) -> tuple:
    photo, sigma = camera(rng), rng.uniform(0.3, 1.0)
    left, right = photo.uniform(rng, points), photo.uniform(rng, points)
    begin = 0
    for _ in range(rng.integers(1, 4)):
        count = int(rng.integers(4, 13))
        left[begin : begin + count], right[begin : begin + count] = windows(
            rng, photo, count
        )
        begin += count
    left, right = noise(rng, left, right, photo, sigma)
    order, none = rng.permutation(points), np.zeros(points, bool)
    left, right = left[order], right[order]
    return (
        *left.T,
        *right.T,
        ~none,
        none,
        none,
        photo.focal,
        sigma,
        np.eye(3),
        np.array([1.0, 0, 0]),
        False,
    )


# ------------------------------------------------------------------------------------
# target fields

TARGET_FOCAL = 28.8
TARGET_SIGMA = TARGET_FOCAL / 72_000
"""mm: .0004 mm, a twentieth of a pixel of an industrial camera."""
FORMAT = Photo(TARGET_FOCAL, 18.0, 12.0)
MOST_TARGETS = 120


def target_fields(pairs: int, kind: str | None = None, *, seed: int = 0) -> Scenes:
    """Photos of regular target fields, as in an industrial network: 20 to 120 targets,
    no wrong one, in mm.

    Kinds (`FIELDS`, or all in turn): a wall with some targets on pedestals, several
    parallel or tilted boards, a corner of two or three walls. Photos convergent and
    rolled, in any position that sees at least 20 targets in common.
    """
    parts = []
    for number in range(pairs):
        rng = np.random.default_rng([seed, number])
        parts.append(_targets(rng, kind or FIELDS[number % len(FIELDS)]))
    return Scenes(
        *(
            np.stack([np.asarray(v) for v in field])
            for field in zip(*parts, strict=True)
        )
    )


def _grid(rng: np.random.Generator, least: int, most: int) -> Array:
    """A regular grid of side about 1 in the plane z = 0."""
    columns, rows = rng.integers(least, most + 1, 2)
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, columns),
        np.linspace(-0.5, 0.5, rows) * rng.uniform(0.6, 1.0),
    )
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def _field(rng: np.random.Generator, kind: str) -> Array:
    if kind == "wall":
        wall = _grid(rng, 5, 11)
        raised = rng.random(len(wall)) < rng.uniform(0.15, 0.4)
        wall[:, 2] = np.where(raised, rng.choice([0.05, 0.1, 0.2], len(wall)), 0.0)
        return wall
    if kind == "planes":
        boards = []
        for _ in range(rng.integers(2, 5)):
            tilt = turn(
                direction(rng), rng.uniform(0, np.deg2rad(40)) * rng.integers(2)
            )
            boards.append(0.5 * _grid(rng, 3, 6) @ tilt.T + rng.uniform(-0.5, 0.5, 3))
        return np.concatenate(boards)
    first, second, third = _grid(rng, 4, 7), _grid(rng, 4, 7), _grid(rng, 4, 7)
    walls = [first, second[:, [2, 1, 0]] + (-0.5, 0, 0.5)]
    return np.concatenate(
        [*walls, third[:, [0, 2, 1]] + (0, -0.5, 0.5)] if rng.random() < 0.5 else walls
    )


def _targets(rng: np.random.Generator, kind: str) -> tuple:
    while True:
        space = _field(rng, kind)
        stations, turns = [], []
        for _ in range(2):
            slope, around = (
                np.arccos(rng.uniform(np.cos(np.deg2rad(55)), 1)),
                rng.uniform(0, 2 * np.pi),
            )
            away = np.array(
                [
                    np.sin(slope) * np.cos(around),
                    np.sin(slope) * np.sin(around),
                    np.cos(slope),
                ]
            )
            station = away * rng.uniform(0.9, 2.5)
            aim = rng.uniform(-0.15, 0.15, 3) - station
            stations.append(station)
            turns.append(looking(aim, rng.uniform(-np.pi, np.pi)))
        base = stations[1] - stations[0]
        length = np.linalg.norm(base)
        photos = [
            project(space, r, s, TARGET_FOCAL)
            for r, s in zip(turns, stations, strict=True)
        ]
        seen = np.all([front & FORMAT.holds(photo) for photo, front in photos], axis=0)
        if np.sum(seen) >= 20 and length > 0.3:
            break
    chosen = np.flatnonzero(seen)[:MOST_TARGETS]
    there = np.arange(MOST_TARGETS) < len(chosen)
    padded = np.zeros((2, MOST_TARGETS, 2))
    for side, (photo, _) in zip(padded, photos, strict=True):
        side[: len(chosen)] = photo[chosen] + rng.normal(
            0, TARGET_SIGMA, (len(chosen), 2)
        )
    rotation, direction_ = turns[0].T @ turns[1], turns[0].T @ base / length
    none = np.zeros(MOST_TARGETS, bool)
    return (
        *padded[0].T,
        *padded[1].T,
        there,
        there,
        none,
        TARGET_FOCAL,
        TARGET_SIGMA,
        rotation,
        direction_,
        True,
    )


# ------------------------------------------------------------------------------------
# any position

PLAIN_FOCAL, PLAIN_SIGMA, PLAIN_HALF = 2000.0, 0.5, 2000.0


def any_position(pairs: int, points: int, wrong: float, *, seed: int = 0) -> Scenes:
    """Points in a random volume of space, photos in any position, normal noise, wrong
    partners anywhere; px.

    The points fill a ball of radius r seen from distances of 1.2 to 3 r, the base in
    any direction, the right photo looks at the ball and is rolled by any angle.
    """
    parts = []
    for number in range(pairs):
        rng = np.random.default_rng([seed, number, points, round(1000 * wrong)])
        parts.append(_plain(rng, points, wrong))
    return Scenes(
        *(
            np.stack([np.asarray(v) for v in field])
            for field in zip(*parts, strict=True)
        )
    )


def _plain(rng: np.random.Generator, points: int, wrong: float) -> tuple:
    good = points - round(wrong * points)
    photo = Photo(PLAIN_FOCAL, PLAIN_HALF, PLAIN_HALF)
    while True:
        base, distance = direction(rng), rng.uniform(2, 6)
        centre = np.array([0, 0, -distance])
        ball = rng.normal(size=(4 * points, 3))
        ball *= (rng.random(len(ball)) ** (1 / 3) / np.linalg.norm(ball, axis=1))[
            :, None
        ]
        space = centre + ball * distance * rng.uniform(0.3, 0.7)
        rotation = looking(centre - base, rng.uniform(-np.pi, np.pi))
        (left, _), (right, _) = (
            project(space, np.eye(3), np.zeros(3), photo.focal),
            project(space, rotation, base, photo.focal),
        )
        seen = (
            (space[:, 2] < -0.3)
            & ((space - base) @ rotation[:, 2] < -0.3)
            & photo.holds(left)
            & photo.holds(right)
        )
        if np.sum(seen) >= points:
            break
    left, right = left[seen][:points], right[seen][:points]
    is_good = rng.permutation(points) < good
    right = np.where(is_good[:, None], right, photo.uniform(rng, points))
    left, right = (p + rng.normal(0, PLAIN_SIGMA, p.shape) for p in (left, right))
    close = (
        np.abs(sampson(left, right, photo.focal, rotation, base))
        <= UNDECIDABLE * PLAIN_SIGMA
    )
    there = np.ones(points, bool)
    return (
        *left.T,
        *right.T,
        there,
        is_good,
        ~is_good & close,
        photo.focal,
        PLAIN_SIGMA,
        rotation,
        base,
        True,
    )


# ------------------------------------------------------------------------------------
# weak bases

WITHOUT_BASE = ("rotation", "far", "shallow")
"""The photos only turn; the scene is 100 bases away; its relief is 1 % of its
distance."""


BESIDE = 0.05
"""Half of the wrong points are anywhere, half of them so many photo widths away from
where they should be."""


def weak_bases(
    kind: str, pairs: int, points: int, wrong: float, *, seed: int = 0
) -> Scenes:
    """Pairs of one kind: of `WITHOUT_BASE`, or `plane` or `space`; normal noise of f/5,000 to
    f/1,000."""
    kinds = (*WITHOUT_BASE, "plane", "space")
    begin = [seed, kinds.index(kind), points, round(1000 * wrong)]
    parts = [
        _weak(np.random.default_rng([*begin, number]), kind, points, wrong)
        for number in range(pairs)
    ]
    return Scenes(
        *(
            np.stack([np.asarray(v) for v in field])
            for field in zip(*parts, strict=True)
        )
    )


def _weak(rng: np.random.Generator, kind: str, points: int, wrong: float) -> tuple:
    focal = 1000.0
    photo = Photo(focal, focal * rng.uniform(0.4, 0.8), focal * rng.uniform(0.3, 0.5))
    sigma = focal / np.exp(rng.uniform(np.log(1000), np.log(5000)))
    base = direction(rng) * (1, 1, 0.5)
    base = base / np.linalg.norm(base)
    while True:
        rotation = turn(direction(rng), rng.uniform(0, np.deg2rad(15)))
        left = photo.uniform(rng, 8 * points)
        depth = _depths_of(rng, kind, left, focal)
        space = rays(left, focal) / focal * depth[:, None]
        station = base if kind != "rotation" else 0 * base
        right, front = project(space, rotation, station, focal)
        seen = front & photo.holds(right)
        if np.sum(seen) >= points:
            break
    left, right = left[seen][:points], right[seen][:points]
    good = np.arange(points) >= round(wrong * points)
    moved = rng.normal(0, BESIDE * 2 * photo.width, (points, 2))
    other = np.where(
        rng.random((points, 1)) < 0.5, photo.uniform(rng, points), right + moved
    )
    right = np.where(good[:, None], right, other)
    left, right = (p + rng.normal(0, sigma, p.shape) for p in (left, right))
    near = np.abs(sampson(left, right, focal, rotation, base))
    close = near <= UNDECIDABLE * sigma
    return (
        *left.T,
        *right.T,
        np.ones(points, bool),
        good,
        ~good & close,
        focal,
        sigma,
        rotation,
        base,
        kind != "rotation",
    )


def _depths_of(rng: np.random.Generator, kind: str, left: Array, focal: float) -> Array:
    """Depths in bases."""
    count = len(left)
    if kind in ("rotation", "far"):
        return 100 * rng.uniform(0.7, 1.4, count)
    distance = rng.uniform(2, 6)
    if kind == "space":
        return distance * rng.uniform(0.7, 1.4, count)
    slope, around = np.deg2rad(rng.uniform(0, 45)), rng.uniform(0, 2 * np.pi)
    across = np.sin(slope) * np.array([np.cos(around), np.sin(around)])
    scale = np.maximum(np.cos(slope) - left / focal @ across, 0.1)
    relief = 0.01 if kind == "shallow" else 0.0
    depth = distance * np.cos(slope) / scale
    return depth * (1 + relief * rng.uniform(-1, 1, count))


# ------------------------------------------------------------------------------------
# forward facades

FORWARD_BASE = (0.5, 0.0, -1.0)
"""Towards a facade FACADE_DISTANCE away with this relief, as a part of the distance."""

FACADE_DISTANCE, FACADE_RELIEF = 20.0, 0.05

FORWARD_POINTS = 600
"""Points of a pair."""


def forward_facades(pairs: int, wrong: float, *, seed: int = 0) -> Scenes:
    """Pairs of photographs that walk towards a facade: f 2,000 px, errors of 0.4 px, and
    a share of wrong matches anywhere in the other photo.

    The other station's image lies at the edge of the photo, and the facade is nearly
    plane: the base is determined to some tenths of a degree.
    """
    begin = [seed, round(1000 * wrong)]
    parts = [
        _forward(np.random.default_rng([*begin, number]), wrong)
        for number in range(pairs)
    ]
    fields = zip(*parts, strict=True)
    return Scenes(*(np.stack([np.asarray(v) for v in field]) for field in fields))


def _forward(rng: np.random.Generator, wrong: float) -> tuple:
    """The fields of one pair."""
    focal, sigma, points = 2000.0, 0.4, FORWARD_POINTS
    photo = Photo(focal, 1000.0, 750.0)
    left = photo.uniform(rng, points)
    relief = 1 + FACADE_RELIEF * rng.uniform(-1, 1, points)
    space = rays(left, focal) / focal * (FACADE_DISTANCE * relief)[:, None]
    rotation = turn(direction(rng), rng.normal(0, 0.05))
    station = np.array(FORWARD_BASE)
    right, _ = project(space, rotation, station, focal)
    good = np.arange(points) >= round(wrong * points)
    right = np.where(good[:, None], right, photo.uniform(rng, points))
    left, right = (p + rng.normal(0, sigma, p.shape) for p in (left, right))
    base = station / np.linalg.norm(station)
    near = np.abs(sampson(left, right, focal, rotation, base))
    return (
        *left.T,
        *right.T,
        np.ones(points, bool),
        good,
        ~good & (near <= UNDECIDABLE * sigma),
        focal,
        sigma,
        rotation,
        base,
        True,
    )


# ------------------------------------------------------------------------------------
# repeated facades

FACADES = ("none", "beside", "among")
"""Without a common view; a true consensus beside a larger repeated piece; many true
matches, and a smaller piece."""

FACADE_MATCHES = 200

PIECE_WINDOWS = (3, 11)
"""Windows of a repeated piece."""

PIECE_WIDTH = (0.15, 0.4)
"""Width of the piece, as a part of the photo's."""

PIECE_MATCHES = (20, 70)
"""Matches of the piece."""

PIECE_RELIEF = 0.02
"""Depth of its windows, as a part of the width of the piece."""

PIECE_NEAR = 0.1
"""How far the matches of a window are from its middle, as a part of the step from
window to window."""


def repeated_facades(kind: str, pairs: int, *, seed: int = 0) -> Scenes:
    """Pairs of one of the `FACADES`, of FACADE_MATCHES matches each.

    A repeated piece is one and the same structure at two places: its matches fit a pose
    of their own, exactly and all together, but lie in a small part of both photos, some
    at every window. They are true matches of nothing.
    """
    begin = [seed, FACADES.index(kind)]
    parts = [
        _facade(np.random.default_rng([*begin, number]), kind, number)
        for number in range(pairs)
    ]
    fields = zip(*parts, strict=True)
    return Scenes(*(np.stack([np.asarray(v) for v in field]) for field in fields))


def _facade(rng: np.random.Generator, kind: str, number: int) -> tuple:
    """The fields of one pair."""
    base = BASES[number % len(BASES)]
    piece = int(rng.integers(PIECE_MATCHES[0], PIECE_MATCHES[1] + 1))
    if kind == "none":
        true = 0
        pair = photographs(1, FACADE_MATCHES, 1.0, base, common=False, seed=number)
    else:
        least, most = (0.4, 0.8) if kind == "beside" else (1.5, 3.0)
        true = int(
            np.clip(piece * rng.uniform(least, most), 12, FACADE_MATCHES - piece - 20)
        )
        wrong = 1 - true / FACADE_MATCHES
        pair = photographs(1, FACADE_MATCHES, wrong, base, seed=number)
    coordinates = np.stack(pair.coordinates)[:, 0]
    photo = _photo_of(coordinates, float(pair.focal[0]))
    left, right = _piece(rng, photo, piece)
    sigma = float(pair.sigma[0])
    left, right = noise(rng, left, right, photo, sigma)

    # the piece takes the places of wrong matches
    places = rng.permutation(np.flatnonzero(~pair.good[0]))[:piece]
    coordinates[:, places] = [*left.T, *right.T]
    sides = coordinates[:2].T, coordinates[2:].T
    pose = pair.rotation[0], pair.base[0]
    near = np.abs(sampson(*sides, photo.focal, *pose))
    close = near <= UNDECIDABLE * sigma
    return (
        *coordinates,
        pair.there[0],
        pair.good[0],
        ~pair.good[0] & close & pair.common[0],
        photo.focal,
        sigma,
        *pose,
        pair.common[0],
    )


def _photo_of(coordinates: Array, focal: float) -> Photo:
    """The photo that holds these matches."""
    x, y = np.abs(coordinates[::2]), np.abs(coordinates[1::2])
    return Photo(focal, float(np.max(x)), float(np.max(y)))


def _piece(rng: np.random.Generator, photo: Photo, count: int) -> tuple[Array, Array]:
    """The matches of a repeated piece in both photos, by a pose of its own."""
    windows = int(rng.integers(PIECE_WINDOWS[0], PIECE_WINDOWS[1] + 1))
    while True:
        rotation, base, distance = placed(rng, str(rng.choice(BASES)))
        width = 2 * photo.width * rng.uniform(*PIECE_WIDTH)
        columns = max(2, int(np.ceil(np.sqrt(windows))))
        step = width / columns
        grid = np.stack(np.divmod(np.arange(windows), columns)[::-1], axis=1) * step
        at = grid[rng.integers(windows, size=count)]
        at = at + PIECE_NEAR * step * rng.uniform(-1, 1, at.shape)
        left = photo.uniform(rng, 1) * 0.7 + at - np.mean(at, axis=0)
        slope = rng.uniform(-0.7, 0.7, 2)
        depth = distance / (1 + left @ slope / photo.focal)
        relief = PIECE_RELIEF * width / photo.focal
        depth = depth * (1 + relief * rng.uniform(-1, 1, count))
        space = rays(left, photo.focal) / photo.focal * depth[:, None]
        right, front = project(space, rotation, base, photo.focal)
        if np.all(front & photo.holds(right) & photo.holds(left) & (depth > 0.2)):
            return left, right


# ------------------------------------------------------------------------------------
# two scenes in one photo


def two_scenes(
    pairs: int, first: int, second: int, points: int, *, seed: int = 0
) -> Scenes:
    """Pairs of photographs of which so many matches belong to one scene and to another,
    which has moved between the photos; of the `points` matches all others are wrong.
    `good` and the pose are those of the first scene, `undecidable` matches those of the
    second."""
    parts = []
    for number in range(pairs):
        rng = np.random.default_rng([seed, number, first, second, points])
        parts.append(_two_scenes(rng, first, second, points, number))
    fields = zip(*parts, strict=True)
    return Scenes(*(np.stack([np.asarray(v) for v in field]) for field in fields))


def _two_scenes(
    rng: np.random.Generator, first: int, second: int, points: int, number: int
) -> tuple:
    """The fields of one pair."""
    kind, seed = BASES[number % len(BASES)], int(rng.integers(1 << 30))
    pair = photographs(1, points, 1 - first / points, kind, seed=seed)
    coordinates = np.stack(pair.coordinates)[:, 0]
    photo = _photo_of(coordinates, float(pair.focal[0]))
    while True:
        rotation, base, distance = placed(rng, str(rng.choice(BASES)))
        left = photo.uniform(rng, 6 * second + 200)
        depth = depths(rng, left, photo.focal, distance)
        space = rays(left, photo.focal) / photo.focal * depth[:, None]
        right, front = project(space, rotation, base, photo.focal)
        seen = front & photo.holds(right) & (depth > 0.2)
        if np.sum(seen) >= second:
            break
    sides = noise(rng, left[seen][:second], right[seen][:second], photo, pair.sigma[0])
    places = rng.permutation(np.flatnonzero(~pair.good[0]))[:second]
    coordinates[:, places] = np.concatenate(sides, axis=1).T
    of_second = np.isin(np.arange(points), places)
    before, after = (
        [field[0] for field in tuple(pair)[k]] for k in (slice(4, 6), slice(7, None))
    )
    return (*coordinates, *before, of_second, *after)
