"""The suites of simulated photographs and target fields: `Recommended` and its peers on
the same pairs."""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

import jaxro
from jaxro.orientation.results import is_usable
from jaxro.rejection import OUTCOMES, Recommended, Rejection

from . import scenes
from .common import Size
from .metrics import Metric
from .scenes import Scenes

WRONG = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
RIGHT = 5.0
"""Degrees: a pose farther from the truth, in rotation or base, is wrong."""
BELIEVED = 15
"""Inliers from which the answer of a peer is believed."""
LEVEL = 0.0025
"""Familywise level of `Recommended`: false alarms of a pair without wrong points."""


class Found(NamedTuple):
    """Answers to all pairs: poses, which are believed, the points kept, CPU seconds a
    pair."""

    rotation: NDArray[np.float64]
    base: NDArray[np.float64]
    claimed: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    seconds: float


Program = Callable[[Scenes], Found]


def _one_by_one(solve: Callable[..., tuple | None]) -> Program:
    """A peer as a program: `solve(left, right, focal)` gives R, t of x2 = R x1 + t and
    the inliers, or None.

    The peers' image vector is (x, y, f), ours (x, y, -f): both coordinates are negated.
    """

    def run(pairs: Scenes) -> Found:
        left, right = (
            -np.stack(side, axis=-1)
            for side in (pairs.coordinates[:2], pairs.coordinates[2:])
        )
        count, points = pairs.good.shape
        rotation, base = (
            np.tile(np.eye(3), (count, 1, 1)),
            np.tile([1.0, 0, 0], (count, 1)),
        )
        kept = np.zeros((count, points), bool)
        begin = time.process_time()
        answers = [
            solve(a[m], b[m], f)
            for a, b, m, f in zip(left, right, pairs.there, pairs.focal, strict=True)
        ]
        seconds = time.process_time() - begin
        for k, answer in enumerate(answers):
            if answer is not None:
                rotation[k] = np.array(answer[0]).T
                base[k] = rotation[k] @ np.array(
                    answer[1]
                )  # the station -Rᵀ t of negated space
                kept[k, pairs.there[k]] = answer[2]
        return Found(
            rotation, base, kept.sum(axis=1) >= BELIEVED, kept, seconds / count
        )

    return run


def poselib(**options: float) -> Program:
    """PoseLib's LO-RANSAC."""
    import poselib as peer

    def solve(left: NDArray, right: NDArray, focal: float) -> tuple:
        camera = peer.Camera("SIMPLE_PINHOLE", [focal, 0.0, 0.0], 1, 1)
        pose, told = peer.estimate_relative_pose(
            left, right, camera, camera, options, {}
        )
        return pose.R, pose.t, np.array(told["inliers"], bool)

    return _one_by_one(solve)


def pycolmap(max_error: float) -> Program:
    """COLMAP's LO-RANSAC of the essential matrix, one thread."""
    import pycolmap as peer

    options = peer.RANSACOptions(max_error=max_error, random_seed=0, num_threads=1)

    def solve(left: NDArray, right: NDArray, focal: float) -> tuple | None:
        camera = peer.Camera(
            model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0.0, 0.0]
        )
        found = peer.estimate_essential_matrix(left, right, camera, camera, options)
        if found is None:
            return None
        pose = found["cam2_from_cam1"]
        return (
            pose.rotation.matrix(),
            pose.translation,
            np.array(found["inlier_mask"], bool),
        )

    return _one_by_one(solve)


def opencv(threshold: float) -> Program:
    """OpenCV's USAC_DEFAULT of the essential matrix, decomposed."""
    import cv2

    cv2.setNumThreads(1)

    def solve(left: NDArray, right: NDArray, focal: float) -> tuple | None:
        k = np.diag([focal, focal, 1.0])
        e, mask = cv2.findEssentialMat(
            left, right, k, method=cv2.USAC_DEFAULT, prob=0.9999, threshold=threshold
        )
        if e is None or e.shape != (3, 3):
            return None
        _, rotation, t, _ = cv2.recoverPose(e, left, right, k, mask=mask.copy())
        return rotation, t.ravel(), mask.ravel().astype(bool)

    return _one_by_one(solve)


def read(rejection: Rejection) -> tuple:
    """What is judged of a rejection."""
    o = rejection.orientation
    return (
        o.pose.relative(),
        rejection.outcome._value,
        is_usable(o.result),
        rejection.mask,
    )


def pair_of(pairs: Scenes, factor: float = 1.0) -> jaxro.Pair:
    """The pairs with `factor` times their true standard deviation."""
    sigma = np.broadcast_to(factor * pairs.sigma[:, None], pairs.good.shape)
    return jaxro.pair(
        *pairs.coordinates, focal=pairs.focal, sigma=sigma, mask=pairs.there
    )


