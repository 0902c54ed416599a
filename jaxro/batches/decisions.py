"""What a procedure decided about pairs of every length, in the rows of all."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from ..geometry.elements import RelativePose
from ..geometry.pairs import Pair
from ..rejection import Rejection


class Decisions(NamedTuple):
    """What a procedure decided: of every row whether it is kept, in which round it
    went, and its statistic then; of every pair the outcome, a number of
    `rejection.OUTCOMES`; of every row whether it is `undecided`. As of
    `rejection.Rivals`: of every row whether it is one of each rival; of every pair the
    probability of each, that of the points kept, and the poses."""

    kept: Bool[np.ndarray, " row"]
    order: Int[np.ndarray, " row"]
    statistic: Float[np.ndarray, " row"]
    outcome: Int[np.ndarray, " pair"]
    undecided: Bool[np.ndarray, " row"]
    rival: Bool[np.ndarray, "row rival"]
    probability: Float[np.ndarray, "pair rival"]
    own: Float[np.ndarray, " pair"]
    pose: RelativePose


def decisions(_: Pair, rejection: Rejection) -> tuple[PyTree, PyTree]:
    """Of a pair (outcome, probability, own, pose); of every point (kept, order, statistic,
    undecided, rival)."""
    rivals = rejection.rivals
    told = rivals.probability, rivals.own, rivals.pose
    return (rejection.outcome._value, *told), (
        rejection.mask,
        rejection.order,
        rejection.statistic,
        rejection.undecided,
        rivals.mask.T,
    )
