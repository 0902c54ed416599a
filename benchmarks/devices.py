"""`python -m benchmarks.devices`: many pairs on the device that JAX finds, with and
without what is made for the compiler of a CPU.

Figures of one machine, which stand in no baseline; results.md names the device.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import jax
import numpy as np

import jaxro
from jaxro import xla
from jaxro.rejection import PROCEDURES

from .common import pair_of, pose, ready
from .metrics import median_seconds
from .workload import aerial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=1_000_000)
    parser.add_argument("--cleaned", type=int, default=20_000)
    given = parser.parse_args()
    device = jax.devices()[0]
    print(f"{device.device_kind}, jax {jax.__version__}, float64", flush=True)
    orient = partial(jaxro.orient_batch, select=pose)
    for points in (16, 200):
        pairs = given.pairs * 16 // points
        ours = pair_of(aerial(pairs, points))
        for name, call in {
            f"pose, {points} points": partial(ready, orient, ours),
            f"whole, {points} points": partial(ready, jaxro.orient_batch, ours),
        }.items():
            _show(name, call, pairs)
    with xla.plain():
        ours = pair_of(aerial(given.pairs, 16))
        _show("pose, 16 points, plain JAX", partial(ready, orient, ours), given.pairs)
    ours = pair_of(aerial(given.cleaned, 16))
    clean = partial(jaxro.clean_batch, ours, PROCEDURES["data-snooping"])
    _show("data-snooping, 16 points", partial(ready, clean), given.cleaned)
    clean = partial(jaxro.clean_batch, ours, PROCEDURES["recommended"])
    _show("recommended, 16 points", partial(ready, clean), given.cleaned)
    _compare(orient)


def _show(name: str, call: Callable, pairs: int) -> None:
    """The first call, and the median of later ones."""
    began = time.perf_counter()
    try:
        call()
    except Exception as error:
        print(f"{name}: failed: {str(error)[:300]}", flush=True)
        return
    first = time.perf_counter() - began
    seconds = median_seconds({name: call}, 3)[name]
    rate = pairs / seconds / 1e6
    print(
        f"{name}: {rate:.3f} million pairs a second, first call {first:.1f} s",
        flush=True,
    )


def _compare(orient: Callable) -> None:
    """The largest difference of poses from those of the processor."""
    ours = pair_of(aerial(10_000, 16))
    here = jax.tree.map(np.asarray, orient(ours))
    with jax.default_device(jax.devices("cpu")[0]):
        there = jax.tree.map(np.asarray, orient(ours))
    pairs = zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True)
    most = max(float(np.max(np.abs(a - b))) for a, b in pairs if a.dtype == float)
    print(f"largest difference from the processor: {most:.2e}")


if __name__ == "__main__":
    main()
