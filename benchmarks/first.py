"""The suite of first answers: what a user waits for, compilation included.

Every call runs in a new process without any compiled program at hand. Its figure is the
processor time over that of a bare JAX process that compiles one small function.
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .common import Size
from .databases import write_pinhole
from .metrics import Metric
from .workload import FOCAL, aerial, any_position, with_wrong_points

SIGMA = 0.01
"""mm"""

BARE = "import jax, jax.numpy as jnp; jax.jit(lambda x: (jnp.sin(x) ** 2).sum())(1.0)"

PAIR = """
    import jax
    import jax.numpy as jnp
    import numpy as np
    import jaxro
    from benchmarks.workload import FOCAL, aerial
    pairs = lambda n, k: jaxro.pair(*aerial(n, k), focal=FOCAL, sigma=0.01)
    one = lambda k: jaxro.pair(*(c[0] for c in aerial(1, k)), focal=FOCAL, sigma=0.01)
"""

CALLS = {
    "jit(orient)": ("jax.jit(jaxro.orient)(one(12))", 10),
    "jit(grad) of an element": (
        "jax.jit(jax.grad(lambda p: jaxro.orient(p).pose.by, allow_int=True))(one(12))",
        14,
    ),
    "orient_batch, 100 pairs": ("jaxro.orient_batch(pairs(100, 16))", 5),
    "clean_batch, 100 pairs": (
        "jaxro.clean_batch(pairs(100, 16), jaxro.rejection.Recommended())",
        9,
    ),
    "clean_ragged, 300 pairs of 20 to 2,000 points": (
        """
        from benchmarks.first import long_pairs
        members = [jaxro.pair(*c, focal=FOCAL, sigma=0.01) for c in long_pairs()]
        jaxro.clean_ragged(jaxro.join(members), jaxro.rejection.Recommended())
        """,
        20,
    ),
}
"""Code in Python, and how many times a bare process it may take."""


def seconds_of(command: Sequence[str], **environment: str) -> float:
    """Processor time of a command, that of its own children included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | environment
    )
    if process.returncode not in (0, 1):
        raise ArithmeticError(f"{command}: {process.stderr[-500:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def write_table(
    path: Path, coordinates: Sequence[Sequence[NDArray[np.float64]]]
) -> Path:
    """The pairs, each x_left, y_left, x_right, y_right, as CSV."""
    lines = ["pair,point,x_left,y_left,x_right,y_right"]
    for number, pair in enumerate(coordinates):
        for point, row in enumerate(zip(*pair, strict=True)):
            values = ",".join(f"{value:.4f}" for value in row)
            lines.append(f"p{number},{point},{values}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def one_pair(make: Callable, points: int) -> list[tuple[NDArray[np.float64], ...]]:
    """A single pair of this kind."""
    return [tuple(c[0] for c in make(1, points))]


def small_pairs(pairs: int = 200) -> list[tuple[NDArray[np.float64], ...]]:
    """Pairs of 8 to 19 points."""
    made = {n: aerial(pairs, n, seed=n) for n in range(8, 20)}
    return [tuple(c[k] for c in made[8 + k % 12]) for k in range(pairs)]


def long_pairs(pairs: int = 300) -> list[tuple[NDArray[np.float64], ...]]:
    """Pairs of 20 to 2,000 points in any position, 30 % of them wrong."""
    rng = np.random.default_rng(0)
    counts = np.exp(rng.uniform(np.log(20), np.log(2000), pairs)).astype(int)
    most, _ = with_wrong_points(any_position(pairs, 2000), 0.3)
    return [tuple(c[k, :n] for c in most) for k, n in enumerate(counts)]


def first(size: Size) -> list[Metric]:
    """All calls with an empty cache, and those of the command line again after it."""
    script = [sys.executable, "-m", "jaxro"]
    metrics = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bare = statistics.median(
            seconds_of([sys.executable, "-c", BARE]) for _ in range(size.processes + 2)
        )
        metrics.append(Metric("first: bare JAX process", bare, "s", "lower"))
        for label, command, goal, later in _commands(folder):
            cache = folder / f"cache {label}"
            run = partial(seconds_of, [*script, *command], JAXRO_CACHE=str(cache))
            metrics.append(_metric(f"first: {label}", run() / bare, goal))
            if later is not None:
                again = statistics.median(run() for _ in range(size.processes))
                metrics.append(_metric(f"later: {label}", again / bare, later))
        for label, (code, goal) in CALLS.items():
            whole = f"{textwrap.dedent(PAIR)}\n{textwrap.dedent(code)}"
            found = seconds_of([sys.executable, "-c", whole]) / bare
            metrics.append(_metric(f"first: {label}", found, goal))
    return metrics


def _metric(key: str, value: float, goal: float | None) -> Metric:
    return Metric(key, value, "times", "lower", goal=goal)


def _commands(folder: Path) -> list[tuple[str, list[str], float, float | None]]:
    """Command lines, with the goals of the first and, where there is one, of later
    calls."""
    camera = ["--focal", str(FOCAL), "--sigma", str(SIGMA)]
    table = lambda name, pairs: str(write_table(folder / f"{name}.csv", pairs))
    near = table("near", one_pair(aerial, 12))
    turned = table("any", one_pair(any_position, 12))
    many = table("many", small_pairs())
    database = folder / "six.db"
    rng = np.random.default_rng(0)
    write_pinhole(database, rng.integers(200, 1000, 6), rng, 1.0, 0.3)
    colmap = ["colmap", str(database), "--sigma", "1", "--out", str(folder / "out.db")]
    procedures = ["--procedure", "recommended", "--procedure", "data-snooping"]
    out = lambda name: ["--out", str(folder / name), "--force"]
    return [
        ("orient, example", ["orient"], 4, 2),
        ("orient, 12 points near-vertical", ["orient", near, *camera], 5, 2),
        ("orient, 12 points in any position", ["orient", turned, *camera], 7, None),
        ("clean, 12 points", ["clean", near, *camera], 8, 2.5),
        ("orient, 200 pairs", ["orient", many, *camera, *out("oriented")], 8, None),
        ("clean, 200 pairs", ["clean", many, *camera, *out("cleaned")], 16, None),
        ("colmap, six pairs", [*colmap, "--force"], 14, None),
        ("compare", ["compare", *procedures], 40, None),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {"first": first}
