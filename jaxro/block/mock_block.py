"""Simulated strips and blocks of aerial photos over hilly ground, with known truth."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..batches.ragged import Ragged
from .chain import Chained
from .measured_block import Ground, MeasuredBlock, ground
from .photo_pairs import FEWEST, common_points


class Flight(NamedTuple):
    """How the photos were taken: `strips` of `models` each (one photo more), focal
    length and half side of the photo in mm, height above ground, parts of a photo that
    the next one and the next strip cover, standard deviation of the photo coordinates
    in mm, deviations of the angles (rad) and of the stations from the plan, and the
    height of the hills."""

    strips: int = 1
    models: int = 10
    focal: float = 153.0
    half_side: float = 115.0
    height: float = 1530.0
    forward: float = 0.6
    sideward: float = 0.25
    sigma: float = 0.005
    tilt: float = 0.02
    drift: float = 15.0
    relief: float = 60.0


class MockBlock(NamedTuple):
    """A simulated block: what was measured, what is known of the ground, and the truth
    of photos and points."""

    block: MeasuredBlock
    ground: Ground
    photos: Chained
    points: Float[np.ndarray, "point 3"]


def mock_block(
    seed: int,
    flight: Flight | None = None,
    *,
    control_every: int = 5,
    control_sigma: float = 0.02,
) -> MockBlock:
    """A block with tie points in the standard zones of each photo, two in each, and
    known points across the strips at every `control_every`-th photo and at the end."""
    flight = Flight() if flight is None else flight
    rng = np.random.default_rng(seed)
    side = 2 * flight.half_side * flight.height / flight.focal
    base, across = (1 - flight.forward) * side, (1 - flight.sideward) * side
    along = np.arange(flight.models + 1)
    strip, place = (a.ravel() for a in np.meshgrid(np.arange(flight.strips), along))
    photos = len(strip)
    centres = np.stack(
        [place * base, strip * across, np.full(photos, flight.height)], axis=1
    )
    centres = centres + rng.normal(0, 1, (photos, 3)) * flight.drift
    angles = rng.normal(0, flight.tilt, (photos, 3))
    # every other strip is flown back
    angles[:, 2] += np.where(strip % 2 == 1, np.pi, 0.0)
    rotations = _rotations(angles)

    # three zones across each strip at every photo, two points in each
    zones = np.array([-0.36, 0.0, 0.36]) * side
    at = [
        (x * base, s * across + y)
        for s in range(flight.strips)
        for x in along
        for y in zones
        for _ in range(2)
    ]
    plan = np.array(at) + rng.normal(0, 0.03 * side, (len(at), 2))
    known_at = np.array(
        [
            (min(x, flight.models) * base, s * across + y)
            for s in range(flight.strips)
            for x in range(0, flight.models + control_every, control_every)
            for y in (zones[[0, 2]] if s == 0 else zones[2:])
        ]
    )
    plan = np.concatenate([known_at, plan])
    relief = np.sin(plan[:, 0] / 700) + np.cos(plan[:, 1] / 500)
    heights = flight.relief * relief + rng.normal(0, 5, len(plan))
    points = np.concatenate([plan, heights[:, None]], axis=1)

    photo, point, x, y = _places(flight, centres, rotations, points, base, across)
    x = x + rng.normal(0, flight.sigma, len(x))
    y = y + rng.normal(0, flight.sigma, len(y))
    names = tuple(f"c{k}" if k < len(known_at) else f"t{k}" for k in range(len(points)))
    known = points[: len(known_at)]
    known = known + rng.normal(0, control_sigma, known.shape)
    block = MeasuredBlock(
        photos=tuple(f"{s + 1}-{k + 1}" for s, k in zip(strip, place, strict=True)),
        points=names,
        photo=photo,
        point=point,
        x=x,
        y=y,
        sigma=np.full(len(x), flight.sigma),
        focal=np.full(photos, flight.focal),
    )
    control = ground(names[: len(known_at)], known, control_sigma)
    return MockBlock(block, control, Chained(rotations, centres), points)


def pairs_of(
    block: MeasuredBlock, seed: int = 0, fewest: int = FEWEST
) -> tuple[list[str], list[str], Ragged, list[str]]:
    """All pairs of photos with so many points in common, in random order and direction:
    what `measured_block.from_pairs` takes."""
    rng = np.random.default_rng(seed)
    common = common_points(block.photo, block.point, len(block.photos))
    order = rng.permutation(np.flatnonzero(common.counts >= fewest))
    chosen = common.take(order)
    turned = rng.random(len(order)) < 0.5
    swap = np.repeat(turned, chosen.counts)
    chosen = chosen._replace(
        left=np.where(turned, chosen.right, chosen.left),
        right=np.where(turned, chosen.left, chosen.right),
        one=np.where(swap, chosen.other, chosen.one),
        other=np.where(swap, chosen.one, chosen.other),
    )
    name = lambda numbers: [block.photos[k] for k in numbers]
    points = [block.points[k] for k in block.point[chosen.one]]
    return name(chosen.left), name(chosen.right), chosen.as_pairs(block), points


def _places(flight: Flight, centres, rotations, points, base, across):
    """Photo, point, x and y of all points on all photos that show them."""
    found, margin = [], flight.half_side * flight.height / flight.focal * 1.3
    order = np.argsort(points[:, 0], kind="stable")
    along = points[order, 0]
    for k, (centre, turn) in enumerate(zip(centres, rotations, strict=True)):
        first, last = np.searchsorted(along, [centre[0] - margin, centre[0] + margin])
        near = order[first:last]
        near = near[np.abs(points[near, 1] - centre[1]) < margin]
        inside = (points[near] - centre) @ turn.T
        place = flight.focal * inside[:, :2] / inside[:, 2:]
        seen = np.all(np.abs(place) < flight.half_side, axis=1) & (inside[:, 2] > 0)
        number = int(np.sum(seen))
        found.append((np.full(number, k), near[seen], place[seen, 0], -place[seen, 1]))
    return tuple(np.concatenate(a) for a in zip(*found, strict=True))


def _rotations(angles: Float[np.ndarray, "photo 3"]) -> Float[np.ndarray, "photo 3 3"]:
    """Object to camera of photos that look down: omega, phi, kappa."""
    c, s = np.cos(angles), np.sin(angles)
    one, zero = np.ones(len(angles)), np.zeros(len(angles))
    of = lambda *rows: np.moveaxis(np.array(rows), -1, 0)
    r1 = of([one, zero, zero], [zero, c[:, 0], s[:, 0]], [zero, -s[:, 0], c[:, 0]])
    r2 = of([c[:, 1], zero, -s[:, 1]], [zero, one, zero], [s[:, 1], zero, c[:, 1]])
    r3 = of([c[:, 2], s[:, 2], zero], [-s[:, 2], c[:, 2], zero], [zero, zero, one])
    return np.array([1.0, -1.0, -1.0])[:, None] * (r3 @ r2 @ r1)
