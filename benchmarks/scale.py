"""The suite of large tables: Parquet to Parquet, pairs of every length, growth with
pairs and points."""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import jaxro
from jaxro.batches import ragged
from jaxro.batches.padding import plan_for
from jaxro.tables import parquet

from .common import Size, pair_of, rate
from .metrics import Metric, median_seconds
from .workload import FOCAL, aerial

TABLES = ("elements", "residuals", "points")

WARMING = 65_536
"""Pairs of the run that compiles."""


def written(path: Path, pairs: int) -> None:
    """A table of so many pairs of 16 points, no two alike."""
    some = min(pairs, WARMING)
    coordinates, rng = aerial(some, 16), np.random.default_rng(1)
    names = ("x_left", "y_left", "x_right", "y_right")
    point = pa.array([str(i) for i in range(1, 17)]).take(
        pa.array(np.tile(np.arange(16), some))
    )
    writer = None
    for begin in range(0, pairs, some):
        count = min(some, pairs - begin)
        pair = pa.array([f"p{k}" for k in range(begin, begin + count)]).take(
            pa.array(np.repeat(np.arange(count), 16))
        )
        values = [
            (c[:count] + 1e-4 * rng.normal(size=(count, 16))).ravel()
            for c in coordinates
        ]
        table = pa.table(
            {
                "pair": pair,
                "point": point[: 16 * count],
                **dict(zip(names, values, strict=True)),
            }
        )
        writer = writer or pq.ParquetWriter(
            path, table.schema, **parquet.encoding(table.schema)
        )
        writer.write_table(table)
    if writer:
        writer.close()


def command(table: Path, out: Path, cache: Path) -> tuple[float, float]:
    """Seconds and largest memory (GB, where /proc tells) of `jaxro orient` as a process
    of its own."""
    arguments = [
        "orient",
        str(table),
        "--focal",
        str(FOCAL),
        "--out",
        str(out),
        "--force",
    ]
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxro", *arguments],
        env=os.environ | {"JAXRO_CACHE": str(cache)},
        stdout=subprocess.DEVNULL,
    )
    largest = 0.0
    while (
        process.poll() is None
    ):  # what getrusage says of a child includes what its parent had when it began
        with contextlib.suppress(OSError, StopIteration):
            lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            largest = max(
                largest,
                float(
                    next(line for line in lines if line.startswith("VmHWM")).split()[1]
                )
                / 1e6,
            )
        time.sleep(0.02)
    seconds = time.perf_counter() - begin
    if process.returncode:
        raise ArithmeticError(f"jaxro orient ended with {process.returncode}")
    return seconds, largest


def arrow_alone(table: Path, results: Path, folder: Path) -> float:
    """Seconds pyarrow takes to read the table and to write the results, all in memory,
    encoded as ours."""
    loaded = {name: pq.read_table(results / name) for name in TABLES}
    begin = time.perf_counter()
    pq.read_table(table)
    for name, content in loaded.items():
        parquet.write(content, folder / f"{name}.parquet")
    return time.perf_counter() - begin


