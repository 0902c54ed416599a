"""The suites: each compares answers, then times, and returns its metrics."""

import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import cast

import jax
import numpy as np
from numpy.typing import NDArray

import jaxro
from jaxro import coplanarity

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
    calls: int = 2_000


QUICK = Size({16: 8_192, 200: 1_024, 1000: 256}, peer_share=4, repeats=3, processes=1, calls=200)


def _share(coordinates: peers.Coordinates, pairs: int) -> peers.Coordinates:
    return tuple(c[:pairs] for c in coordinates)


def _pair(coordinates: peers.Coordinates) -> jaxro.Pair:
    return jaxro.pair(*coordinates, focal=FOCAL)


def _poses(orientation: jaxro.Orientation) -> Poses:
    rotation, base = orientation.pose.relative()
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


def refinement(size: Size) -> list[Metric]:
    """Rigorous residual on the whole machine, against PoseLib in two processes and stock optimistix."""
    metrics = []
    for points, pairs in size.pairs.items():
        coordinates, label = aerial(pairs, points), f"{points} points"
        ours, few = _pair(coordinates), _share(coordinates, pairs // size.peer_share)
        goal, stock_goal = (8, 20) if points == 16 else (10, None)
        stock = peers.stock_optimistix()
        part = _share(coordinates, min(len(few[0]), 10_000))
        answer = _poses(jaxro.orient_batch(ours))
        with peers.PoseLib(few, processes=2) as poselib:
            metrics += [
                _agreement(f"rigorous, {label}: difference from PoseLib", answer, poselib.refined(), 1e-8),
                _agreement(
                    f"rigorous, {label}: difference from optimistix", answer, peers.as_poses(stock(*part)), 1e-9
                ),
            ]
            seconds = median_seconds(
                {
                    "jaxro": lambda ours=ours: jax.block_until_ready(jaxro.orient_batch(ours)),
                    "poselib": poselib.refine,
                    "optimistix": lambda stock=stock, part=part: jax.block_until_ready(stock(*part)),
                },
                size.repeats,
            )
        each = {"jaxro": pairs, "poselib": len(few[0]), "optimistix": len(part[0])}
        per_pair = {name: seconds[name] / count for name, count in each.items()}
        metrics += [
            *(_rate(f"rigorous, {label}: {name}", value) for name, value in per_pair.items()),
            _ratio(
                f"rigorous, {label}: against PoseLib in two processes", per_pair["poselib"], per_pair["jaxro"], goal
            ),
            _ratio(f"rigorous, {label}: against optimistix", per_pair["optimistix"], per_pair["jaxro"], stock_goal),
        ]
    return metrics


def parallax(size: Size) -> list[Metric]:
    """Strict y-parallax at 16 points on the whole machine, against PoseLib in two processes."""
    coordinates = aerial(size.pairs[16], 16)
    ours, few = _pair(coordinates), _share(coordinates, size.pairs[16] // size.peer_share)
    orient = partial(jaxro.orient_batch, residual=coplanarity.parallax)
    check = peers.scipy_parallax(_share(coordinates, 32))
    metrics = [_agreement("parallax, 16 points: difference from SciPy", _poses(orient(ours)), check, 1e-7)]
    with peers.PoseLib(few, processes=2) as poselib:
        seconds = median_seconds(
            {"jaxro": lambda: jax.block_until_ready(orient(ours)), "poselib": poselib.refine}, size.repeats
        )
    per_pair = seconds["jaxro"] / len(coordinates[0])
    return [
        *metrics,
        _rate("parallax, 16 points: jaxro", per_pair),
        _ratio(
            "parallax, 16 points: against PoseLib in two processes", seconds["poselib"] / len(few[0]), per_pair, goal=10
        ),
    ]


def users_own(size: Size) -> list[Metric]:
    """jax.jit(jax.vmap(orient)), default flags, against PoseLib in one process; the whole against its pose alone."""
    coordinates = aerial(size.pairs[16] // 2, 16)
    ours, few = _pair(coordinates), _share(coordinates, size.pairs[16] // size.peer_share // 2)
    whole = jax.jit(jax.vmap(jaxro.orient))
    bare = jax.jit(jax.vmap(lambda pair: jaxro.orient(pair).pose))
    answer = _poses(whole(ours))
    jax.block_until_ready(bare(ours))
    with peers.PoseLib(few, processes=1) as poselib:
        metrics = [_agreement("jit(vmap(orient)): difference from PoseLib", answer, poselib.refined(), 1e-8)]
        seconds = median_seconds(
            {
                "whole": lambda: jax.block_until_ready(whole(ours)),
                "bare": lambda: jax.block_until_ready(bare(ours)),
                "poselib": poselib.refine,
            },
            size.repeats,
        )
    pairs = len(coordinates[0])
    one_process = seconds["poselib"] / len(few[0])
    return [
        *metrics,
        _rate("jit(vmap(orient)), 16 points: whole Orientation", seconds["whole"] / pairs),
        _rate("jit(vmap(orient)), 16 points: pose alone", seconds["bare"] / pairs),
        _rate("PoseLib in one process, 16 points", one_process),
        _ratio("jit(vmap(orient)): against PoseLib in one process", one_process, seconds["whole"] / pairs, goal=3),
        Metric("whole Orientation: against pose alone", seconds["whole"] / seconds["bare"], "times", "lower", goal=2),
    ]


def latency(size: Size) -> list[Metric]:
    """One pair of 16 points: the innermost compiled function (arrays in, arrays out), and `jit(orient)` as called."""
    pair = _pair(tuple(c[0] for c in aerial(1, 16)))
    leaves, structure = jax.tree.flatten(pair)

    def flat(*arrays: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(jaxro.orient(jax.tree.unflatten(structure, arrays)))

    innermost = jax.jit(flat).lower(*leaves).compile()
    orient = jax.jit(jaxro.orient)
    jax.block_until_ready(orient(pair))
    seconds = median_seconds(
        {
            "innermost": lambda: jax.block_until_ready(innermost(*leaves)),
            "orient": lambda: jax.block_until_ready(orient(pair)),
        },
        size.calls,
    )
    return [
        Metric("one pair: innermost compiled function", seconds["innermost"] * 1e6, "µs", "lower", 0.5, goal=60),
        Metric("one pair: jit(orient)(pair)", seconds["orient"] * 1e6, "µs", "lower", 0.5),
    ]


def _python(code: str) -> Callable[[], str]:
    """A call that runs the code in a new interpreter and returns what it printed."""
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return lambda: subprocess.run(command, check=True, capture_output=True, text=True).stdout


def first_call(size: Size) -> list[Metric]:
    """The first orientation of a process, compilation included, imports not."""
    run = _python("""
        import time
        import jax
        import jaxro
        from benchmarks.workload import FOCAL, aerial
        pair = jaxro.pair(*(c[0] for c in aerial(1, 16)), focal=FOCAL)
        jax.block_until_ready(pair)
        begin = time.perf_counter()
        jax.block_until_ready(jaxro.orient(pair).pose)
        print(time.perf_counter() - begin)
    """)
    seconds = float(np.median([float(run()) for _ in range(size.processes)]))
    return [Metric("first orient(pair) of a process", seconds, "s", "lower", goal=1.5)]


def command_line(size: Size) -> list[Metric]:
    """`jaxro orient` on the embedded example against a bare JAX process that compiles one small function."""
    script = shutil.which("jaxro", path=str(Path(sys.executable).parent))
    ours = _python('import sys; sys.argv = ["jaxro", "orient"]; from jaxro.cli import app; app()')
    if script:

        def ours() -> str:
            return subprocess.run([cast(str, script), "orient"], check=True, capture_output=True, text=True).stdout

    bare = _python("import jax, jax.numpy as jnp; jax.jit(lambda x: (jnp.sin(x) ** 2).sum())(jnp.ones(8))")
    seconds = median_seconds({"ours": ours, "bare": bare}, size.processes)
    return [
        Metric("command line: jaxro orient", seconds["ours"], "s", "lower"),
        Metric("command line: bare JAX process", seconds["bare"], "s", "lower"),
        Metric("command line: against bare JAX", seconds["ours"] / seconds["bare"], "times", "lower", goal=2.5),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    suite.__name__: suite for suite in (refinement, parallax, users_own, latency, first_call, command_line)
}
