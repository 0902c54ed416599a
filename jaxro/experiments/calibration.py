"""The level or tolerance at which a procedure spoils a given share of pairs without
errors, by simulation."""

import dataclasses
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..batches.batch import clean_batch
from ..geometry.pairs import Pair
from ..rejection import AbstractProcedure, Rejection

OCTAVES = (0.0, 2.0, -2.0, 5.0, -5.0, 12.0, -12.0)
"""Powers of two times the procedure's own value that are tried, in this order, until
the share lies between two."""
PRECISION = 1 / 256
"""Octaves: a quarter of a percent of the value."""
LARGEST_LEVEL = 0.5
USUAL = ("level", "limit")
"""Names of the field that decides, where a procedure has several numbers."""


class Calibration(NamedTuple):
    """The procedure with its field `name` at `value`; None, and the reason, where there
    is no such value."""

    procedure: AbstractProcedure | None
    name: str
    value: float
    reason: str


def adjustable(procedure: AbstractProcedure) -> str | None:
    """The field that says how readily the procedure rejects: one of the usual names, or
    its only fraction."""
    fields = dataclasses.fields(procedure)
    names = [
        field.name
        for field in fields
        if isinstance(getattr(procedure, field.name), float)
    ]
    return next(
        (name for name in USUAL if name in names), names[0] if len(names) == 1 else None
    )


def calibrated(procedure: AbstractProcedure, clean: Pair, share: float) -> Calibration:
    """The procedure that rejects something in this share of the pairs `clean`, which
    have no errors."""
    name = adjustable(procedure)
    if name is None:
        return Calibration(
            None, "", float("nan"), "not adjustable: no single level or tolerance"
        )
    own = getattr(procedure, name)
    most = LARGEST_LEVEL if name == "level" else float("inf")
    # the value goes in as an array, so that one compiled program serves all values
    with_value = lambda value: eqx.tree_at(
        lambda p: getattr(p, name), procedure, jnp.asarray(value)
    )
    value = lambda octaves: min(own * 2.0**octaves, most)

    def excess(octaves: float) -> float:
        return (
            float(
                np.mean(
                    np.asarray(
                        clean_batch(clean, with_value(value(octaves)), select=_alarm)
                    )
                )
            )
            - share
        )

    tried: dict[float, float] = {}
    for octaves in OCTAVES:
        tried[octaves] = excess(octaves)
        crossing = [
            (a, b)
            for a, b in pairwise(sorted(tried))
            if (tried[a] > 0) != (tried[b] > 0)
        ]
        if crossing:
            break
    else:
        nearest = share + min(tried.values(), key=abs)
        return Calibration(
            None,
            name,
            float("nan"),
            f"not adjustable: {name} reaches {nearest:.1%} at best",
        )
    low, high = crossing[0]
    above = tried[low] > 0
    while high - low > PRECISION:
        middle = (low + high) / 2
        low, high = (middle, high) if (excess(middle) > 0) == above else (low, middle)
    found = value((low + high) / 2)
    return Calibration(with_value(found), name, found, "")


def _alarm(found: Rejection):
    return jnp.any(found.order > 0)
