"""Tests of groups of rows: a vector, a point with all its measurements, a photo, a set
of a user.

If all rows of a group may be wrong by errors of their own, Σ r² falls by

    T = r_gᵀ R_gg⁻¹ r_g,    R = I - H,

when they are left out; T of errorless rows has the chi-squared distribution with as
many degrees of freedom m as R_gg has rank. Of a single row T = w². Where sigma0 is
estimated, from the f - m degrees of freedom of the rest,

    F = (T / m) / ((Σ r² - T) / (f - m))

has Fisher's distribution; of a single row F = t². Rows that the others do not check
take no part in it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.critical_values import UNTESTABLE
from .normalised import Normalised


class GroupTests(NamedTuple):
    """Of every group T, its degrees of freedom (0 where nothing checks the group), and
    the probability of a larger T (F) without an error."""

    statistic: Float[np.ndarray, " group"]
    freedom: Int[np.ndarray, " group"]
    p: Float[np.ndarray, " group"]


def assess_groups(
    known: Normalised,
    group: Int[np.ndarray, " row"],
    *,
    sigma0_known: bool = True,
) -> GroupTests:
    """The tests of all groups; `group`: the number of each row's group, -1 for rows of
    none; `sigma0_known`: sigma0 is 1, else it is estimated."""
    count = int(np.max(group, initial=-1)) + 1
    redundancy, tested = np.asarray(known.redundancy), np.asarray(known.tested)
    root = np.sqrt(np.where(tested, redundancy, 1.0))
    residuals = np.asarray(known.w) * root
    spanned = np.asarray(known.basis) * root[:, None]
    statistic, freedom = np.zeros(count), np.zeros(count, int)
    for number in range(count):
        rows = np.flatnonzero((group == number) & tested)
        left = np.eye(len(rows)) - spanned[rows] @ spanned[rows].T
        size, ways = np.linalg.eigh(left)
        checked = size > UNTESTABLE
        along = ways[:, checked].T @ residuals[rows]
        statistic[number] = np.sum(along**2 / size[checked])
        freedom[number] = np.sum(checked)
    squares, total = float(known.squares), int(known.freedom)
    if sigma0_known:
        p = probability(statistic, freedom)
    else:
        p = estimated_probability(statistic, freedom, squares, total)
    return GroupTests(statistic, freedom, p)


def probability(statistic: ArrayLike, freedom: ArrayLike) -> Float[np.ndarray, "..."]:
    """Of a larger T, with sigma0 known; 1 without a degree of freedom."""
    statistic, freedom = np.asarray(statistic), np.asarray(freedom)
    there = freedom > 0
    p = critical.chi_squared_p(statistic, np.where(there, freedom, 1))
    return np.where(there, np.asarray(p), 1.0)


def estimated_probability(
    statistic: ArrayLike, freedom: ArrayLike, squares: float, total: int
) -> Float[np.ndarray, "..."]:
    """Of a larger F; 1 where nothing is left that tells sigma0. `squares`: Σ r², of
    `total` degrees of freedom."""
    statistic, m = np.asarray(statistic), np.asarray(freedom)
    there = (m > 0) & (total > m)
    m, rest = np.where(there, m, 1), np.where(there, total - m, 1)
    left = np.maximum(squares - statistic, 1e-12 * squares)
    f = (statistic / m) / np.where(left > 0, left / rest, 1.0)
    p = critical.fisher_p(f, m, rest)
    return np.where(there, np.asarray(p), 1.0)
