"""The level or tolerance at which a procedure spoils a given share of pairs without
errors, by simulation."""

import dataclasses
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..batches.batch import clean_batch
from ..geometry.pairs import Pair
from ..orientation.results import is_usable
from ..rejection import OUTCOMES, AbstractProcedure, Rejection

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
    its only number; None if it has several others."""
    fields = [field.name for field in dataclasses.fields(procedure)]
    names = [name for name in fields if isinstance(getattr(procedure, name), float)]
    only = names[0] if len(names) == 1 else None
    return next((name for name in USUAL if name in names), only)


def calibrate(procedure: AbstractProcedure, clean: Pair, share: float) -> Calibration:
    """The procedure that rejects something in this share of the pairs `clean`, which
    have no errors."""
    name = adjustable(procedure)
    if name is None:
        reason = "not adjustable: no single level or tolerance"
        return Calibration(None, "", math.nan, reason)
    own = getattr(procedure, name)
    most = LARGEST_LEVEL if name == "level" else math.inf

    def value(octaves: float) -> float:
        return min(own * 2.0**octaves, most)

    def excess(octaves: float) -> float:
        at_value = set_value(procedure, name, value(octaves))
        order = clean_batch(clean, at_value, select=select)[1]
        alarms = np.any(np.asarray(order) > 0, axis=1)
        return float(np.mean(alarms)) - share

    tried: dict[float, float] = {}
    for octaves in OCTAVES:
        tried[octaves] = excess(octaves)
        for low, high in pairwise(sorted(tried)):
            if (tried[low] > 0) != (tried[high] > 0):
                found = value(_root(excess, low, high, tried[low] > 0))
                return Calibration(set_value(procedure, name, found), name, found, "")
    nearest = share + min(tried.values(), key=abs)
    reason = f"not adjustable: {name} reaches {nearest:.1%} at best"
    return Calibration(None, name, math.nan, reason)


def _root(
    excess: Callable[[float], float], low: float, high: float, above: bool
) -> float:
    """The octaves at which the excess changes its sign, by bisection down to PRECISION;
    `above`: it is positive at the lower end."""
    while high - low > PRECISION:
        middle = (low + high) / 2
        if (excess(middle) > 0) == above:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def set_value(procedure: AbstractProcedure, name: str, value: float) -> Any:
    """The procedure with this value of a field, as an array: one compiled program
    serves all values."""
    return eqx.tree_at(lambda p: getattr(p, name), procedure, jnp.asarray(value))


def select(found: Rejection) -> tuple:
    """What is kept of every pair: (points kept, order, pose, whether it is usable,
    whether the procedure finished); the same for all that is compared, so that it is
    compiled once."""
    orientation = found.orientation
    return (
        found.mask,
        found.order,
        orientation.pose,
        is_usable(orientation.result),
        found.outcome == OUTCOMES.finished,
    )