def tables(size: Size) -> list[Metric]:
    """Parquet to Parquet against pyarrow alone, and the memory it takes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        written(folder / "first.parquet", min(WARMING, size.rows // 16))
        written(folder / "all.parquet", size.rows // 16)
        command(folder / "first.parquet", folder / "first", folder / "cache")
        command(folder / "all.parquet", folder / "out", folder / "cache")
        sigma0 = (
            pq.read_table(folder / "out" / "elements").column("sigma0_mm").to_numpy()
        )
        if not abs(np.mean(sigma0**2) / (0.01**2 + 1e-8) - 1) <= 0.01:
            raise ArithmeticError(
                "tables: the standard deviations are not those of the coordinates; "
                "nothing timed"
            )
        runs = [
            (
                command(folder / "all.parquet", folder / "out", folder / "cache"),
                arrow_alone(folder / "all.parquet", folder / "out", folder),
            )
            for _ in range(3)
        ]
    ours, peer = (
        float(np.median(seconds))
        for seconds in zip(*((a[0], b) for a, b in runs), strict=True)
    )
    pairs = size.rows // 16
    label = f"{pairs:,} pairs of 16 points, Parquet to Parquet"
    return [
        rate(f"{label}: jaxro orient", ours / pairs),
        rate(f"{label}: pyarrow alone", peer / pairs),
        Metric(
            f"{label}: against pyarrow alone", ours / peer, "times", "lower", goal=3
        ),
        Metric(
            f"{label}: largest memory",
            max(a[1] for a, _ in runs),
            "GB",
            "lower",
            goal=1.5,
        ),
    ]


def lengths(size: Size) -> list[Metric]:
    """Pairs of 5 to 2,000 points, log-uniform, against as many pairs of their mean
    length."""
    drawn = np.exp(
        np.random.default_rng(0).uniform(np.log(5), np.log(2000), size.rows // 2000)
    ).astype(int)
    mean = int(np.mean(drawn))
    one, many = aerial(len(drawn), mean), aerial(len(drawn), int(drawn.max()))
    begins = np.concatenate([[0], np.cumsum(drawn)])
    there = np.arange(many[0].shape[1])[None, :] < drawn[:, None]
    focal = np.full(len(drawn), FOCAL)
    focals = {"focal_left": focal, "focal_right": focal}
    rows = int(begins[-1])
    uneven = ragged.Ragged(
        begins,
        *(c[there] for c in many),
        sigma=np.ones(rows),
        mask=np.ones(rows, bool),
        **focals,
    )
    even = ragged.Ragged(
        np.arange(len(drawn) + 1) * mean,
        *(c.ravel() for c in one),
        sigma=np.ones(one[0].size),
        mask=np.ones(one[0].size, bool),
        **focals,
    )
    plan = plan_for(np.tile(drawn, 64), 64)  # as of a part of a long table
    calls = {
        "uneven": partial(ragged.orient_ragged, uneven, plan=plan),
        "even": partial(ragged.orient_ragged, even),
    }
    found = calls["uneven"]()
    calls["even"]()
    for k in (0, len(drawn) // 2):
        alone = jaxro.orient(jaxro.pair(*(c[k][there[k]] for c in many), focal=FOCAL))
        worst = float(
            np.max(
                np.abs(
                    np.asarray(alone.parallax)
                    - found.parallax[slice(*begins[k : k + 2])]
                )
            )
        )
        if not worst <= 1e-9:
            raise ArithmeticError(
                f"lengths: a pair differs by {worst:.1e} mm from itself alone; nothing "
                "timed"
            )
    seconds = median_seconds(calls, size.repeats)
    sizes = np.array(plan.sizes)
    padding = 1 - rows / sizes[np.searchsorted(sizes, drawn)].sum()
    each = {
        "uneven": seconds["uneven"] / rows,
        "even": seconds["even"] / (mean * len(drawn)),
    }
    label = "5 to 2,000 points"
    return [
        Metric(f"{label}: padding", padding, "of all", "lower", goal=0.25),
        Metric(
            f"{label}: throughput against even lengths",
            each["even"] / each["uneven"],
            "times",
            "higher",
            goal=0.6,
        ),
    ]


def _kept(orientation: jaxro.Orientation):
    return orientation.pose, orientation.cofactor, orientation.sigma0


def growth(size: Size) -> list[Metric]:
    """Time per pair with the number of pairs, per point with the number of points."""
    most = size.rows // 16
    numbers = sorted({1_000, 10_000, 100_000, most} & set(range(most + 1)))
    some = aerial(min(most, 100_000), 16)
    coordinates = [np.concatenate([c] * -(-most // len(c)))[:most] for c in some]
    batches = {n: pair_of(tuple(c[:n] for c in coordinates)) for n in numbers}
    rounds = {
        n: max(1, 100_000 // n) for n in numbers
    }  # small batches one after another, as who has many calls them

    def called(n: int) -> None:
        for _ in range(rounds[n]):
            jaxro.orient_batch(batches[n], select=_kept)

    for n in numbers:
        called(n)
    seconds = median_seconds(
        {str(n): partial(called, n) for n in numbers}, size.repeats
    )
    by_pairs = {n: seconds[str(n)] / (n * rounds[n]) for n in numbers}
    points = (16, 100, 1_000, 10_000)
    batches = {n: pair_of(aerial(max(size.rows // 8 // n, 8), n)) for n in points}
    calls = {
        str(n): partial(jaxro.orient_batch, batch, select=_kept)
        for n, batch in batches.items()
    }
    for call in calls.values():
        call()
    seconds = median_seconds(calls, size.repeats)
    by_points = {n: seconds[str(n)] / batches[n].x_left.size for n in points}
    spread = max(by_pairs.values()) / min(by_pairs.values())
    return [
        *(
            rate(f"orientation, 16 points, {n:,} pairs at once", s)
            for n, s in by_pairs.items()
        ),
        Metric(
            "orientation: slowest number of pairs against the quickest",
            spread,
            "times",
            "lower",
            goal=1.2,
        ),
        *(
            Metric(f"orientation, {n:,} points: a point", s * 1e9, "ns", "lower", 0.5)
            for n, s in by_points.items()
        ),
        Metric(
            "orientation: a point of 10,000 against one of 100",
            by_points[10_000] / by_points[100],
            "times",
            "lower",
            goal=1.2,
        ),
    ]


SUITES: dict[str, Callable[[Size], list[Metric]]] = {
    "tables": tables,
    "lengths": lengths,
    "growth": growth,
}
