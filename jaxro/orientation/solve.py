"""The solution of an orientation: a start, and the adjustment from there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..adjustment.least_squares import Adjustment, adjust
from ..adjustment.normal_equations import GaussNewton
from ..geometry.elements import AbstractElements
from ..geometry.pairs import Pair
from . import starts
from .problem import Problem
from .starts import StartingPose

LONGEST = 0.5
"""Longest component of a step (rad): beyond it the linearisation means nothing."""


class Solution(NamedTuple):
    """Where the adjustment began, and how it ended."""

    start: StartingPose
    adjustment: Adjustment


def solve(pair: Pair, problem: Problem) -> Solution:
    """The solution of a pair whose masked points are zero."""
    start = _begin(pair, problem.start)
    own = GaussNewton(problem.tolerance, problem.tolerance, max_step=LONGEST)
    adjustment = adjust(
        problem.residual(pair),
        start.pose,
        loss=problem.loss,
        solver=own if problem.solver is None else problem.solver,
        max_steps=problem.most_steps,
    )
    return Solution(start, adjustment)


def _begin(pair: Pair, start: starts.AbstractStart | AbstractElements) -> StartingPose:
    """The pose to begin with; the optimum does not depend on where it is sought."""
    if not isinstance(start, AbstractElements):
        return start(lax.stop_gradient(pair))
    as_pair = lambda element: jnp.asarray(element, pair.x_left.dtype)
    no = jnp.asarray(False)
    return StartingPose(jax.tree.map(as_pair, start), no, no)
