"""Run the benchmark suites; print what they measured, keep it, or compare it with the
committed figures."""

import argparse
import datetime
import importlib.metadata
import os
import platform
import sys

from . import summary
from .metrics import Baseline, Metric, Suite, read_baseline, table, write_baseline


def machine() -> str:
    """One line about where the figures come from."""
    names = ("jax", "optimistix", "poselib", "pycolmap", "numpy")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"{datetime.date.today()}, {os.cpu_count()} cores ({platform.machine()}), "
        f"float64, {versions}."
    )


def main() -> int:
    from . import (
        block,
        calibration,
        colmap,
        engine,
        facades,
        first,
        photos,
        reading,
        rejection,
        scale,
        weak_bases,
    )
    from .common import QUICK, Size

    suites = (
        engine.SUITES
        | first.SUITES
        | rejection.SUITES
        | reading.SUITES
        | scale.SUITES
        | colmap.SUITES
        | photos.SUITES
        | weak_bases.SUITES
        | facades.SUITES
        | calibration.SUITES
        | block.SUITES
    )

    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="few pairs, few repeats: does it run, roughly how fast",
    )
    parser.add_argument(
        "--only",
        choices=suites,
        action="append",
        help="this suite alone (may be repeated)",
    )
    parser.add_argument(
        "--update-baseline",
        action="store_true",
        help="write the figures into benchmarks/baseline.json, those of --only alone if "
        "given, and make results.md of it",
    )
    parser.add_argument(
        "--gate",
        action="store_true",
        help="fail where a figure (times left out) is worse than the tolerance around "
        "that of baseline.json",
    )
    options = parser.parse_args()
    if options.update_baseline and options.quick:
        parser.error("--update-baseline needs figures of full size")

    measured: dict[str, Suite] = {}
    for name in options.only or suites:
        found = suites[name](QUICK if options.quick else Size())
        rows = [metric.row() for metric in found]
        # a run takes long: show what there is
        print(name, *rows, sep="\n", file=sys.stderr, flush=True)
        measured[name] = Suite(str(datetime.date.today()), found)
    now = Baseline(machine(), measured)
    print(f"{now.machine}\n\n{table(now.metrics)}")

    worse = _worse(now.metrics) if options.gate else []
    for line in worse:
        print(line)
    if options.update_baseline:
        both = read_baseline().suites | measured
        known = {name: both[name] for name in suites if name in both}
        write_baseline(now._replace(suites=known))
        summary.write_page(read_baseline())
    return 1 if worse else 0


def _worse(measured: list[Metric]) -> list[str]:
    """A line for each figure that is worse than the committed one allows. Times are not
    compared: they depend on the machine."""
    committed = read_baseline().values()
    return [
        f"worse: {metric.key}: {metric.value:.4g} {metric.unit}, committed "
        f"{committed[metric.key]:.4g}"
        for metric in measured
        if metric.key in committed
        and not (metric.is_time or metric.holds(committed[metric.key]))
    ]


if __name__ == "__main__":
    sys.exit(main())
