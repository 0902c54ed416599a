"""Approximate coordinates of the points of a network, step by step from those that are
known: a direction and a distance, two directions, heights and vectors.

A set of directions is oriented as soon as its station and one of its targets are known.
The first way to a point is taken; an adjustment needs no more.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from .geodetic import Measured

FLAT = 0.05
"""Sine of the angle between two directions below which they do not cut."""

Coordinates = Float[np.ndarray, "point 3"]


def complete(at: Coordinates, measured: Sequence[Measured]) -> Coordinates:
    """The coordinates, NaN where they are not known, with those that the measurements
    tell; NaN where they do not."""
    at = at.copy()
    before = -1
    while before != (before := int(np.sum(np.isnan(at)))):
        _complete_heights(at, measured)
        _complete_plan(at, measured)
    return at


def _each(
    measured: Sequence[Measured], *kinds: str
) -> Iterator[tuple[Measured, int, np.ndarray]]:
    """The measurements of some kinds: their part, their number in it, their points."""
    for part in measured:
        if part.kind in kinds:
            yield from ((part, k, ends) for k, ends in enumerate(part.at))


def _complete_heights(at: Coordinates, measured: Sequence[Measured]) -> None:
    """Differences of heights, vectors and zenith angles, from either end."""
    for part, k, (a, b) in _each(measured, "height", "vector", "zenith"):
        axes = [2] if part.kind != "vector" else [0, 1, 2]
        above = np.zeros(2) if part.above is None else part.above[k]
        rise = part.values[k].copy()
        if part.kind == "zenith":
            plan = np.hypot(*(at[b] - at[a])[:2])
            rise = plan / np.tan(rise)
        rise[-1] += above[0] - above[1]
        for axis, step in zip(axes, rise, strict=True):
            if np.isnan(at[b, axis]):
                at[b, axis] = at[a, axis] + step
            elif np.isnan(at[a, axis]):
                at[a, axis] = at[b, axis] - step


def _complete_plan(at: Coordinates, measured: Sequence[Measured]) -> None:
    """Polar points first, then cuts of two directions."""
    lengths = _lengths(measured)
    rays = list(_rays(at, measured))
    for a, b, t in rays:
        length = lengths.get(frozenset((a, b)))
        if length is not None and np.isnan(at[b, 0]):
            at[b, :2] = at[a, :2] + length * np.array([np.cos(t), np.sin(t)])
    for (a, b, t), (c, d, u) in itertools.combinations(rays, 2):
        if b == d and a != c and np.isnan(at[b, 0]) and abs(np.sin(u - t)) > FLAT:
            (x, y), (v, w) = at[c, :2] - at[a, :2], (np.cos(u), np.sin(u))
            length = (x * w - y * v) / np.sin(u - t)
            at[b, :2] = at[a, :2] + length * np.array([np.cos(t), np.sin(t)])


def _lengths(measured: Sequence[Measured]) -> dict[frozenset[int], float]:
    """Distances in plan between points; of slope distances by the zenith angle of their
    line, where there is one."""
    zeniths = {
        frozenset(ends.tolist()): float(part.values[k, 0])
        for part, k, ends in _each(measured, "zenith")
    }
    found = {}
    for part, k, ends in _each(measured, "slope", "distance"):
        line, length = frozenset(ends.tolist()), float(part.values[k, 0])
        if part.kind == "slope":
            length *= abs(np.sin(zeniths.get(line, np.pi / 2)))
        found[line] = length
    return found


def _rays(
    at: Coordinates, measured: Sequence[Measured]
) -> Iterator[tuple[int, int, float]]:
    """From known points a to others b: a, b and t(a, b)."""
    known = lambda *points: not np.any(np.isnan(at[list(points), :2]))
    towards = lambda a, b: float(np.arctan2(*(at[b] - at[a])[1::-1]))
    turns: dict[int, float] = {}
    sights = list(_each(measured, "direction"))
    for part, k, (a, b) in sights:
        if part.set is not None and known(a, b):
            turns.setdefault(int(part.set[k]), towards(a, b) - float(part.values[k, 0]))
    for part, k, (a, b) in sights:
        if part.set is not None and known(a) and int(part.set[k]) in turns:
            yield int(a), int(b), turns[int(part.set[k])] + float(part.values[k, 0])
    for part, k, (a, b) in _each(measured, "azimuth"):
        if known(a):
            yield int(a), int(b), float(part.values[k, 0])
    for part, k, (a, b, c) in _each(measured, "angle"):
        angle = float(part.values[k, 0])
        if known(a, b):
            yield int(a), int(c), towards(a, b) + angle
        elif known(a, c):
            yield int(a), int(b), towards(a, c) - angle