def recommended(factor: float = 1.0, procedure: Recommended | None = None) -> Program:
    """`Recommended`, given so many times the true sigma; compiled before it is
    timed."""
    rule = Recommended(level=LEVEL) if procedure is None else procedure

    def run(pairs: Scenes) -> Found:
        clean = partial(jaxro.clean_batch, pair_of(pairs, factor), rule, select=read)
        jax.block_until_ready(clean())
        begin = time.process_time()
        (rotation, base), outcome, usable, kept = jax.block_until_ready(clean())
        seconds = (time.process_time() - begin) / len(pairs.focal)
        believed = np.isin(
            np.asarray(outcome),
            [int(o._value) for o in (OUTCOMES.finished, OUTCOMES.undecided)],
        )
        claimed = np.asarray(usable) & believed
        turned = np.moveaxis(np.array(rotation), (0, 1), (-2, -1))
        return Found(
            turned,
            np.moveaxis(np.array(base), 0, -1),
            claimed,
            np.asarray(kept),
            seconds,
        )

    return run


def programs() -> dict[str, Program]:
    """Everybody who takes part. Where sigma can be left out, a line `recommended, sigma
    left out` is added here."""
    return {**own_programs(), **peer_programs()}


def own_programs() -> dict[str, Program]:
    """`Recommended` with sigma as it is, halved and four times too large."""
    names = {
        1.0: "recommended",
        0.5: "recommended, half of sigma",
        4.0: "recommended, four times sigma",
    }
    return {name: recommended(factor) for factor, name in names.items()}


def peer_programs() -> dict[str, Program]:
    """The peers, at limits of 1 and 2 px; PoseLib also with fewer iterations at
    least."""
    return {
        "PoseLib": poselib(max_epipolar_error=1.0),
        "PoseLib, 2 px": poselib(max_epipolar_error=2.0),
        "PoseLib, few iterations": poselib(max_epipolar_error=1.0, min_iterations=100),
        "pycolmap": pycolmap(1.0),
        "USAC_DEFAULT": opencv(1.0),
    }


def errors(found: Found, pairs: Scenes) -> NDArray[np.float64]:
    """Degrees: the larger angle of rotation and base from the truth."""
    turn = np.sum((found.rotation - pairs.rotation) ** 2, axis=(1, 2)) / 8
    chord = np.sum((found.base - pairs.base) ** 2, axis=1) / 4
    return np.rad2deg(2 * np.arcsin(np.sqrt(np.clip(np.fmax(turn, chord), 0, 1))))


def area(error: NDArray[np.float64], most: float) -> float:
    """Area under the curve (share of pairs within e degrees) up to `most`, of 1: the
    mean of 1 - e / most."""
    return float(np.mean(np.maximum(1 - error / most, 0)))


def judged(found: Found, pairs: Scenes) -> dict[str, float]:
    """The figures of one program on pairs with a common view. A refused pair counts as
    an infinite error."""
    error = errors(found, pairs)
    believed = np.where(found.claimed, error, np.inf)
    return {
        "right": float(np.mean(believed < RIGHT)),
        **{f"AUC at {most}°": area(believed, most) for most in (1, 5, 10)},
        "usable but wrong": float(np.mean(found.claimed & (error > RIGHT))),
        "refused": float(np.mean(~found.claimed)),
        "CPU": found.seconds,
    }


GOALS = {"usable but wrong": 0.01}


def _metrics(label: str, table: dict[str, dict[str, float]]) -> list[Metric]:
    """All figures; the goal of `recommended` is the best peer, its time a third of
    PoseLib's."""
    best = {
        key: max(
            row[key]
            for name, row in table.items()
            if not name.startswith("recommended")
        )
        for key in ("right", "AUC at 1°", "AUC at 5°")
    }
    metrics = []
    for name, row in table.items():
        for key, value in row.items():
            higher = key == "right" or key.startswith("AUC")
            goal = (best | GOALS).get(key) if name == "recommended" else None
            shown, unit = (
                (value * 1e3, "ms a pair") if key == "CPU" else (value, "of 1")
            )
            metrics.append(
                Metric(
                    f"{label}: {key}, {name}",
                    shown,
                    unit,
                    "higher" if higher else "lower",
                    0.1,
                    goal,
                )
            )
    if "recommended" in table:
        own, peer = table["recommended"]["CPU"], table["PoseLib"]["CPU"]
        metrics.append(
            Metric(
                f"{label}: CPU against PoseLib",
                own / peer,
                "times",
                "lower",
                0.5,
                1 / 3,
            )
        )
        spread = [
            row["AUC at 1°"]
            for name, row in table.items()
            if name.startswith("recommended")
        ]
        metrics.append(
            Metric(
                f"{label}: AUC at 1° by sigma",
                np.ptp(spread),
                "of 1",
                "lower",
                0.5,
                0.03,
            )
        )
    return metrics


