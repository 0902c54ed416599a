"""Approximate coordinates of the points of a network, step by step from those that are
known: a direction and a distance, two directions, heights and vectors.

A set of directions is oriented as soon as its station and one of its targets are known.
The first way to a point is taken; an adjustment needs no more.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .geodetic import KINDS, Measured

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


class _Single(NamedTuple):
    """One measurement: its kind, points and numbers, the heights of instrument and
    targets, and its set."""

    kind: str
    at: Int[np.ndarray, " ends"]
    values: Float[np.ndarray, " m"]
    above: Float[np.ndarray, " ends"]
    set: int | None


def _each(measured: Sequence[Measured], *kinds: str) -> Iterator[_Single]:
    """The measurements of some kinds, one by one."""
    for part in measured:
        if part.kind not in kinds:
            continue
        kind = KINDS[part.kind]
        above = np.zeros(part.at.shape) if part.above is None else part.above
        for k, points in enumerate(part.at):
            ends = points.reshape(-1, kind.ends)
            own = zip(
                ends,
                part.values[k].reshape(len(ends), -1),
                above[k].reshape(ends.shape),
                strict=True,
            )
            number = None if part.set is None else int(part.set[k])
            yield from (_Single(part.kind, *one, number) for one in own)


def _complete_heights(at: Coordinates, measured: Sequence[Measured]) -> None:
    """Differences of heights, vectors and zenith angles, from either end."""
    for one in _each(measured, "height", "vector", "zenith"):
        a, b = one.at
        axes = [2] if one.kind != "vector" else [0, 1, 2]
        rise = one.values.copy()
        if one.kind == "zenith":
            plan = np.hypot(*(at[b] - at[a])[:2])
            rise = plan / np.tan(rise)
        rise[-1] += one.above[0] - one.above[1]
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
    to_unknown: dict[int, list[tuple[int, float]]] = {}
    for a, b, t in rays:
        if np.isnan(at[b, 0]):
            to_unknown.setdefault(b, []).append((a, t))
    for b, from_known in to_unknown.items():
        for (a, t), (c, u) in itertools.combinations(from_known, 2):
            if a != c and abs(np.sin(u - t)) > FLAT:
                (x, y), (v, w) = at[c, :2] - at[a, :2], (np.cos(u), np.sin(u))
                length = (x * w - y * v) / np.sin(u - t)
                at[b, :2] = at[a, :2] + length * np.array([np.cos(t), np.sin(t)])
                break


def _lengths(measured: Sequence[Measured]) -> dict[frozenset[int], float]:
    """Distances in plan between points; of slope distances by the zenith angle of their
    line, where there is one."""
    zeniths = {
        frozenset(one.at.tolist()): float(one.values[0])
        for one in _each(measured, "zenith")
    }
    found = {}
    for one in _each(measured, "slope", "distance"):
        line, length = frozenset(one.at.tolist()), float(one.values[0])
        if one.kind == "slope":
            length *= abs(np.sin(zeniths.get(line, np.pi / 2)))
        found[line] = length
    return found


def _rays(
    at: Coordinates, measured: Sequence[Measured]
) -> Iterator[tuple[int, int, float]]:
    """From known points a to others b: a, b and t(a, b)."""
    known = lambda *points: not np.any(np.isnan(at[list(points), :2]))
    towards = lambda a, b: float(np.arctan2(*(at[b] - at[a])[1::-1]))
    turns: dict[int | None, float] = {}
    sights = [one for one in _each(measured, "direction") if one.set is not None]
    for _, (a, b), (value,), _, number in sights:
        if known(a, b):
            turns.setdefault(number, towards(a, b) - value)
    for _, (a, b), (value,), _, number in sights:
        if known(a) and number in turns:
            yield int(a), int(b), turns[number] + value
    for _, (a, b), (value,), *_ in _each(measured, "azimuth"):
        if known(a):
            yield int(a), int(b), value
    for _, (a, b, c), (value,), *_ in _each(measured, "angle"):
        if known(a, b):
            yield int(a), int(c), towards(a, b) + value
        elif known(a, c):
            yield int(a), int(b), towards(a, c) - value
