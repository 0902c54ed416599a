"""Runs the suites and prints, writes or holds against the committed table what they
measured."""

import argparse
import datetime
import importlib.metadata
import os
import platform
import sys

from . import metrics as contract


def machine() -> str:
    """One line about where the figures come from."""
    names = ("jax", "optimistix", "poselib", "pycolmap", "numpy")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return (
        f"{datetime.date.today()}, {os.cpu_count()} cores ({platform.machine()}), "
        f"float64, {versions}."
    )


def main() -> int:
    from . import colmap, engine, photos, reading, rejection, scale
    from .common import QUICK, Size

    suites = (
        engine.SUITES
        | rejection.SUITES
        | reading.SUITES
        | scale.SUITES
        | colmap.SUITES
        | photos.SUITES
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
        help="put the table into benchmarks/results.md",
    )
    parser.add_argument(
        "--gate",
        action="store_true",
        help="fail where a ratio is worse than the committed one allows",
    )
    options = parser.parse_args()
    if options.update_baseline and (options.only or options.quick):
        parser.error(
            "--update-baseline takes a whole run: the table's figures stand beside "
            "each other"
        )

    measured = []
    for name in options.only or suites:
        found = suites[name](QUICK if options.quick else Size())
        print(
            name,
            *(metric.row() for metric in found),
            sep="\n",
            file=sys.stderr,
            flush=True,
        )  # a run takes minutes
        measured += found
    print(f"{machine()}\n\n{contract.table(measured)}")

    worse = []
    if options.gate:
        before = contract.committed()
        worse = [
            m
            for m in measured
            if m.key in before
            and not (m.of_the_machine or m.held_against(before[m.key]))
        ]
        for metric in worse:
            print(
                f"worse: {metric.key}: {metric.value:.4g} {metric.unit}, committed "
                f"{before[metric.key]:.4g}"
            )
    if options.update_baseline:
        contract.write(measured, machine())
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