def photos(size: Size, who: dict[str, Program] | None = None) -> list[Metric]:
    """Photographs by number of matches, share of wrong ones and kind of base; pairs
    without a common view."""
    who = programs() if who is None else who
    quick = size.robust == 1
    count = 8 if quick else 200
    metrics = []
    for points in (200,) if quick else (200, 1000):
        for wrong in (0.3, 0.8) if quick else WRONG:
            pairs = scenes.photographs(count, points, wrong)
            found = {name: program(pairs) for name, program in who.items()}
            label = f"photos, {points} matches, {wrong:.0%} wrong"
            metrics += _metrics(
                label, {name: judged(f, pairs) for name, f in found.items()}
            )
            for k, kind in enumerate(scenes.BASES):
                rows = slice(k, None, len(scenes.BASES))
                for name, f in found.items():
                    part = Found(
                        f.rotation[rows],
                        f.base[rows],
                        f.claimed[rows],
                        f.kept[rows],
                        0.0,
                    )
                    right = judged(part, pairs[rows])["right"]
                    metrics.append(
                        Metric(
                            f"{label}, {kind}: right, {name}",
                            right,
                            "of 1",
                            "higher",
                            0.1,
                        )
                    )
        nothing = scenes.photographs(count, points, 1.0, common=False)
        for name, program in who.items():
            goal = 0.02 if name == "recommended" else None
            claimed = float(np.mean(program(nothing).claimed))
            label = f"photos, {points} matches, no common view: claimed, {name}"
            metrics.append(Metric(label, claimed, "of 1", "lower", 0.5, goal))
    forward = scenes.photographs(8 if quick else 1000, 200, 0.3, "forward", seed=1)
    for name, program in who.items():
        found = program(forward)
        wrong_ones = float(np.sum(found.claimed & (errors(found, forward) > RIGHT)))
        goal = 0.0 if name == "recommended" else None
        metrics.append(
            Metric(
                f"photos forward, 30% wrong: usable and wrong, {name}",
                wrong_ones,
                "pairs",
                "lower",
                1,
                goal,
            )
        )
    return metrics


def any_position(size: Size, who: dict[str, Program] | None = None) -> list[Metric]:
    """Points in space, normal noise, partners anywhere: what share of the pairs is
    found."""
    who = programs() if who is None else who
    quick = size.robust == 1
    metrics = []
    for points in (200,) if quick else (200, 1000):
        for wrong, goal in ((0.7, 0.98), (0.8, 0.95), (0.9, 0.6)):
            pairs = scenes.any_position(8 if quick else 100, points, wrong)
            for name, program in who.items():
                row = judged(program(pairs), pairs)
                label = f"any position, {points} matches, {wrong:.0%} wrong"
                own = goal if name == "recommended" else None
                metrics += [
                    Metric(
                        f"{label}: right, {name}",
                        row["right"],
                        "of 1",
                        "higher",
                        0.1,
                        own,
                    ),
                    Metric(
                        f"{label}: usable but wrong, {name}",
                        row["usable but wrong"],
                        "of 1",
                        "lower",
                        0.5,
                    ),
                    Metric(
                        f"{label}: CPU, {name}",
                        row["CPU"] * 1e3,
                        "ms a pair",
                        "lower",
                        0.5,
                    ),
                ]
    return metrics


def target_fields(size: Size) -> list[Metric]:
    """Target fields without a wrong point: nothing may be rejected but false alarms, no
    pose may be far off."""
    pairs = scenes.target_fields(48 if size.robust == 1 else 5000)
    found = recommended()(pairs)
    error = errors(found, pairs)
    rejected = np.sum(pairs.there & ~found.kept, axis=1)
    fine = found.claimed & (rejected <= 1)
    alarms = float(np.mean(found.claimed & (rejected > 0)))
    far = float(np.sum(found.claimed & (error > 1)))
    return [
        Metric(
            "target fields: finished and off by more than 1°",
            far,
            "pairs",
            "lower",
            1,
            0,
        ),
        Metric(
            "target fields: finished, no more than one rejected",
            float(np.mean(fine)),
            "of 1",
            "higher",
            0.02,
            0.97,
        ),
        Metric(
            "target fields: false alarms",
            alarms,
            "a pair",
            "lower",
            0.5,
            LEVEL + 0.0008,
        ),
        Metric("target fields: CPU", found.seconds * 1e3, "ms a pair", "lower", 0.5),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    "photos": photos,
    "scattered": any_position,
    "target_fields": target_fields,
}
