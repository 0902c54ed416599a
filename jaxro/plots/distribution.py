"""How a number of each pair, such as sigma0, is distributed over many pairs."""

from typing import Any

import numpy as np
from jaxtyping import Float

from .style import BLACK, BLUE, add_legend, axes_or_new, describe, with_unit


def draw_distribution(
    values: Float[np.ndarray, " pair"],
    *,
    name: str = "sigma0",
    unit: str = "",
    expected: float | None = None,
    axes: Any = None,
) -> Any:
    """A histogram of the values that exist, with their median and, if there is one, the
    value that is `expected`. The axis has ten decades at most, logarithmic where the
    largest value is more than a hundred times the median."""
    axes = axes_or_new(axes, height=2.8)
    there = values[np.isfinite(values) & (values > 0)]
    told = f"Distribution of {name}, {len(there)} of {len(values)} pairs"
    describe(axes, told, with_unit(name, unit), "pairs")
    if not len(there):
        return axes
    median, most = float(np.median(there)), float(np.max(there))
    bins: Any = "auto" if len(there) < 1e4 else 100
    if most > 100 * median:
        least = max(float(np.min(there)), most * 1e-10)
        bins = np.geomspace(least, most * (1 + 1e-9), 41)
        axes.set_xscale("log")
    axes.hist(there, bins=bins, color=BLUE, edgecolor="white", linewidth=0.4)
    axes.axvline(median, color=BLACK, ls="--", lw=1.2, label=f"median {median:.3g}")
    if expected is not None:
        label = f"expected {expected:g}"
        axes.axvline(expected, color=BLACK, ls=":", lw=1.6, label=label)
    axes.yaxis.get_major_locator().set_params(integer=True)
    add_legend(axes)
    return axes
