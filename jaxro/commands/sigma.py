"""What --sigma says: a number, or `auto`, the noise that the residuals of the table
show."""

import math
from typing import Any

from ..batches.ragged import Ragged
from ..batches.table_noise import TableNoise, estimate
from ..reports.pair import digits
from ..reports.text import number
from ..tables.fields import TableError

AUTO = "auto"

Sigma = float | str | None
"""As it was given; None where nothing was said."""


def parse(sigma: Sigma) -> float | None:
    """The number; None for `auto` and where nothing was said. Raises TableError for
    anything else."""
    if sigma is None or sigma == AUTO:
        return None
    try:
        value = float(sigma)
    except ValueError:
        expected = (
            f"a standard deviation such as 0.005, or {AUTO}: that of the residuals"
        )
        raise TableError("--sigma", found=repr(sigma), expected=expected) from None
    if not (math.isfinite(value) and value > 0):
        raise TableError(
            "--sigma", found=repr(value), expected="a positive standard deviation"
        )
    return value


def from_residuals(pairs: Ragged) -> TableNoise:
    """The noise of the pairs, whose sigma is one unit of the table. Raises TableError
    where they do not tell it."""
    try:
        return estimate(pairs)
    except ValueError as error:
        expected = "the standard deviation of a coordinate itself, --sigma SD"
        raise TableError(
            "--sigma", found=f"{AUTO}, but {error}", expected=expected
        ) from None


def entry(noise: TableNoise | None) -> dict[str, Any]:
    """What summary.json and decisions.json say of it, and a journal; nothing where
    sigma was given."""
    if noise is None:
        return {}
    deviation = noise.deviation if math.isfinite(noise.deviation) else None
    return {"sigma_from_residuals": {**noise._asdict(), "deviation": deviation}}


def from_entry(request: dict[str, Any]) -> TableNoise | None:
    """The noise that an `entry` of a journal tells of."""
    told = request.get("sigma_from_residuals")
    return told and TableNoise(
        **{
            **told,
            "deviation": math.inf if told["deviation"] is None else told["deviation"],
        }
    )


def sentence(noise: TableNoise, unit: str) -> str:
    """sigma 0.0098 ± 0.0002 mm, from the residuals of 256 pairs"""
    if math.isfinite(noise.deviation):
        decimals = digits(noise.deviation)
        value = f"{number(noise.sigma, decimals)} ± {number(noise.deviation, decimals)}"
    else:
        value = f"{number(noise.sigma, digits(noise.sigma))} (± unknown)"
    of = "1 pair" if noise.pairs == 1 else f"{noise.pairs} pairs"
    rest = noise.asked - noise.pairs
    others = f"; {rest} other{'s' * (rest != 1)} told nothing" if rest else ""
    return f"sigma {value} {unit}, from the residuals of {of}{others}"
