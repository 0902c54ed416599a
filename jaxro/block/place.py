"""A chained block on the ground, by three-point consensus, or where fewer than three
points have all coordinates by all coordinates that are known (`absolute`).

Known stations count as known points. Three known points determine a similarity; the one
with the smallest sum of the roots of all distances is taken, which one wrong point
hardly changes. Known points that do not fit it at all have wrong coordinates, or the
name of another point: after an adjustment, which bends the block to them, no test would
name them.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from . import absolute
from .absolute_model import model as measured_model
from .absolute_verdict import RESULTS, advice_of
from .chain import Chained, intersect
from .measured_block import Ground, MeasuredBlock

MOST_TRIPLES = 2000
"""Triples of known points that are tried; of more points some at random."""

FAR = 8.0
"""Known points this many times farther from their neighbours' misfits than the median
are named."""

NEIGHBOURS = 6
"""Known points that one is compared with."""


WIDE = 5.0
"""Root mean square distance of known points from a line, in their standard deviations,
from which on they are not on it."""


class Placed(NamedTuple):
    """Where a block stands on the ground, shift + scale rotation x; how far each known
    point is from there (NaN: not compared); and those that do not fit (`wrong`): they
    have wrong coordinates, another point's name, or a wrong place on a photo."""

    rotation: Float[np.ndarray, "3 3"]
    scale: float
    shift: Float[np.ndarray, "3"]
    apart: Float[np.ndarray, " known"]
    wrong: Bool[np.ndarray, " known"]


class TooLittleControl(ValueError):
    """Known coordinates that do not place a block: too few, on one line, with two
    positions that both fit, or hardly one that fits the photos."""


def place(
    block: MeasuredBlock, chained: Chained, ground: Ground, seed: int = 0
) -> Placed:
    """The similarity that takes a chained block to its known points. Raises
    `TooLittleControl`."""
    return place_known(known_in_chain(block, chained, ground), ground, seed)


def place_known(
    model: Float[np.ndarray, "known 3"], ground: Ground, seed: int = 0
) -> Placed:
    """The same from where the known points are in the chained block."""
    at = np.where(ground.check[:, None], np.nan, ground.coordinates)
    whole = np.flatnonzero(np.all(np.isfinite(model) & np.isfinite(at), axis=1))
    if len(whole) < 3:
        return _by_all_coordinates(model, at)
    triples = _triples(whole, seed)
    rotation, scale, shift = similarities(model[triples], at[triples])
    moved = scale[:, None, None] * np.einsum("tij,kj->tki", rotation, model)
    apart = moved + shift[:, None] - at[None]
    known = np.any(np.isfinite(apart), axis=2)
    distance = np.sqrt(np.nansum(apart**2, axis=2))
    distance = np.where(known, distance, np.nan)
    # the sum of roots: many points that fit well count more than few that do not
    roots = np.sum(np.sqrt(distance[:, whole]), axis=1)
    roots = np.where(np.isfinite(roots), roots, np.inf)
    best = int(np.argmin(roots))
    if not np.isfinite(roots[best]) or _is_line(at[whole], ground.sigma[whole]):
        raise TooLittleControl(
            "the known points lie on one line, about which the block can turn; one "
            "point away from it is needed"
        )
    wrong = np.zeros(len(known[best]), bool)
    if len(whole) > 4:
        wrong[whole] = _stands_out(model[whole], apart[best, whole])
    used = whole[~wrong[whole]]
    (rotation,), (scale,), (shift,) = similarities(model[used][None], at[used][None])
    fitted = shift + scale * model @ rotation.T - at
    left = np.sqrt(np.nansum(fitted**2, axis=1))
    return Placed(
        rotation=rotation,
        scale=float(scale),
        shift=shift,
        apart=np.where(known[best], left, np.nan),
        wrong=wrong,
    )


def known_in_chain(
    block: MeasuredBlock, chained: Chained, ground: Ground
) -> Float[np.ndarray, "known 3"]:
    """Where the known points and stations are in a chained block, NaN where it has not
    got them."""
    number = ground.numbers_in(block)
    there = np.maximum(number, 0)
    points = intersect(block, chained)[np.where(ground.station, 0, there)]
    stations = chained.centres[np.where(ground.station, there, 0)]
    model = np.where(ground.station[:, None], stations, points)
    return np.where((number >= 0)[:, None], model, np.nan)


