"""Tests of groups of rows: a vector, a point with all its measurements, a photo, a set
of a user.

If all rows of a group may be wrong by errors of their own, Σ r² falls by

    T = r_gᵀ R_gg⁻¹ r_g,    R = I - H,

when they are left out; T of errorless rows has the chi-squared distribution with as
many degrees of freedom as R_gg has rank. Of a single row T = w². Rows that the others
do not check take no part in it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..adjustment import critical_values as critical
from ..adjustment.critical_values import UNTESTABLE
from .normalised import Normalised


class GroupTests(NamedTuple):
    """Of every group the statistic T for sigma0 = 1, its degrees of freedom (0 where
    nothing checks the group), and the probability of a larger T without an error."""

    statistic: Float[np.ndarray, " group"]
    freedom: Int[np.ndarray, " group"]
    p: Float[np.ndarray, " group"]


def assess_groups(
    known: Normalised, group: Int[np.ndarray, " row"], sigma0: float = 1.0
) -> GroupTests:
    """The tests of all groups; `group`: the number of each row's group, -1 for rows of
    none. `sigma0`: the standard deviation of unit weight that is known."""
    count = int(np.max(group, initial=-1)) + 1
    redundancy = np.asarray(known.redundancy)
    root = np.sqrt(np.where(known.tested, redundancy, 1.0))
    residuals = np.asarray(known.w) * root / sigma0
    spanned = np.asarray(known.basis) * root[:, None]
    statistic, freedom = np.zeros(count), np.zeros(count, int)
    for number in range(count):
        rows = np.flatnonzero((group == number) & np.asarray(known.tested))
        left = np.eye(len(rows)) - spanned[rows] @ spanned[rows].T
        size, ways = np.linalg.eigh(left)
        checked = size > UNTESTABLE
        along = ways[:, checked].T @ residuals[rows]
        statistic[number] = np.sum(along**2 / size[checked])
        freedom[number] = np.sum(checked)
    return GroupTests(statistic, freedom, _probabilities(statistic, freedom))


def _probabilities(
    statistic: Float[np.ndarray, " group"], freedom: Int[np.ndarray, " group"]
) -> Float[np.ndarray, " group"]:
    """Of a larger chi-squared number; 1 without a degree of freedom."""
    there = freedom > 0
    f = np.where(there, freedom, 1)
    return np.where(there, np.asarray(critical.chi_squared_p(statistic, f)), 1.0)
