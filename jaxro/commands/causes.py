"""What makes a pair wrong as a whole, told before its orientation is believed: one photo
mirrored, a focal length in another unit, an origin in a corner, an absurd sigma0."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from ..batches.buckets import choose, rows_of
from ..batches.padding import Plan
from ..batches.ragged import Ragged
from ..orientation import axes
from ..orientation.results import RESULTS
from ..rejection import OUTCOMES
from ..reports.columns import is_usable
from ..reports.model import MOST_PAIRS
from .solve import Found, Task, hide, solve

NEAR = 10.0
"""Distance from the orientation, in m_q, of rejected points that may have been rejected
because they lie behind a photo."""

NO_MIRROR = (RESULTS.zero_base, RESULTS.too_few_points, RESULTS.non_finite_input)
"""Results that say more than that one photo might be mirrored. The mirror image of photos
that only turn fits photos of a plane from both its sides."""


def name_causes(pairs: Ragged, found: Found, task: Task, plan: Plan | None) -> Found:
    """What is found of the pairs, where no camera sees such coordinates, or one photo is
    mirrored, with the result that says so; of the first MOST_PAIRS that are in
    doubt."""
    named = {k: RESULTS.out_of_field for k in _find_no_lens(pairs)}
    doubtful = [k for k in _find_doubtful(pairs, found) if k not in named]
    if doubtful:
        chosen = np.array(doubtful[:MOST_PAIRS])
        mirrored = _find_mirrored(pairs, found, task, plan, chosen)
        named |= dict.fromkeys(mirrored, RESULTS.mirrored)
    if not named:
        return found
    result = np.array(found.of_pairs["result"])
    result[list(named)] = [int(each._value) for each in named.values()]
    of_pairs = found.of_pairs | {"result": result}
    of_pairs, of_points = hide(of_pairs, found.of_points, pairs, task)
    found = found._replace(of_pairs=of_pairs, of_points=of_points)
    return _accuse_nobody(found, pairs, list(named))


def _accuse_nobody(found: Found, pairs: Ragged, named: list[int]) -> Found:
    """What is found, without a point of the named pairs rejected or doubted: the pairs
    are wrong as a whole."""
    if found.outcome is None or found.decided is None:
        return found
    outcome = np.array(found.outcome)
    outcome[named] = int(OUTCOMES.not_oriented._value)
    own = np.isin(np.arange(len(pairs.lengths)), named)
    own = np.repeat(own, pairs.lengths) & pairs.mask
    innocent = {
        "kept": True,
        "in_use": True,
        "order": 0,
        "statistic": 0.0,
        "undecided": False,
        "unchecked": False,
        "rivals": False,
    }

    def put(a: np.ndarray, value: float) -> np.ndarray:
        a = np.array(a)
        a[own] = value
        return a

    decided = {n: put(found.decided[n], v) for n, v in innocent.items()}
    return found._replace(outcome=outcome, decided=found.decided | decided)


def tell_causes(
    pairs: Ragged, of_pairs: dict[str, Any], sigma_known: bool, unit: str
) -> dict[int, list[str]]:
    """Sentences about units, origin and sigma0 by the numbers of the pairs."""
    told = {}
    for k in _find_strange(pairs, of_pairs, sigma_known):
        photos, focals = _photos(pairs, k)
        sides = zip(("left", "right"), photos, focals, strict=True)
        fields = {side: axes.tell_field(p, f) for side, p, f in sides}
        said = [f"{side} photo: {text}" for side, text in fields.items() if text]
        sigma = _sigma(pairs, k)
        about = (
            axes.tell_origin(*photos),
            axes.tell_sigma0(
                float(of_pairs["sigma0"][k]) * sigma,
                int(of_pairs["degrees_of_freedom"][k]),
                min(focals),
                sigma if sigma_known else None,
                unit,
            ),
        )
        said += [text for text in about if text]
        if said:
            told[k] = said
    return told


def _photos(pairs: Ragged, k: int) -> tuple[tuple, tuple[float, float]]:
    """The coordinates of the points of a pair on both photos, and the focal lengths."""
    own = slice(*pairs.begins[k : k + 2])
    there = pairs.mask[own]
    stacked = lambda x, y: np.stack([x[own][there], y[own][there]], axis=1)
    left = stacked(pairs.x_left, pairs.y_left)
    right = stacked(pairs.x_right, pairs.y_right)
    return (left, right), (float(pairs.focal_left[k]), float(pairs.focal_right[k]))


def _sigma(pairs: Ragged, k: int) -> float:
    """Root mean square of the sigmas of a pair."""
    own = slice(*pairs.begins[k : k + 2])
    there = pairs.sigma[own][pairs.mask[own]]
    return float(np.sqrt(np.mean(there**2))) if there.size else 1.0


def _reach(pairs: Ragged) -> np.ndarray:
    """The largest distance of a point of each pair from a principal point, in focal
    lengths."""
    of_rows = lambda focal: np.repeat(focal, pairs.lengths)
    left = np.hypot(pairs.x_left, pairs.y_left) / of_rows(pairs.focal_left)
    right = np.hypot(pairs.x_right, pairs.y_right) / of_rows(pairs.focal_right)
    farther = np.where(pairs.mask, np.fmax(left, right), 0.0)
    return np.fmax.reduceat(farther, pairs.begins[:-1])


def _find_no_lens(pairs: Ragged) -> list[int]:
    """The pairs with points that no camera sees."""
    far = np.flatnonzero(_reach(pairs) > axes.NO_LENS)
    return [k for k in far.tolist() if any(map(axes.is_no_lens, *_photos(pairs, k)))]


def _find_strange(
    pairs: Ragged, of_pairs: dict[str, Any], sigma_known: bool
) -> list[int]:
    """The pairs of which there may be something to tell: a sieve, as most have
    nothing."""
    reach = _reach(pairs)
    wide = reach > np.tan(np.radians(axes.WIDEST))
    narrow = reach < np.tan(np.radians(axes.NARROWEST))
    least_x = np.where(pairs.mask, np.fmin(pairs.x_left, pairs.x_right), np.inf)
    one_side = np.fmin.reduceat(least_x, pairs.begins[:-1]) > 0
    squares = np.where(pairs.mask, pairs.sigma**2, 0.0)
    number = np.maximum(np.add.reduceat(pairs.mask.astype(int), pairs.begins[:-1]), 1)
    sigma = np.sqrt(np.add.reduceat(squares, pairs.begins[:-1]) / number)
    ratio = np.asarray(of_pairs["sigma0"])
    focal = np.minimum(pairs.focal_left, pairs.focal_right)
    misfit = ratio * sigma > axes.ABSURD * focal
    if sigma_known:
        misfit |= (ratio > axes.OFF) | (ratio * axes.OFF < 1)
    return np.flatnonzero(wide | narrow | one_side | misfit).tolist()


def _find_doubtful(pairs: Ragged, found: Found) -> list[int]:
    """The pairs that may have a mirrored photo: those without a usable result, and those
    of which points were rejected though their rays nearly meet."""
    result = found.of_pairs["result"]
    doubtful = ~is_usable(result)
    if found.outcome is not None and found.decided is not None:
        doubtful |= found.outcome != int(OUTCOMES.finished._value)
        q, m_q = found.of_points["residuals"]["q"], found.of_pairs["m_q"]
        near = np.abs(q) < NEAR * np.repeat(m_q, pairs.lengths)
        rejected = near & pairs.mask & ~found.decided["kept"]
        number = np.add.reduceat(rejected.astype(int), pairs.begins[:-1])
        doubtful |= number >= np.maximum(axes.LEAST_MORE, 0.1 * pairs.lengths)
    told = np.isin(result, [int(each._value) for each in NO_MIRROR])
    return np.flatnonzero(doubtful & ~told).tolist()


def _find_mirrored(
    pairs: Ragged,
    found: Found,
    task: Task,
    plan: Plan | None,
    chosen: Int[np.ndarray, " some"],
) -> list[int]:
    """Those of the chosen pairs that fit with their right photo mirrored."""
    some = choose(pairs, chosen, rows_of(pairs, chosen))
    image = mirror(some)
    if "residuals" in task.tables:
        before = _found_of(pairs, found, chosen)
    else:  # which tell what lies behind a photo
        task = dataclasses.replace(task, tables=(*task.tables, "residuals"))
        before = solve(some, task, plan)
    again = solve(image, task, plan)

    def is_one(k: int) -> bool:
        (left, right), focals = _photos(some, k)
        given, mirrored = _fit(some, before, k), _fit(image, again, k)
        if not axes.is_mirrored(given, mirrored, len(left), min(focals)):
            return False
        kept = _kept(image, again, k)
        # few residuals may be small by chance
        sigma = _sigma(image, k) if task.sigma_known else 0.0
        noise = max(mirrored.sigma0, sigma)
        return not axes.lie_in_plane(left[kept], right[kept], noise)

    return [int(k) for place, k in enumerate(chosen) if is_one(place)]


def _found_of(pairs: Ragged, found: Found, chosen: Int[np.ndarray, " some"]) -> Found:
    """What is found of the chosen pairs."""
    of_chosen = lambda a: np.asarray(a)[chosen]
    rows = np.concatenate(rows_of(pairs, chosen))
    return found._replace(
        of_pairs=jax.tree.map(of_chosen, found.of_pairs),
        of_points=jax.tree.map(lambda a: np.asarray(a)[rows], found.of_points),
        outcome=None if found.outcome is None else of_chosen(found.outcome),
        decided=found.decided
        and {name: np.asarray(a)[rows] for name, a in found.decided.items()},
        rivals=jax.tree.map(of_chosen, found.rivals),
    )


def mirror(pairs: Ragged) -> Ragged:
    """The pairs with their right photos mirrored: y counts the other way."""
    roots = pairs.roots
    if roots is not None:
        # the root of a mirrored covariance has the other sign where x and y mix
        roots = roots._replace(yx_right=-roots.yx_right)
    return pairs._replace(y_right=-pairs.y_right, roots=roots)


def _kept(pairs: Ragged, found: Found, k: int) -> np.ndarray:
    """Which of the points of a pair that take part are kept."""
    own = slice(*pairs.begins[k : k + 2])
    kept = pairs.mask if found.decided is None else found.decided["kept"]
    return np.asarray(kept)[own][pairs.mask[own]]


def _fit(pairs: Ragged, found: Found, k: int) -> axes.Fit:
    """How well a pair came out."""
    own = slice(*pairs.begins[k : k + 2])
    usable = bool(is_usable(found.of_pairs["result"][k : k + 1])[0])
    kept = _kept(pairs, found, k)
    shown = found.of_points["residuals"]["in_front"][own][pairs.mask[own]]
    finished = found.outcome is None or (
        int(found.outcome[k]) == int(OUTCOMES.finished._value)
    )
    return axes.Fit(
        usable=usable and finished,
        points=int(kept.sum()),
        in_front=int(np.sum(kept & (shown == 1))),
        sigma0=float(found.of_pairs["sigma0"][k]) * _sigma(pairs, k),
    )
