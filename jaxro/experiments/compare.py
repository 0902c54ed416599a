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

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..batches.batch import clean_batch
from ..geometry.elements import RelativePose
from ..geometry.mock_pairs import noisy, plant
from ..geometry.pairs import Pair
from ..orientation.orient import orient
from ..orientation.results import is_usable
from ..rejection import OUTCOMES, AbstractProcedure, Rejection
from ..xla.programs import Program
from ..xla.settings import COMPILE_FAST
from .calibration import Calibration, adjustable, calibrated

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
    """What one procedure did in one setting; shares are of 1.

    `found`: wrong points named, the probability that a wrong point is rejected.
    `misnamed`: pairs in which the first rejection takes a good point. `lost`: good
    points rejected. `perfect`: pairs named exactly, that is, left with all of their
    good points and no other. `alarms`: pairs that lost a good point; without errors,
    the false alarms. `unfinished`: pairs with another outcome than finished. `angle`:
    root mean square of the angle to the truth (arc minutes), of the rotation or the
    base, whichever is larger, over the pairs with a usable orientation. `calibrated`:
    at the common share of false alarms.
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
    sizes: Sequence[float] = (4.0, 6.0, 8.0, 10.0, 15.0),
    trials: int = 1000,
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
    settable = [
        name
        for name, procedure in procedures.items()
        if false_alarms and adjustable(procedure)
    ]
    kinds = [(n, s) for n in errors for s in (sizes if n else (0.0,))]
    possible = {
        name: [kind for kind in kinds if kind[0] <= int(exact.count) - LEAST]
        for name, exact in layouts.items()
    }
    runs = sum(map(len, possible.values()))
    total = len(layouts) * len(settable) + runs * (len(procedures) + len(settable))
    done = 0

    def step(count: int = 1) -> None:
        nonlocal done
        done += count
        progress(done, total)

    scores: list[Score] = []
    calibrations: dict[str, dict[str, Calibration]] = {}
    for layout, exact in layouts.items():
        truth = orient(exact).pose
        known = calibrations.setdefault(layout, {})
        if false_alarms:
            clean, _ = simulated(
                exact, Setting(layout, 0, 0.0), trials, seed, "calibration"
            )
            for name, procedure in procedures.items():
                known[name] = calibrated(procedure, clean, false_alarms)
                step(name in settable)
        tuned = {
            name: c.procedure for name, c in known.items() if c.procedure is not None
        }
        for kind in possible[layout]:
            setting = Setting(layout, *kind)
            pairs, wrong = simulated(exact, setting, trials, seed)
            for name in procedures:
                for procedure, own in (
                    (procedures[name], False),
                    (tuned.get(name), True),
                ):
                    if procedure is not None:
                        scores.append(
                            Score(
                                setting,
                                name,
                                own,
                                trials,
                                *_judged(procedure, pairs, wrong, truth),
                            )
                        )
                    step(not own or name in settable)
    return Comparison(scores, false_alarms, calibrations)


def simulated(
    exact: Pair, setting: Setting, trials: int, seed: int, use: str = ""
) -> tuple[Pair, np.ndarray]:
    """The trials of a setting and which points are wrong, (trial, point); the same
    whatever else is asked for."""
    place = zlib.crc32(
        f"{setting.layout} {setting.errors} {setting.size} {use}".encode()
    )
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), place), trials)
    pairs, wrong = Program(_simulated, {}, COMPILE_FAST)(
        (exact, keys, jnp.asarray(setting.errors), jnp.asarray(setting.size))
    )
    return pairs, np.asarray(wrong)


def _simulated(plan: tuple):
    exact, keys, errors, size = plan

    def one(key):
        noise, place, sign = jax.random.split(key, 3)
        chance = jnp.where(
            exact.mask, jax.random.uniform(place, exact.mask.shape, float), 2.0
        )
        wrong = (jnp.argsort(jnp.argsort(chance)) < errors) & exact.mask
        side = jnp.where(jax.random.bernoulli(sign, shape=wrong.shape), 1.0, -1.0)
        measured = noisy(exact, noise, exact.sigma[None, :])
        return plant(
            measured, y_right=jnp.where(wrong, side * size * exact.sigma, 0.0)
        ), wrong

    return jax.vmap(one)(keys)


def _judged(
    procedure: AbstractProcedure, pairs: Pair, wrong: np.ndarray, truth: RelativePose
) -> tuple[Estimate, ...]:
    """The estimates of a `Score`, in its order."""
    kept, order, pose, usable, finished = clean_batch(pairs, procedure, select=_seen)
    angle, usable = (
        np.asarray(Program(_angles, {}, COMPILE_FAST)((truth, pose))),
        np.asarray(usable),
    )
    out = np.asarray(pairs.mask & ~kept)
    good = np.asarray(pairs.mask) & ~wrong
    share = lambda part, whole: (
        np.sum(part, axis=1)
        / np.where(np.any(whole, axis=1), np.sum(whole, axis=1), np.nan)
    )
    return (
        estimate(share(out & wrong, wrong)),
        estimate(np.any((np.asarray(order) == 1) & good, axis=1)),
        estimate(share(out & good, good)),
        estimate(np.all(out == wrong, axis=1)),
        estimate(np.any(out & good, axis=1)),
        estimate(~np.asarray(finished)),
        root_mean_square(angle[usable]),
    )


def _seen(found: Rejection):
    o = found.orientation
    return (
        found.mask,
        found.order,
        o.pose,
        is_usable(o.result),
        found.outcome == OUTCOMES.finished,
    )


def _angles(truth_and_poses: tuple[RelativePose, RelativePose]):
    """The larger of the angles between the rotations and between the bases, arc
    minutes: 2 asin(chord / 2)."""
    truth, poses = truth_and_poses
    rotation, base = truth.relative()

    def one(pose):
        other, direction = pose.relative()
        turn = sum(
            (a - b) ** 2
            for p, q in zip(rotation, other, strict=True)
            for a, b in zip(p, q, strict=True)
        )
        chord = sum((a - b) ** 2 for a, b in zip(base, direction, strict=True))
        # two rotations by an angle apart differ by sqrt(8) sin(angle / 2) in the
        # Frobenius norm
        half = jnp.sqrt(jnp.maximum(turn / 8, chord / 4))
        return jnp.rad2deg(2 * jnp.arcsin(jnp.minimum(half, 1.0))) * 60

    return jax.vmap(one)(poses)


def estimate(values: np.ndarray) -> Estimate:
    """Mean and standard error of the trials in which the value exists."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    mean = float(np.mean(values)) if values.size else math.nan
    error = (
        float(np.std(values, ddof=1) / math.sqrt(values.size))
        if values.size > 1
        else math.nan
    )
    return Estimate(mean, error)


def root_mean_square(values: np.ndarray) -> Estimate:
    """sqrt of the mean square, and its standard error to first order."""
    square, error = estimate(np.square(values))
    root = math.sqrt(square)
    return Estimate(root, error / (2 * root) if root > 0 else error)
