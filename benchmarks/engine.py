"""The suites: each compares answers, then times, and returns its metrics."""

import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

import jaxro
from jaxro import coplanarity, starts
from jaxro.orientation import orient_near
from jaxro.programs import QUICK as QUICK_PROGRAM

from . import peers
from .metrics import Metric, median_seconds
from .workload import FOCAL, aerial

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
"""R (pairs, 3, 3) and unit base (pairs, 3)"""


@dataclass(frozen=True)
class Size:
    """How much is measured: pairs by number of points, the share of them the slower peers get, repeats."""

    pairs: dict[int, int] = field(default_factory=lambda: {16: 131_072, 200: 16_384, 1000: 4_096})
    peer_share: int = 4
    repeats: int = 7
    processes: int = 5
    calls: int = 200


QUICK = Size({16: 8_192, 200: 1_024, 1000: 256}, peer_share=4, repeats=3, processes=1, calls=20)


def _share(coordinates: peers.Coordinates, pairs: int) -> peers.Coordinates:
    return tuple(c[:pairs] for c in coordinates)


def _pair(coordinates: peers.Coordinates) -> jaxro.Pair:
    return jaxro.pair(*coordinates, focal=FOCAL)


def _ready(call: Callable, *arguments: Any) -> Any:
    return jax.block_until_ready(call(*arguments))


def _poses(pose: jaxro.RelativePose) -> Poses:
    rotation, base = pose.relative()
    return np.moveaxis(np.array(rotation), (0, 1), (-2, -1)), np.moveaxis(np.array(base), 0, -1)


def _difference(one: Poses, other: Poses) -> float:
    """The largest difference of any entry of R or of the unit base: radians, for small ones."""
    count = min(len(one[0]), len(other[0]))
    return max(float(np.max(np.abs(a[:count] - b[:count]))) for a, b in zip(one, other, strict=True))


def _agreement(key: str, ours: Poses, theirs: Poses, bound: float) -> Metric:
    """The metric of an accuracy comparison. Raises ArithmeticError beyond `bound`: nothing is timed then."""
    difference = _difference(ours, theirs)
    if not difference <= bound:
        raise ArithmeticError(f"{key}: the answers differ by {difference:.1e}, more than {bound:.0e}; nothing timed")
    return Metric(key, difference, "rad", "lower", tolerance=np.inf, goal=bound)


def _rate(key: str, seconds: float) -> Metric:
    return Metric(key, seconds * 1e6, "µs a pair", "lower", tolerance=0.5)


def _ratio(key: str, peer: float, ours: float, goal: float | None) -> Metric:
    return Metric(key, peer / ours, "times", "higher", goal=goal)


def _pose(orientation: jaxro.Orientation) -> jaxro.RelativePose:
    """What the peers compute; the rest is then not computed by ours either."""
    return orientation.pose


