"""Relative orientation of one measured stereo pair: the one call of the README."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool

from ..adjustment.losses import AbstractLoss
from ..adjustment.terms import Term
from ..geometry import coplanarity
from ..geometry.elements import AbstractElements, RelativePose
from ..geometry.pairs import Pair, double, mask_unusable, pad, quickly, room_for
from ..xla.kernels import kernels_of_parts, one_kernel
from ..xla.programs import compiled, is_traced
from ..xla.settings import RUN_FAST
from . import starts
from .describe import Description, describe
from .problem import FOR_CALLERS, Problem, as_array
from .result import Orientation
from .results import RESULTS
from .solve import solve
from .verdict import check_plane, verdict

ANY_LENGTH = (coplanarity.rigorous, coplanarity.parallax)
"""Residuals that may be asked for with more places than points; one of the user's may
hold something of each point."""

EXACT_AT_ONCE = 32
"""Places of a pair up to which the first step from the vertical is an exact one."""

NEAR_STEPS = 10
"""Steps allowed from the vertical without a loss: near-vertical photos take four or
five."""


Unchecked = tuple[Orientation, Bool[Array, ""]]
"""An orientation, and whether `check_plane` is still to come."""


def orient(
    pair: Pair,
    *,
    elements: type[AbstractElements] = RelativePose,
    base: ArrayLike | None = None,
    residual: Callable[[Pair], Term] = coplanarity.rigorous,
    loss: AbstractLoss | None = None,
    start: starts.AbstractStart | AbstractElements = starts.Auto(),  # noqa: B008 (frozen)
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int | None = None,
) -> Orientation:
    """Orient the right photo of a pair to the left one by least squares (or a robust
    loss).

    `elements`: the system of the result. `base`: bx of `DependentElements` (its sign
    says on which side the right photo lies), b of `IndependentElements`; if not given
    bx of a known start, or the mean x-parallax. `RelativePose` has a unit base whatever
    is given. `residual`: `coplanarity.rigorous` or `coplanarity.parallax`. `start`: an
    object of `starts`, or known elements, which are then also the parameters that are
    iterated. `max_steps`: 60 if not given, 300 with a loss, whose reweighted steps
    converge linearly. Works under jit, vmap and grad; failures are values of `result`.
    """
    if pair.x_left.ndim != 1:
        raise ValueError(
            "orient takes one pair, but the coordinates have shape "
            f"{pair.x_left.shape}: use jax.vmap(orient), or orient_batch"
        )
    if loss is not None and not isinstance(loss, AbstractLoss):
        raise TypeError(
            f"orient: loss is an object of jaxro.losses, such as losses.Huber(), got "
            f"{loss!r}"
        )
    problem = Problem(
        elements=elements,
        base=as_array(base),
        residual=residual,
        loss=loss,
        start=start,
        solver=solver,
        max_steps=max_steps,
    )
    pair = double(pair)
    if is_traced((pair, problem)):
        if isinstance(start, starts.Auto):
            problem = problem._replace(tolerance=FOR_CALLERS)
        whole = compiled(orient_once, settings=RUN_FAST)
        return whole(pair, problem=problem)
    points = pair.x_left.size
    orientation, asked = _orient_in_parts(pair, problem)
    if bool(asked):
        pair = pad(pair, orientation.parallax.size)
        orientation = compiled(check_plane, settings=quickly)(pair, orientation, asked)
    return orientation.first(points)


def _orient_in_parts(pair: Pair, problem: Problem) -> Unchecked:
    """The orientation but for `check_plane`, by small programs instead of a large one:
    the general start, and that check, are compiled when a pair first needs them."""
    start = problem.start
    if isinstance(start, starts.Auto):
        unchecked, fits = _run(orient_near, pair, problem, one_kernel)
        if bool(fits):
            return unchecked
        problem = problem.starting(start.general)
    return _run(orient_unchecked, pair, problem, kernels_of_parts)


def _run(function: Callable, pair: Pair, problem: Problem, kernel: Callable) -> Any:
    """function(pair, problem) by a program that compiles quickly, and serves other
    numbers of points too."""
    if problem.residual in ANY_LENGTH:
        pair = pad(pair, room_for(pair.x_left.size))
    # the compiler makes no kernel of a solver of the user's, and none of no points
    as_kernel = problem.solver is None and pair.x_left.size > 0
    chosen = kernel if as_kernel else None
    program = compiled(function, settings=quickly, kernel=chosen, unit="points")
    return program(pair, problem=problem)


def orient_once(pair: Pair, problem: Problem) -> Orientation:
    """The orientation of one pair, within a compiled program."""
    return check_plane(pair, *orient_unchecked(pair, problem))


def orient_unchecked(pair: Pair, problem: Problem) -> Unchecked:
    """The orientation of one pair but for `check_plane`."""
    return _solve(pair, problem)[0]


def orient_from(pair: Pair, pose: RelativePose) -> Unchecked:
    """The orientation from a pose near the right one but for `check_plane`, within a
    compiled program."""
    problem = Problem(
        elements=RelativePose,
        base=None,
        residual=coplanarity.rigorous,
        loss=None,
        start=pose,
        solver=None,
        max_steps=None,
    )
    return compiled(orient_unchecked, settings=RUN_FAST)(pair, problem=problem)


def orient_near(pair: Pair, problem: Problem) -> tuple[Unchecked, Bool[Array, ""]]:
    """The first part of an `Auto` start as an orientation of its own but for
    `check_plane`: from the vertical, and whether that fits."""
    auto, most = problem.start, problem.most_steps
    assert isinstance(auto, starts.Auto)
    plain = problem.loss is None
    allowed = min(most, NEAR_STEPS) if plain else most
    first_order = plain and pair.x_left.shape[0] > EXACT_AT_ONCE
    vertical = starts.Vertical(steps=int(first_order))
    problem = problem.starting(vertical, max_steps=allowed)

    (orientation, asked), description = _solve(pair, problem)
    # asks for the count, not for the result, which would cost the statistics where only
    # the pose is wanted
    ended = (orientation.iterations < allowed) | (allowed == most)
    fits = auto.fits(description.pose, description.inspection) & ended
    return (orientation, asked), fits


def _solve(pair: Pair, problem: Problem) -> tuple[Unchecked, Description]:
    """The orientation but for `check_plane`, and what it was made of."""
    pair, bad_input = mask_unusable(pair)
    solution = solve(pair, problem)
    description = describe(pair, problem, solution)
    adjustment = solution.adjustment
    orientation = Orientation(
        pose=description.pose,
        elements=description.elements,
        cofactor=description.cofactor,
        parallax=description.parallax,
        residuals=adjustment.residuals,
        redundancy=adjustment.redundancy,
        model=description.model,
        in_front=description.in_front,
        m_q=description.m_q,
        sigma0=adjustment.sigma0,
        degrees_of_freedom=jnp.maximum(adjustment.degrees_of_freedom, 0),
        iterations=adjustment.iterations,
        result=verdict(pair, problem, solution, description, bad_input),
    )
    fine = orientation.result == RESULTS.successful
    checked = orientation.degrees_of_freedom > 0
    asked = description.inspection.twin & fine & checked
    return (orientation, asked), description
