"""The suites of the engine: each compares answers, then times, and returns its
metrics."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np

import jaxro
from jaxro.geometry import coplanarity
from jaxro.orientation.orient import orient_near
from jaxro.orientation.problem import Problem
from jaxro.xla.kernels import one_kernel
from jaxro.xla.programs import jit_in_this_thread
from jaxro.xla.settings import COMPILE_FASTEST, known_settings

from . import peers
from .common import (
    Size,
    agreement,
    listed,
    pair_of,
    pose,
    poses,
    rate,
    ratio,
    ready,
    share,
)
from .metrics import Metric, median_seconds
from .workload import aerial


def refinement(size: Size) -> list[Metric]:
    """Rigorous residual on the whole machine: the pose, as the peers compute it, and
    the whole Orientation."""
    metrics = []
    for points, pairs in size.pairs.items():
        goal, stock_goal = (8, 20) if points == 16 else (10, None)
        coordinates, label = aerial(pairs, points), f"rigorous, {points} points"
        ours, few = pair_of(coordinates), share(coordinates, pairs // size.peer_share)
        part = share(coordinates, min(len(few[0]), 10_000))
        contestants: dict[str, Callable] = {
            "pose": partial(ready, partial(jaxro.orient_batch, select=pose), ours),
            "listed": partial(ready, partial(jaxro.orient_batch, select=listed), ours),
            "whole": partial(ready, jaxro.orient_batch, ours),
            "optimistix": partial(ready, peers.stock_optimistix(), *part),
        }
        answers = {name: call() for name, call in contestants.items()}
        alone, whole = poses(answers["pose"]), poses(answers["whole"].pose)
        with peers.Peer(peers.refinement, few, processes=2) as poselib:
            metrics += [
                agreement(
                    f"{label}: difference from PoseLib", alone, poselib.refined(), 1e-8
                ),
                agreement(
                    f"{label}: difference from optimistix",
                    alone,
                    peers.as_poses(answers["optimistix"]),
                    1e-9,
                ),
                agreement(f"{label}: pose alone or in the whole", alone, whole, 1e-9),
            ]
            del answers
            seconds = median_seconds(
                {**contestants, "poselib": poselib.run}, size.repeats
            )
        each = {
            "pose": pairs,
            "listed": pairs,
            "whole": pairs,
            "optimistix": len(part[0]),
            "poselib": len(few[0]),
        }
        per_pair = {name: seconds[name] / count for name, count in each.items()}
        metrics += [
            rate(f"{label}: jaxro, pose", per_pair["pose"]),
            rate(f"{label}: jaxro, whole Orientation", per_pair["whole"]),
            rate(f"{label}: PoseLib in two processes", per_pair["poselib"]),
            rate(f"{label}: optimistix under vmap", per_pair["optimistix"]),
            ratio(
                f"{label}: pose against PoseLib in two processes",
                per_pair["poselib"],
                per_pair["pose"],
                goal,
            ),
            ratio(
                f"{label}: pose against optimistix",
                per_pair["optimistix"],
                per_pair["pose"],
                stock_goal,
            ),
            ratio(
                f"{label}: whole against PoseLib in two processes",
                per_pair["poselib"],
                per_pair["whole"],
                None,
            ),
            Metric(
                f"{label}: covariance, residuals, redundancy, model against pose",
                per_pair["listed"] / per_pair["pose"],
                "times",
                "lower",
                goal=2,
            ),
            Metric(
                f"{label}: whole against pose",
                per_pair["whole"] / per_pair["pose"],
                "times",
                "lower",
                goal=2,
            ),
        ]
    return metrics


def parallax(size: Size) -> list[Metric]:
    """Strict y-parallax at 16 points on the whole machine, against PoseLib in two
    processes."""
    coordinates = aerial(size.pairs[16], 16)
    ours, few = (
        pair_of(coordinates),
        share(coordinates, size.pairs[16] // size.peer_share),
    )
    orient = partial(
        ready,
        partial(jaxro.orient_batch, residual=coplanarity.parallax, select=pose),
        ours,
    )
    check = peers.scipy_parallax(share(coordinates, 32))
    metrics = [
        agreement(
            "parallax, 16 points: difference from SciPy", poses(orient()), check, 1e-7
        )
    ]
    with peers.Peer(peers.refinement, few, processes=2) as poselib:
        seconds = median_seconds(
            {"jaxro": orient, "poselib": poselib.run}, size.repeats
        )
    ours_each, peer_each = (
        seconds["jaxro"] / size.pairs[16],
        seconds["poselib"] / len(few[0]),
    )
    return [
        *metrics,
        rate("parallax, 16 points: jaxro, pose", ours_each),
        ratio(
            "parallax, 16 points: pose against PoseLib in two processes",
            peer_each,
            ours_each,
            goal=10,
        ),
    ]


def users_own(size: Size) -> list[Metric]:
    """jax.jit(jax.vmap(orient)), default flags, against PoseLib in one process; the
    whole against its pose alone."""
    coordinates = aerial(size.pairs[16] // 2, 16)
    ours, few = (
        pair_of(coordinates),
        share(coordinates, size.pairs[16] // size.peer_share // 2),
    )
    contestants: dict[str, Callable] = {
        "whole": partial(ready, jax.jit(jax.vmap(jaxro.orient)), ours),
        "pose": partial(
            ready, jax.jit(jax.vmap(lambda pair: jaxro.orient(pair).pose)), ours
        ),
    }
    answers = {name: call() for name, call in contestants.items()}
    with peers.Peer(peers.refinement, few, processes=1) as poselib:
        metrics = [
            agreement(
                "jit(vmap(orient)): difference from PoseLib",
                poses(answers["whole"].pose),
                poselib.refined(),
                1e-8,
            )
        ]
        del answers
        seconds = median_seconds({**contestants, "poselib": poselib.run}, size.repeats)
    pairs = len(coordinates[0])
    one_process = seconds["poselib"] / len(few[0])
    return [
        *metrics,
        rate(
            "jit(vmap(orient)), 16 points: whole Orientation", seconds["whole"] / pairs
        ),
        rate("jit(vmap(orient)), 16 points: pose alone", seconds["pose"] / pairs),
        rate("PoseLib in one process, 16 points", one_process),
        ratio(
            "jit(vmap(orient)): against PoseLib in one process",
            one_process,
            seconds["whole"] / pairs,
            goal=3,
        ),
        Metric(
            "jit(vmap(orient)): whole against pose",
            seconds["whole"] / seconds["pose"],
            "times",
            "lower",
            goal=2,
        ),
    ]


IN_A_ROW = 50
"""Calls that are timed together where one takes microseconds."""


def _repeated(call: Callable, pair: jaxro.Pair) -> None:
    for _ in range(IN_A_ROW):
        jax.block_until_ready(call(pair))


def latencies(calls: int) -> dict[str, float]:
    """Microseconds a call of each way to orient one near-vertical pair of 16 points:
    the compiled function inside `orient`, for the pose as peers return it and for the
    whole Orientation, then `orient` and `jit(orient)`."""
    pair = jax.device_put(pair_of(tuple(c[0] for c in aerial(1, 16))))
    near = partial(orient_near, problem=Problem())
    ways: dict[str, Callable] = {
        "compiled function, pose": jit_in_this_thread(
            one_kernel(lambda pair: near(pair)[0][0].pose),
            known_settings(COMPILE_FASTEST),
        ),
        "compiled function, whole Orientation": jit_in_this_thread(
            one_kernel(near), known_settings(COMPILE_FASTEST)
        ),
        "orient(pair)": jaxro.orient,
        "jit(orient)(pair)": jax.jit(jaxro.orient),
    }
    for call in ways.values():
        jax.block_until_ready(call(pair))
    seconds = median_seconds(
        {name: partial(_repeated, call, pair) for name, call in ways.items()}, calls
    )
    return {name: value / IN_A_ROW * 1e6 for name, value in seconds.items()}


def latency(size: Size) -> list[Metric]:
    """One pair, as JAX is set (its CPU client hands every call to another thread), and
    with calls that run where they are made."""
    metrics = []
    for label, threaded in (
        ("one pair", True),
        ("one pair, no asynchronous dispatch", False),
    ):
        run = _python(f"""
            import json
            import jax
            jax.config.update("jax_cpu_enable_async_dispatch", {threaded})
            from benchmarks.engine import latencies
            print(json.dumps(latencies({size.calls})))
        """)
        metrics += [
            Metric(
                f"{label}: {name}",
                value,
                "µs",
                "lower",
                0.5,
                goal=60 if name.startswith("compiled") else None,
            )
            for name, value in json.loads(run()).items()
        ]
    return metrics


def _python(code: str) -> Callable[[], str]:
    """A call that runs the code in a new interpreter and returns what it printed."""
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return lambda: (
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )


def first_call(size: Size) -> list[Metric]:
    """The first orientation of a process, compilation included, imports not: as in the
    README, and under jit."""
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
        metrics.append(
            Metric(f"first {call}(pair) of a process", seconds, "s", "lower", goal=1.5)
        )
    return metrics


def command_line(size: Size) -> list[Metric]:
    """`jaxro orient` on the embedded example against a bare JAX process that compiles
    one small function: the first call of a user, who has no compiled programs yet, and
    every later one."""
    script = shutil.which("jaxro", path=str(Path(sys.executable).parent))
    command = [script] if script else [sys.executable, "-m", "jaxro"]

    def ours(cache: str) -> str:
        environment = os.environ | {"JAXRO_CACHE": cache}
        return subprocess.run(
            [*command, "orient"],
            check=True,
            capture_output=True,
            text=True,
            env=environment,
        ).stdout

    bare = _python(
        "import jax, jax.numpy as jnp; jax.jit(lambda x: (jnp.sin(x) ** "
        "2).sum())(jnp.ones(8))"
    )
    with tempfile.TemporaryDirectory() as folder:
        if ours("") != ours(folder) or ours("") != ours(folder):
            raise ArithmeticError(
                "command line: a kept program prints something else; nothing timed"
            )
        contestants = {
            "first": partial(ours, ""),
            "later": partial(ours, folder),
            "bare": bare,
        }
        seconds = median_seconds(contestants, size.processes)
    return [
        Metric(
            "command line: jaxro orient, first call", seconds["first"], "s", "lower"
        ),
        Metric(
            "command line: jaxro orient, later calls", seconds["later"], "s", "lower"
        ),
        Metric("command line: bare JAX process", seconds["bare"], "s", "lower"),
        Metric(
            "command line: first call against bare JAX",
            seconds["first"] / seconds["bare"],
            "times",
            "lower",
        ),
        Metric(
            "command line: later calls against bare JAX",
            seconds["later"] / seconds["bare"],
            "times",
            "lower",
            goal=2.5,
        ),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    suite.__name__: suite
    for suite in (refinement, parallax, users_own, latency, first_call, command_line)
}
