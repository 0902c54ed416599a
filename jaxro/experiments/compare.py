"""What every procedure finds, and what it costs in good points, by simulation on a
layout.

A setting is a layout, a number of wrong points and the size of their errors. Each of
its trials has normal errors in all four coordinates and, at random points, errors of
that size (in sigma, of random sign) in the right-hand y. All procedures see the same
trials.

A procedure that rejects more finds more, so they are also compared where all reject as
often without cause: each whose level or tolerance can be set is set so that it spoils a
given share of pairs without errors.
"""

import itertools
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..batches.batch import clean_batch
from ..geometry.elements import RelativePose
from ..geometry.mock_pairs import draw_points, noisy, plant
from ..geometry.pairs import Pair, pad
from ..orientation.orient import orient
from ..rejection import AbstractProcedure
from ..xla.programs import compiled
from .calibration import Calibration, adjustable, calibrate, select, set_value

LEAST = 6
"""Good points that a pair has at least."""


class Setting(NamedTuple):
    """A layout by its name, a number of wrong points and the size of their errors
    (sigma; 0 where there are none)."""

    layout: str
    errors: int
    size: float


class Estimate(NamedTuple):
    """A mean over the trials and its standard error; NaN where there is nothing to
    average, or nothing to compare."""

    value: float
    error: float


@dataclass(frozen=True)
class Score:
    """The results of one procedure in one setting, as shares of 1.

    `calibrated`: whether the procedure is set to the common share of false alarms.
    `found`: wrong points rejected, of all wrong points. `misnamed`: pairs in which the
    first rejection takes a good point. `lost`: good points rejected. `perfect`: pairs
    left with all of their good points and no other. `alarms`: pairs that lost a good
    point; without errors, the false alarms. `unfinished`: pairs with another outcome
    than finished. `angle`: root mean square of the angle to the truth (arc minutes), of
    the rotation or the base, whichever is larger, over the pairs with a usable
    orientation.
    """

    setting: Setting
    procedure: str
    calibrated: bool
    trials: int
    found: Estimate
    misnamed: Estimate
    lost: Estimate
    perfect: Estimate
    alarms: Estimate
    unfinished: Estimate
    angle: Estimate


@dataclass(frozen=True)
class Comparison:
    """All scores, and how each procedure was set for the comparison at the share
    `false_alarms`, by layout."""

    scores: list[Score]
    false_alarms: float
    calibrations: dict[str, dict[str, Calibration]]


