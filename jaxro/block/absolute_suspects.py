"""Control points without which a model fits the rest far better: wrong coordinates, or
the names of two points exchanged, which draws the model so far that no residual is
large by itself."""

from itertools import combinations
from math import comb
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..adjustment import critical_values as critical
from .absolute import orient_model
from .absolute_model import MeasuredModel
from .absolute_result import AbsoluteOrientation

MOST_TRIES = 120
"""Sets of control points that are left out, one set after the other."""

LEVEL = 0.001
"""Probability that points are suspected although none is wrong."""

LEAST_FREEDOM = 2
"""Degrees of freedom without the suspected points."""


class Suspects(NamedTuple):
    """The rows of the suspected points, and sigma0 without them."""

    rows: tuple[int, ...]
    sigma0: float


def find_suspects(
    measured: MeasuredModel, found: AbsoluteOrientation
) -> Suspects | None:
    """The control point, or the two, without which the sum of squares falls most
    significantly (F test, for all sets that are tried); None if it does not fall
    so."""
    rows = np.flatnonzero(np.any(np.asarray(measured.known), axis=1)).tolist()
    for size in (1, 2):
        tries = comb(len(rows), size)
        if tries > MOST_TRIES:
            return None
        left_out = [
            (_compare(measured, found, out), out) for out in combinations(rows, size)
        ]
        (chance, sigma0), out = min(left_out, default=((1.0, 0.0), ()))
        if chance * tries < LEVEL:
            return Suspects(out, sigma0)
    return None


def _compare(
    measured: MeasuredModel, found: AbsoluteOrientation, out: tuple[int, ...]
) -> tuple[float, float]:
    """The probability of so large a fall of the sum of squares without some points, and
    sigma0 then."""
    used = ~np.isin(np.arange(len(measured.points)), out)
    known = jnp.asarray(np.asarray(measured.known) & used[:, None])
    rest = orient_model(eqx.tree_at(lambda m: m.known, measured, known))
    freedom = int(rest.degrees_of_freedom)
    if not bool(rest.usable) or freedom < LEAST_FREEDOM:
        return 1.0, 0.0
    dropped = int(found.degrees_of_freedom) - freedom
    variance = float(rest.sigma0) ** 2
    fallen = int(found.degrees_of_freedom) * float(found.sigma0) ** 2
    ratio = (fallen - freedom * variance) / dropped / max(variance, 1e-300)
    return float(critical.fisher_p(max(ratio, 0.0), dropped, freedom)), float(
        rest.sigma0
    )
