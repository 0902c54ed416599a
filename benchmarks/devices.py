"""`python -m benchmarks.devices`: many pairs on the device that JAX finds, with and
without what is made for the compiler of a CPU.

It prints what `devices.json` holds of each device that was measured, of which results.md
tells. Only ratios of one device count.
"""

import argparse
import json
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
    parser.add_argument("--pairs", type=int, default=2_000_000)
    parser.add_argument("--cleaned", type=int, default=50_000)
    given = parser.parse_args()
    device = f"{jax.devices()[0].device_kind}, jax {jax.__version__}"
    rates = {}
    orient = partial(jaxro.orient_batch, select=pose)
    for points in (16, 200):
        pairs = given.pairs * 16 // points
        ours = pair_of(aerial(pairs, points))
        pose_alone, whole = partial(orient, ours), partial(jaxro.orient_batch, ours)
        rates[f"pose, {points} points"] = _rate(pose_alone, pairs)
        rates[f"whole orientation, {points} points"] = _rate(whole, pairs)
    ours = pair_of(aerial(given.pairs, 16))
    with xla.plain():
        rates["pose, 16 points, plain JAX"] = _rate(partial(orient, ours), given.pairs)
    ours = pair_of(aerial(given.cleaned, 16))
    for name in ("data-snooping", "recommended"):
        clean = partial(jaxro.clean_batch, ours, PROCEDURES[name])
        rates[f"{name}, 16 points"] = _rate(clean, given.cleaned)
    rates["largest difference from the processor"] = _difference(orient)
    print(json.dumps({device: rates}, indent=2))


def _rate(call: Callable, pairs: int) -> float:
    """Million pairs a second, compilation left out."""
    ready(call)
    seconds = median_seconds({"": partial(ready, call)}, 3)[""]
    return float(f"{pairs / seconds / 1e6:.3g}")


def _difference(orient: Callable) -> float:
    """The largest difference of poses from those of the processor."""
    ours = pair_of(aerial(10_000, 16))
    here = jax.tree.map(np.asarray, orient(ours))
    with jax.default_device(jax.devices("cpu")[0]):
        there = jax.tree.map(np.asarray, orient(ours))
    pairs = zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True)
    most = max(float(np.max(np.abs(a - b))) for a, b in pairs if a.dtype == float)
    return float(f"{most:.2g}")


if __name__ == "__main__":
    main()