def _by_all_coordinates(
    model: Float[np.ndarray, "known 3"], at: Float[np.ndarray, "known 3"]
) -> Placed:
    """The similarity for all known coordinates at once, from points known in plan, in
    height or in both; none is called wrong."""
    there = np.all(np.isfinite(model), axis=1) & np.any(np.isfinite(at), axis=1)
    if not np.any(there):
        raise TooLittleControl("no known point is on two photos or more")
    found = absolute.orient_model(measured_model(model[there], at[there]))
    if bool(found.result == RESULTS.two_solutions):
        raise TooLittleControl(
            "The known coordinates fit the block in two positions equally well. Measure "
            "a further one."
        )
    if not bool(found.usable):
        raise TooLittleControl(advice_of(found.result, np.asarray(found.missing)))
    placed = float(found.scale) * model @ np.asarray(found.rotation).T
    apart = np.sqrt(np.nansum((placed + np.asarray(found.shift) - at) ** 2, axis=1))
    return Placed(
        rotation=np.asarray(found.rotation),
        scale=float(found.scale),
        shift=np.asarray(found.shift),
        apart=np.where(there, apart, np.nan),
        wrong=np.zeros(len(at), bool),
    )


def _is_line(
    at: Float[np.ndarray, "some 3"], sigma: Float[np.ndarray, "some 3"]
) -> bool:
    """Whether points are as near to a line as their errors allow."""
    axes = np.linalg.svd(at - at.mean(axis=0), compute_uv=False)
    return bool(axes[1] < WIDE * np.median(sigma) * np.sqrt(len(at)))


def _stands_out(
    model: Float[np.ndarray, "some 3"], apart: Float[np.ndarray, "some 3"]
) -> Bool[np.ndarray, " some"]:
    """Points whose misfit is not that of their neighbours: a long strip bends, and its
    misfits change slowly along it."""
    away = np.linalg.norm(model[:, None] - model[None], axis=2)
    np.fill_diagonal(away, np.inf)
    beside = np.argsort(away, axis=1)[:, :NEIGHBOURS]
    of_others = np.median(apart[beside], axis=1)
    left = np.linalg.norm(apart - of_others, axis=1)
    return left > FAR * np.median(left)


def on_ground(chained: Chained, placed: Placed) -> Chained:
    """The chained photos in ground coordinates."""
    turn = placed.rotation.T
    centres = placed.shift + placed.scale * chained.centres @ turn
    return Chained(chained.rotations @ turn, centres)


def _triples(whole: np.ndarray, seed: int) -> np.ndarray:
    """Three points each, all of them or some at random."""
    n = len(whole)
    if n * (n - 1) * (n - 2) // 6 <= MOST_TRIPLES:
        return whole[np.array(list(combinations(range(n), 3)))]
    rng = np.random.default_rng(seed)
    keys = rng.random((MOST_TRIPLES, n))
    return whole[np.argpartition(keys, 3, axis=1)[:, :3]]


def similarities(
    model: Float[np.ndarray, "t k 3"], at: Float[np.ndarray, "t k 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, scale and shift of each set of points by least squares (Umeyama 1991);
    NaN where they lie on one line."""
    from_middle, to_middle = model.mean(axis=1), at.mean(axis=1)
    a, b = model - from_middle[:, None], at - to_middle[:, None]
    u, s, v = np.linalg.svd(np.einsum("tki,tkj->tij", b, a))
    sign = np.sign(np.linalg.det(u @ v))
    s[:, 2] *= sign
    u[:, :, 2] *= sign[:, None]
    rotation = u @ v
    scale = np.sum(s, axis=1) / np.sum(a**2, axis=(1, 2))
    # widths squared: a strip may be ten thousand times as long as it is wide
    scale = np.where(s[:, 1] > 1e-9 * s[:, 0], scale, np.nan)
    shift = to_middle - scale[:, None] * np.einsum("tij,tj->ti", rotation, from_middle)
    return rotation, scale, shift