def compare(
    layouts: Mapping[str, Pair],
    procedures: Mapping[str, AbstractProcedure],
    *,
    errors: Sequence[int] = (0, 1, 2, 3),
    sizes: Sequence[float] = (4.0, 6.0, 10.0),
    trials: int = 200,
    seed: int = 0,
    false_alarms: float = 0.05,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Every procedure in every setting that leaves a layout `LEAST` good points.

    `layouts`: errorless pairs by name; their sigma is that of the simulated
    coordinates, known to the procedures. `false_alarms`: share of pairs without errors
    that the calibrated procedures spoil; 0 leaves that comparison out. `progress(done,
    total)` counts runs of a procedure.
    """
    settings = {
        layout: _settings(layout, int(exact.count) - LEAST, errors, sizes)
        for layout, exact in layouts.items()
    }
    settable = [
        name
        for name, procedure in procedures.items()
        if false_alarms and adjustable(procedure)
    ]
    total = len(layouts) * len(settable)
    total += sum(map(len, settings.values())) * (len(procedures) + len(settable))
    numbers = itertools.count(1)
    step = lambda: progress(next(numbers), total)
    # all layouts have places for as many points, so that they share their programs
    places = max(exact.mask.size for exact in layouts.values())

    scores: list[Score] = []
    calibrations: dict[str, dict[str, Calibration]] = {}
    for layout, exact in layouts.items():
        known = calibrations[layout] = {}
        if false_alarms:
            calm = Setting(layout, 0, 0.0)
            clean, _ = simulate(exact, calm, trials, seed, "calibration")
            clean = pad(clean, places)
            for name, procedure in procedures.items():
                known[name] = calibrate(procedure, clean, false_alarms)
                if name in settable:
                    step()
        versions = _versions(procedures, known, settable)
        for setting in settings[layout]:
            pairs, wrong = simulate(exact, setting, trials, seed)
            wrong = np.pad(wrong, ((0, 0), (0, places - wrong.shape[1])))
            trial = Trial(setting, pad(pairs, places), wrong, orient(exact).pose)
            scores += _score_versions(trial, versions, step)
    return Comparison(scores, false_alarms, calibrations)


def _settings(
    layout: str, most: int, errors: Sequence[int], sizes: Sequence[float]
) -> list[Setting]:
    """The settings of a layout with at most so many wrong points; where none is wrong
    there is no size."""
    settings = []
    for number in errors:
        if number <= most:
            kinds = sizes if number else (0.0,)
            settings += [Setting(layout, number, size) for size in kinds]
    return settings


class Version(NamedTuple):
    """A procedure as it is, or calibrated; None where that is not possible."""

    name: str
    calibrated: bool
    procedure: AbstractProcedure | None


def _versions(
    procedures: Mapping[str, AbstractProcedure],
    known: dict[str, Calibration],
    settable: list[str],
) -> list[Version]:
    """Every procedure as it is, and those that can be set also calibrated."""
    versions = []
    for name, procedure in procedures.items():
        field = adjustable(procedure)
        own = procedure
        if field is not None:  # by the program of the calibrated one
            own = set_value(procedure, field, getattr(procedure, field))
        versions.append(Version(name, False, own))
        if name in settable:
            versions.append(Version(name, True, known[name].procedure))
    return versions


class Trial(NamedTuple):
    """The simulated pairs of a setting, their wrong points, and the true pose."""

    setting: Setting
    pairs: Pair
    wrong: np.ndarray
    truth: RelativePose


def _score_versions(
    trial: Trial, versions: list[Version], step: Callable[[], None]
) -> list[Score]:
    """The scores in one setting of the versions that there are."""
    setting, pairs, wrong, truth = trial
    scores = []
    for name, calibrated, procedure in versions:
        if procedure is not None:
            found = _judge(procedure, pairs, wrong, truth)
            scores.append(Score(setting, name, calibrated, len(pairs.mask), **found))
        step()
    return scores


def simulate(
    exact: Pair, setting: Setting, trials: int, seed: int, use: str = ""
) -> tuple[Pair, np.ndarray]:
    """The trials of a setting and which points are wrong, (trial, point); the same
    whatever else is asked for."""
    name = f"{setting.layout} {setting.errors} {setting.size} {use}"
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode()))
    keys = jax.random.split(key, trials)
    pairs, wrong = _simulate(exact, keys, setting.errors, setting.size)
    return pairs, np.asarray(wrong)


@compiled
def _simulate(exact: Pair, keys: Array, errors: Array, size: Array):
    points = exact.mask.shape

    def measure(key):
        noise, place, sign = jax.random.split(key, 3)
        wrong = draw_points(place, exact.mask, errors)
        side = jnp.where(jax.random.bernoulli(sign, shape=points), 1.0, -1.0)
        measured = noisy(exact, noise, exact.sigma[None, :])
        error = jnp.where(wrong, side * size * exact.sigma, 0.0)
        return plant(measured, y_right=error), wrong

    return jax.vmap(measure)(keys)


def _judge(
    procedure: AbstractProcedure, pairs: Pair, wrong: np.ndarray, truth: RelativePose
) -> dict[str, Estimate]:
    """The estimates of a `Score`."""
    kept, order, pose, usable, finished = clean_batch(pairs, procedure, select=select)
    angle = np.asarray(_angles(truth, pose))
    mask = np.asarray(pairs.mask)
    out, good = mask & ~np.asarray(kept), mask & ~wrong
    first = np.asarray(order) == 1

    def share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
        number = np.sum(whole, axis=1)
        return np.sum(part, axis=1) / np.where(number > 0, number, np.nan)

    return {
        "found": estimate(share(out & wrong, wrong)),
        "misnamed": estimate(np.any(first & good, axis=1)),
        "lost": estimate(share(out & good, good)),
        "perfect": estimate(np.all(out == wrong, axis=1)),
        "alarms": estimate(np.any(out & good, axis=1)),
        "unfinished": estimate(~np.asarray(finished)),
        "angle": root_mean_square(angle[np.asarray(usable)]),
    }


@compiled
def _angles(truth: RelativePose, poses: RelativePose):
    """The larger of the angles between the rotations and between the bases, arc
    minutes: 2 asin(chord / 2)."""

    def squared_distance(one, other):
        pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
        return sum((a - b) ** 2 for a, b in pairs)

    def angle(pose):
        turn, chord = map(squared_distance, truth.relative(), pose.relative())
        # two rotations by an angle apart differ by sqrt(8) sin(angle / 2) in the
        # Frobenius norm
        half = jnp.sqrt(jnp.maximum(turn / 8, chord / 4))
        return jnp.rad2deg(2 * jnp.arcsin(jnp.minimum(half, 1.0))) * 60

    return jax.vmap(angle)(poses)


def estimate(values: np.ndarray) -> Estimate:
    """Mean and standard error of the trials in which the value exists."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    mean = error = math.nan
    if values.size:
        mean = float(np.mean(values))
    if values.size > 1:
        error = float(np.std(values, ddof=1) / math.sqrt(values.size))
    return Estimate(mean, error)


def root_mean_square(values: np.ndarray) -> Estimate:
    """sqrt of the mean square, and its standard error to first order."""
    square, error = estimate(np.square(values))
    root = math.sqrt(square)
    return Estimate(root, error / (2 * root) if root > 0 else error)