def refinement(size: Size) -> list[Metric]:
    """Rigorous residual on the whole machine: the pose, as the peers compute it, and the whole Orientation."""
    metrics = []
    for points, pairs in size.pairs.items():
        goal, stock_goal = (8, 20) if points == 16 else (10, None)
        coordinates, label = aerial(pairs, points), f"rigorous, {points} points"
        ours, few = _pair(coordinates), _share(coordinates, pairs // size.peer_share)
        part = _share(coordinates, min(len(few[0]), 10_000))
        contestants: dict[str, Callable] = {
            "pose": partial(_ready, partial(jaxro.orient_batch, select=_pose), ours),
            "whole": partial(_ready, jaxro.orient_batch, ours),
            "optimistix": partial(_ready, peers.stock_optimistix(), *part),
        }
        answers = {name: call() for name, call in contestants.items()}
        pose, whole = _poses(answers["pose"]), _poses(answers["whole"].pose)
        with peers.PoseLib(few, processes=2) as poselib:
            metrics += [
                _agreement(f"{label}: difference from PoseLib", pose, poselib.refined(), 1e-8),
                _agreement(f"{label}: difference from optimistix", pose, peers.as_poses(answers["optimistix"]), 1e-9),
                _agreement(f"{label}: pose alone or in the whole", pose, whole, 1e-9),
            ]
            del answers
            seconds = median_seconds({**contestants, "poselib": poselib.refine}, size.repeats)
        each = {"pose": pairs, "whole": pairs, "optimistix": len(part[0]), "poselib": len(few[0])}
        per_pair = {name: seconds[name] / count for name, count in each.items()}
        metrics += [
            _rate(f"{label}: jaxro, pose", per_pair["pose"]),
            _rate(f"{label}: jaxro, whole Orientation", per_pair["whole"]),
            _rate(f"{label}: PoseLib in two processes", per_pair["poselib"]),
            _rate(f"{label}: optimistix under vmap", per_pair["optimistix"]),
            _ratio(f"{label}: pose against PoseLib in two processes", per_pair["poselib"], per_pair["pose"], goal),
            _ratio(f"{label}: pose against optimistix", per_pair["optimistix"], per_pair["pose"], stock_goal),
            _ratio(f"{label}: whole against PoseLib in two processes", per_pair["poselib"], per_pair["whole"], None),
            Metric(f"{label}: whole against pose", per_pair["whole"] / per_pair["pose"], "times", "lower", goal=2),
        ]
    return metrics


def parallax(size: Size) -> list[Metric]:
    """Strict y-parallax at 16 points on the whole machine, against PoseLib in two processes."""
    coordinates = aerial(size.pairs[16], 16)
    ours, few = _pair(coordinates), _share(coordinates, size.pairs[16] // size.peer_share)
    orient = partial(_ready, partial(jaxro.orient_batch, residual=coplanarity.parallax, select=_pose), ours)
    check = peers.scipy_parallax(_share(coordinates, 32))
    metrics = [_agreement("parallax, 16 points: difference from SciPy", _poses(orient()), check, 1e-7)]
    with peers.PoseLib(few, processes=2) as poselib:
        seconds = median_seconds({"jaxro": orient, "poselib": poselib.refine}, size.repeats)
    ours_each, peer_each = seconds["jaxro"] / size.pairs[16], seconds["poselib"] / len(few[0])
    return [
        *metrics,
        _rate("parallax, 16 points: jaxro, pose", ours_each),
        _ratio("parallax, 16 points: pose against PoseLib in two processes", peer_each, ours_each, goal=10),
    ]


def users_own(size: Size) -> list[Metric]:
    """jax.jit(jax.vmap(orient)), default flags, against PoseLib in one process; the whole against its pose alone."""
    coordinates = aerial(size.pairs[16] // 2, 16)
    ours, few = _pair(coordinates), _share(coordinates, size.pairs[16] // size.peer_share // 2)
    contestants: dict[str, Callable] = {
        "whole": partial(_ready, jax.jit(jax.vmap(jaxro.orient)), ours),
        "pose": partial(_ready, jax.jit(jax.vmap(lambda pair: jaxro.orient(pair).pose)), ours),
    }
    answers = {name: call() for name, call in contestants.items()}
    with peers.PoseLib(few, processes=1) as poselib:
        metrics = [
            _agreement(
                "jit(vmap(orient)): difference from PoseLib", _poses(answers["whole"].pose), poselib.refined(), 1e-8
            )
        ]
        del answers
        seconds = median_seconds({**contestants, "poselib": poselib.refine}, size.repeats)
    pairs = len(coordinates[0])
    one_process = seconds["poselib"] / len(few[0])
    return [
        *metrics,
        _rate("jit(vmap(orient)), 16 points: whole Orientation", seconds["whole"] / pairs),
        _rate("jit(vmap(orient)), 16 points: pose alone", seconds["pose"] / pairs),
        _rate("PoseLib in one process, 16 points", one_process),
        _ratio("jit(vmap(orient)): against PoseLib in one process", one_process, seconds["whole"] / pairs, goal=3),
        Metric("jit(vmap(orient)): whole against pose", seconds["whole"] / seconds["pose"], "times", "lower", goal=2),
    ]


IN_A_ROW = 50
"""Calls that are timed together where one takes microseconds."""


def _repeated(call: Callable, pair: jaxro.Pair) -> None:
    for _ in range(IN_A_ROW):
        jax.block_until_ready(call(pair))


def latency(size: Size) -> list[Metric]:
    """One near-vertical pair of 16 points: the compiled function inside `orient`, for the pose as peers return it and
    for the whole Orientation, then `orient` and `jit(orient)` as called."""
    pair = jax.device_put(_pair(tuple(c[0] for c in aerial(1, 16))))
    near = partial(orient_near, start=starts.Auto(steps=0))
    orient = jax.jit(jaxro.orient)
    calls: dict[str, Callable] = {
        "compiled function, pose": jax.jit(lambda pair: near(pair)[0].pose, compiler_options=QUICK_PROGRAM),
        "compiled function, whole Orientation": jax.jit(near, compiler_options=QUICK_PROGRAM),
        "orient(pair)": jaxro.orient,
        "jit(orient)(pair)": orient,
    }
    for call in calls.values():
        jax.block_until_ready(call(pair))
    seconds = median_seconds({name: partial(_repeated, call, pair) for name, call in calls.items()}, size.calls)
    return [
        Metric(
            f"one pair: {name}",
            value / IN_A_ROW * 1e6,
            "µs",
            "lower",
            0.5,
            goal=60 if name.startswith("compiled") else None,
        )
        for name, value in seconds.items()
    ]


def _python(code: str) -> Callable[[], str]:
    """A call that runs the code in a new interpreter and returns what it printed."""
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return lambda: subprocess.run(command, check=True, capture_output=True, text=True).stdout


def first_call(size: Size) -> list[Metric]:
    """The first orientation of a process, compilation included, imports not: as in the README, and under jit."""
    metrics = []
    for call in ("jaxro.orient", "jax.jit(jaxro.orient)"):
        run = _python(f"""
            import time
            import jax
            import jaxro
            from benchmarks.workload import FOCAL, aerial
            pair = jaxro.pair(*(c[0] for c in aerial(1, 16)), focal=FOCAL)
            jax.block_until_ready(pair)
            begin = time.perf_counter()
            jax.block_until_ready({call}(pair).pose)
            print(time.perf_counter() - begin)
        """)
        seconds = float(np.median([float(run()) for _ in range(size.processes)]))
        metrics.append(Metric(f"first {call}(pair) of a process", seconds, "s", "lower", goal=1.5))
    return metrics


def command_line(size: Size) -> list[Metric]:
    """`jaxro orient` on the embedded example against a bare JAX process that compiles one small function: the first
    call of a user, who has no compiled programs yet, and every later one."""
    script = shutil.which("jaxro", path=str(Path(sys.executable).parent))
    command = [script] if script else [sys.executable, "-m", "jaxro"]

    def ours(cache: str) -> str:
        environment = os.environ | {"JAXRO_CACHE": cache}
        return subprocess.run([*command, "orient"], check=True, capture_output=True, text=True, env=environment).stdout

    bare = _python("import jax, jax.numpy as jnp; jax.jit(lambda x: (jnp.sin(x) ** 2).sum())(jnp.ones(8))")
    with tempfile.TemporaryDirectory() as folder:
        if ours("") != ours(folder) or ours("") != ours(folder):
            raise ArithmeticError("command line: a kept program prints something else; nothing timed")
        contestants = {"first": partial(ours, ""), "later": partial(ours, folder), "bare": bare}
        seconds = median_seconds(contestants, size.processes)
    return [
        Metric("command line: jaxro orient, first call", seconds["first"], "s", "lower"),
        Metric("command line: jaxro orient, later calls", seconds["later"], "s", "lower"),
        Metric("command line: bare JAX process", seconds["bare"], "s", "lower"),
        Metric("command line: first call against bare JAX", seconds["first"] / seconds["bare"], "times", "lower"),
        Metric(
            "command line: later calls against bare JAX", seconds["later"] / seconds["bare"], "times", "lower", goal=2.5
        ),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    suite.__name__: suite for suite in (refinement, parallax, users_own, latency, first_call, command_line)
}
