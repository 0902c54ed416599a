"""The suites of the rejection procedures: omissions, wrong points in many pairs, all
procedures in one mock_pairs."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import jaxro
from jaxro.adjustment import critical_values
from jaxro.experiments.compare import Setting, simulate
from jaxro.geometry import coplanarity, mock_pairs
from jaxro.orientation import starts
from jaxro.rejection import PROCEDURES, Recommended, leave_one_out_grubbs as grubbs

from . import peers
from .common import Poses, Size, pair_of, pose, poses, rate, ratio, ready, share
from .metrics import Metric, median_seconds
from .workload import aerial, any_position, with_wrong_points

SIGMA = 0.01
"""mm, of every coordinate."""

EXACT = 1e-8
"""mm: a millionth of that."""


def _oriented(pair: jaxro.Pair) -> jaxro.Orientation:
    return jaxro.orient(pair, start=starts.Vertical(), residual=coplanarity.parallax)


def _exact(pair: jaxro.Pair):
    return grubbs.refit_means(pair, pair.mask, _oriented(pair).pose)[0]


def _closed(pair: jaxro.Pair):
    return grubbs.first_order_means(pair, pair.mask, _oriented(pair).pose)[0]


def _pose_of(pair: jaxro.Pair):
    return _oriented(pair).pose


def _means_one_by_one(pair: jaxro.Pair) -> NDArray:
    """The mean |q| of one pair after the omission of each point, each oriented on its
    own."""
    n = pair.x_left.shape[0]
    copies = jaxro.pair(
        *(jnp.broadcast_to(c, (n, n)) for c in pair.coordinates),
        focal=pair.focal_left,
        mask=~np.eye(n, dtype=bool),
    )
    q = jaxro.orient_batch(
        copies,
        start=starts.Vertical(),
        residual=coplanarity.parallax,
        select=lambda o: o.parallax,
    )
    return np.sum(np.abs(np.asarray(q)), axis=1) / n


def omissions(size: Size) -> list[Metric]:
    """Every point left out in turn, the fit of all points included, against PoseLib
    refitting in a loop."""
    metrics = []
    for points, pairs, few in ((16, 2048, 512), (200, 32, 8)):
        pairs, label = pairs * size.robust, f"omissions, {points} points"
        coordinates = aerial(pairs, points)
        ours = pair_of(coordinates)
        calls = {
            name: partial(ready, jaxro.map_batch, f, ours)
            for name, f in (
                ("exact", _exact),
                ("closed", _closed),
                ("bare", _pose_of),
                ("whole", _oriented),
            )
        }
        means = np.asarray(calls["exact"]())
        worst = max(
            np.max(
                np.abs(
                    means[i]
                    - _means_one_by_one(pair_of(tuple(c[i] for c in coordinates)))
                )
            )
            for i in range(4)
        )
        if not worst <= EXACT:
            raise ArithmeticError(
                f"{label}: a mean differs by {worst:.1e} mm from a fit of its own; "
                "nothing timed"
            )
        for call in calls.values():
            call()
        with peers.Peer(
            peers.omissions, share(coordinates, few), processes=2
        ) as poselib:
            seconds = median_seconds({**calls, "poselib": poselib.run}, size.repeats)
        each = {
            name: seconds[name] / (few if name == "poselib" else pairs)
            for name in seconds
        }
        metrics += [
            Metric(
                f"{label}: difference from fits one by one",
                worst,
                "mm",
                "lower",
                tolerance=np.inf,
                goal=EXACT,
            ),
            rate(f"{label}: jaxro, exact", each["exact"]),
            rate(f"{label}: jaxro, closed form", each["closed"]),
            rate(f"{label}: PoseLib in two processes", each["poselib"]),
            ratio(
                f"{label}: exact against PoseLib in two processes",
                each["poselib"],
                each["exact"],
                12,
            ),
            Metric(
                f"{label}: closed form against the whole Orientation",
                each["closed"] / each["whole"],
                "times",
                "lower",
                goal=1.5,
            ),
            Metric(
                f"{label}: closed form against the pose alone",
                each["closed"] / each["bare"],
                "times",
                "lower",
            ),
        ]
    return metrics


RIGHT = np.deg2rad(0.05)
"""Largest angle of rotation or base from the least-squares solution of the good
points."""


class Case(NamedTuple):
    """A kind of pairs; how many of them the peers get; the ratio to reach."""

    name: str
    make: Callable[..., tuple]
    points: int
    share: float
    pairs: int
    few: int
    goal: float
    least: float = 0.0


CASES = (
    Case("near-vertical", aerial, 16, 0.2, 2048, 2048, 8, 0.97),
    Case("near-vertical", aerial, 16, 0.5, 512, 1024, 5),
    Case("near-vertical", aerial, 50, 0.2, 1024, 1024, 12),
    Case("near-vertical", aerial, 200, 0.2, 512, 512, 12),
    Case("near-vertical", aerial, 200, 0.5, 512, 512, 80),
    Case("any position", any_position, 50, 0.3, 128, 256, 2),
)


def _settings(tolerance: float) -> dict[str, tuple[Callable, list[dict[str, Any]]]]:
    """The peers with what they may be told; the first setting of each has our tolerance
    (mm), the others are quicker or right more often in some of the cases."""
    poselib = [(tolerance, 10), (0.03, 10), (0.05, 10), (0.05, 100)]
    return {
        "PoseLib": (
            peers.ransac,
            [
                {"max_epipolar_error": error, "min_iterations": least}
                for error, least in poselib
            ],
        ),
        **{
            name: (
                peers.opencv,
                [
                    {"method": name, "threshold": threshold}
                    for threshold in (tolerance, 0.03)
                ],
            )
            for name in ("USAC_DEFAULT", "USAC_MAGSAC")
        },
    }


def angles(one: Poses, other: Poses) -> NDArray:
    """The larger angle of every pair, of the rotations or of the bases."""
    turn = np.sum((one[0] - other[0]) ** 2, axis=(1, 2)) / 8
    chord = np.sum((one[1] - other[1]) ** 2, axis=1) / 4
    return 2 * np.arcsin(np.minimum(np.sqrt(np.fmax(turn, chord)), 1))


def robust(size: Size) -> list[Metric]:
    """Pairs with wrong points (1 to 10 mm in the right photo): `Recommended` against
    LO-RANSAC, USAC and MAGSAC.

    All are judged on the pairs that the peers get. A peer is timed at its quickest
    setting that is right as often as ours, or else at the one that is right most often;
    its points are judged at our own tolerance, since a narrower one keeps fewer wrong
    points and loses more good ones, in whatever program.
    """
    procedure = Recommended(sigma=SIGMA)
    metrics = []
    for case in CASES:
        label = f"{case.name}, {case.points} points, {case.share:.0%} wrong"
        coordinates, wrong = with_wrong_points(
            case.make(case.pairs * size.robust, case.points), case.share
        )
        ours = pair_of(coordinates)
        clean = partial(
            ready, partial(jaxro.clean_batch, select=_kept_and_pose), ours, procedure
        )
        mask, found = clean()
        few = case.few if size.robust > 1 else case.few // 8
        good_points = pair_of(share(coordinates, few)).with_mask(
            jnp.asarray(~wrong[:few])
        )
        truth = poses(jaxro.orient_batch(good_points, select=pose))
        rotation, base = poses(found)
        right = _share_right((rotation[:few], base[:few]), truth)
        metrics.append(
            Metric(
                f"{label}: right, jaxro",
                right,
                "of 1",
                "higher",
                0.02,
                goal=case.least or None,
            )
        )
        metrics += _points(label, "jaxro", np.asarray(mask)[:few], wrong[:few])
        for name, (task, settings) in _settings(
            _tolerance(procedure, case.points)
        ).items():
            with peers.Peer(task, share(coordinates, few), processes=2) as peer:
                tried = []
                for options in settings:
                    answers = peer.answers(options)
                    begin = time.perf_counter()
                    peer.run(options)
                    elapsed = time.perf_counter() - begin
                    tried.append(
                        (_share_right(peers.stacked(answers), truth), elapsed, options)
                    )
                    if options is settings[0]:
                        metrics += _points(
                            label, name, np.stack([a[2] for a in answers]), wrong[:few]
                        )
                good = [t for t in tried if t[0] >= right - 1e-9]
                best = (
                    min(good, key=lambda t: t[1])
                    if good
                    else max(tried, key=lambda t: t[0])
                )
                seconds = median_seconds(
                    {"ours": clean, "peer": partial(peer.run, best[2])}, 3
                )
            metrics += [
                Metric(f"{label}: right, {name}", best[0], "of 1", "higher", np.inf),
                ratio(
                    f"{label}: against {name}",
                    seconds["peer"] / few,
                    seconds["ours"] / len(wrong),
                    case.goal,
                ),
            ]
        metrics.append(rate(f"{label}: jaxro", seconds["ours"] / len(wrong)))
    return metrics


def _tolerance(procedure: Recommended, points: int) -> float:
    """mm from the epipolar line up to which a point is kept."""
    return SIGMA * float(critical_values.normal(procedure.level / points))


def _points(label: str, name: str, kept: NDArray, wrong: NDArray) -> list[Metric]:
    tolerance = 1 if name == "jaxro" else np.inf
    counts = ("wrong points kept", kept & wrong), ("good points lost", ~kept & ~wrong)
    return [
        Metric(
            f"{label}: {what}, {name}",
            float(np.mean(np.sum(points, axis=1))),
            "a pair",
            "lower",
            tolerance,
        )
        for what, points in counts
    ]


def _kept_and_pose(found: jaxro.rejection.Rejection):
    return found.mask, found.orientation.pose


def _share_right(found: Poses, truth: Poses) -> float:
    count = len(found[0])
    return float(np.mean(angles(found, (truth[0][:count], truth[1][:count])) < RIGHT))


def procedures(size: Size) -> list[Metric]:
    """Every procedure on the same simulated pairs of sixteen points, two of them wrong
    by ten sigma."""
    exact = mock_pairs.mock_pair(mock_pairs.row_layout())
    exact = jaxro.pair(*exact.coordinates, focal=exact.focal_left, sigma=SIGMA)
    pairs, _ = simulate(exact, Setting("eight rows", 2, 10.0), size.trials, seed=0)
    compiling, times = 0.0, {}
    for name, procedure in PROCEDURES.items():
        clean = partial(
            ready, partial(jaxro.clean_batch, select=_kept_and_pose), pairs, procedure
        )
        begin = time.perf_counter()
        clean()
        middle = time.perf_counter()
        clean()
        times[name] = time.perf_counter() - middle
        compiling += max(middle - begin - times[name], 0.0)
    whole = sum(times.values())
    shares = [
        Metric(f"all procedures, share of {name}", s / whole, "of 1", "lower", np.inf)
        for name, s in times.items()
    ]
    return [
        Metric(
            f"all procedures, {size.trials:,} trials each",
            whole,
            "s",
            "lower",
            0.5,
            goal=120,
        ),
        Metric("all procedures: compilation besides", compiling, "s", "lower", 0.5),
        *shares,
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    suite.__name__: suite for suite in (omissions, robust, procedures)
}
